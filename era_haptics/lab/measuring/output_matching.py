"""Assignment of sound-card outputs to actuators, by the responses next to each actuator.

An actuator moves its own position more than the others do, and the velocity there determines the
power it gives to the plate: this also works for a poorly known plate. Responses at all positions
are compared with the rig's model, normalized per frequency. The unknown delay of the sound card is
fitted jointly for all outputs, by the largest sum of similarities over an assignment. Polarities
are relative to the majority.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from era_haptics.lab.measuring.multisine import ResponseEstimate
from era_haptics.lab.measuring.recording_checks import MIN_COHERENCE, MIN_RESPONSE
from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig

_DELAYS = np.arange(0, 0.05, 1e-4)  # s
_RATTLE = 0.1  # of the lines played, at even ones
_WEAK = 0.5  # of the median level
_MARGIN = 0.05  # of the mean correlation, over the next best assignment


@dataclass(frozen=True)
class OutputFinding:
    """Finding for one output, counted from 1; era: the ERA it drives, None for none.

    Without an accelerometer, polarity (1 or -1) and relative_level (relative to the median and to
    the model) are None. verdict: the problem and its remedy.
    """

    output: int
    era: str | None = None
    polarity: int | None = None
    relative_level: float | None = None
    verdict: str = "ok"


def findings_of(
    rig: Rig, frequencies: FloatArray, estimates: Sequence[Sequence[ResponseEstimate]]
) -> list[OutputFinding]:
    """Assign outputs to actuators by the responses next to each actuator at frequencies (f,) [Hz].

    estimates: by actuator and output. Raises InputError if outputs cannot be distinguished.
    """
    points = np.array([[era.x, era.y] for era in rig.eras])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
    model = free.acceleration(rig.eras, frequencies, points, loads=rig.masses).transpose(1, 0, 2)
    values = np.array([[output.values[:, 0, 0] for output in row] for row in estimates])
    noise = np.array([[output.std[:, 0] for output in row] for row in estimates])
    ratios = np.median(np.abs(values) / noise, axis=2).max(axis=0)  # (outputs,)
    audible = np.flatnonzero(ratios >= MIN_RESPONSE)
    if not audible.size:
        raise InputError("no output moves the plate: check amplifier, its supply and cables")
    responses = values[:, audible].transpose(1, 2, 0)
    rows, eras, signs = matched(responses, model, frequencies)
    levels = _norms(responses[rows]) / _norms(model[eras])
    relative_levels = levels / np.median(levels)
    dead = "dead: moves nothing; check its cable and amplifier"
    findings = []
    for number in range(1, len(ratios) + 1):
        findings.append(OutputFinding(number, relative_level=0.0, verdict=dead))
    for row, era, sign, level in zip(rows, eras, signs, relative_levels, strict=True):
        column = int(audible[row])
        verdict = _verdict(estimates[era][column], sign=sign, level=level)
        name = rig.eras[era].name
        findings[column] = OutputFinding(column + 1, name, int(sign), float(level), verdict)
    return findings


def _verdict(response: ResponseEstimate, *, sign: int, level: float) -> str:
    """Return the verdict on an output that moves the plate; response: next to its actuator."""
    if response.even[0] > _RATTLE or np.median(response.coherence) < MIN_COHERENCE:
        return "loose: it rattles; fasten it"
    if level < _WEAK:
        return "loose, or its gain is low: fasten it, and check the amplifier's knob"
    return "backwards: exchange its two wires" if sign < 0 else "ok"


def matched(
    values: ComplexArray, model: ComplexArray, frequencies: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Assign responses (o, f, s) to a model's (e, f, s): numbers of both, and signs.

    Signs are relative to the majority. Raises InputError if another assignment fits nearly as well.
    """
    measured = _normalized(values)
    modeled = _normalized(model)
    delays = np.exp(2j * np.pi * np.outer(_DELAYS, frequencies))
    similarities = np.einsum(
        "tf,ofs,efs->toe", delays, measured, modeled.conj(), optimize=True
    ).real
    best, rows, eras, delay = _assigned(np.abs(similarities))
    for row, era in zip(rows, eras, strict=True):
        without_pair = np.abs(similarities)
        without_pair[:, row, era] = 0
        if best - _assigned(without_pair)[0] < _MARGIN * len(rows):
            raise InputError(
                "outputs must differ next to their actuators, got two assignments that fit nearly "
                "equally well; check that the accelerometer was moved each time, or omit --beside "
                "and enter which actuator moved"
            )
    signs = np.sign(similarities[delay, rows, eras])
    majority = 1 if signs.sum() >= 0 else -1
    return rows, eras, np.asarray(signs * majority, dtype=int)


def _assigned(similarities: FloatArray) -> tuple[float, IntArray, IntArray, int]:
    """Return the best sum over a delay's assignment, its rows and columns, and the delay's
    number."""
    assignments = [linear_sum_assignment(matrix, maximize=True) for matrix in similarities]
    sums = []
    for matrix, assignment in zip(similarities, assignments, strict=True):
        sums.append(matrix[assignment].sum())
    best = int(np.argmax(sums))
    return float(sums[best]), *assignments[best], best


def _norms(values: ComplexArray) -> FloatArray:
    """Return the norm of each response (n, f, s)."""
    return np.asarray(np.linalg.norm(values, axis=(1, 2)))


def _normalized(values: ComplexArray) -> ComplexArray:
    """Scale responses (n, f, s) so that all have one norm and all frequencies weigh the same."""
    power = (np.abs(values) ** 2).mean(axis=(0, 2))
    scaled = values / np.sqrt(power)[:, None]
    return np.asarray(scaled / _norms(scaled)[:, None, None])
