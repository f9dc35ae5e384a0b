"""Which output of a sound card drives which actuator: one output after the other plays.

A person feels or sees a soft tone. An accelerometer that is put beside each
actuator in turn tells it by itself, also of a plate that is hardly known: an actuator moves its own
place more than others do, and by the velocity there it gives power to the plate. Responses at all
places are compared with those of the rig's model, each frequency by its own size. The delay of the
sound card is unknown: that by which all outputs together fit best is taken, and polarities are
those relative to the majority.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from model.arrays import ComplexArray, FloatArray, IntArray
from model.calibration.sensor_file import WiredSensor
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.loopback import check_levels
from sim.desk.measuring.measure import run_time
from sim.desk.measuring.multisine import Estimate, Multisine, estimate, ramped
from sim.desk.measuring.single_run import settled
from sim.desk.measuring.sound_card import SoundCard

TONE = 160.0
"""Usual frequency [Hz] of the tone: felt well, and soft in air."""

BURST, PAUSE = 0.4, 0.2
"""Time [s] of a burst, ramped over its quarters, and between two."""

_BURSTS = 3
_OCTAVES = 4.0  # highest over lowest line
_STEP = 20  # Hz; of lines one above its multiples, so that sums of two are beside lines
_PERIODS = 2
_DELAYS = np.arange(0, 0.05, 1e-4)  # s
_MOVED = 5.0  # times the noise, in the median over frequencies
_COHERENT = 0.9
_RATTLE = 0.1  # of the lines played, at even ones
_WEAK = 0.5  # of the median level
_MARGIN = 0.05  # of the mean correlation, over the next best assignment


def tone(
    desk: Desk, output: int, *, outputs: int, rate: float, level: float, frequency: float
) -> FloatArray:
    """Samples (n, outputs) of three short bursts on one output, counted from 1; frequency [Hz].

    Raises InputError for what the rig's limits do not allow.
    """
    desk.check_frequencies(np.array([frequency]), what="--frequency")
    ramp = round(BURST / 4 * rate)
    desk.check_times(seconds=BURST, slew=np.pi / 2 * level / (BURST / 4))
    times = np.arange(round(BURST * rate)) / rate
    burst = ramped(level * np.sin(2 * np.pi * frequency * times)[:, None], ramp)
    each = np.concatenate([burst, np.zeros((round(PAUSE * rate), 1))])
    found = np.zeros((_BURSTS * len(each), outputs))
    found[:, output - 1] = np.tile(each, (_BURSTS, 1))[:, 0]
    return found


def default_tone(rig: Rig) -> float:
    """The usual frequency [Hz], or the nearest one within the rig's limits."""
    return float(np.clip(TONE, rig.limits.frequency_min, rig.limits.frequency_max))


@dataclass(frozen=True)
class Heard:
    """What is known of an output, counted from 1; era: that it drives, "" for none.

    level: relative to the median, and to the model; verdict: "" where nothing is wrong.
    """

    output: int
    era: str
    is_reversed: bool = False
    level: float = 1.0
    verdict: str = ""


def listen(
    desk: Desk,
    card: SoundCard,
    beside: int,
    *,
    outputs: int,
    level: float,
    move: Callable[[str], None],
) -> list[Heard]:
    """Play on each output for a few seconds at each place, and tell what it drives.

    beside: input, counted from 1, of the accelerometer that is put beside each actuator; move:
    called with the name of the next one. Raises InputError, LinkError for an input that is clipped
    or silent; InputError where outputs are not told apart.
    """
    limits = desk.rig.limits
    low, high = limits.frequency_min, min(limits.frequency_max, _OCTAVES * limits.frequency_min)
    lines = np.arange(1.0, high + 1e-6, _STEP)
    sines = Multisine(lines[lines >= low], 1, card.rate, level)
    desk.check_times(seconds=run_time(_PERIODS), slew=sines.slew)
    found: list[list[Estimate]] = []
    for era in desk.rig.eras:
        move(era.name)
        runs = [
            settled(card, sines, output, outputs=outputs, periods=_PERIODS)[:, [beside - 1]]
            for output in range(1, outputs + 1)
        ]
        sensor = WiredSensor(f"beside {era.name}", era.x, era.y, 1, 1.0)
        check_levels(np.concatenate(runs), [sensor])
        found.append([estimate(sines, [run]) for run in runs])
    return judged(desk, sines.frequencies, found)


def judged(desk: Desk, frequencies: FloatArray, found: Sequence[Sequence[Estimate]]) -> list[Heard]:
    """What each output drives, by the responses beside each actuator at frequencies (f,) [Hz].

    found: by actuator and output. Raises InputError where outputs are not told apart.
    """
    rig = desk.rig
    points = np.array([[era.x, era.y] for era in rig.eras])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
    model = free.acceleration(rig.eras, frequencies, points, loads=rig.masses).transpose(1, 0, 2)
    by_output = list(zip(*found, strict=True))
    audible = [n for n, each in enumerate(by_output) if _moves(each)]
    if not audible:
        raise InputError("no output moves the plate: check amplifier, its supply and cables")
    values = np.array(
        [[place.values[:, 0, 0] for place in by_output[n]] for n in audible]
    ).transpose(0, 2, 1)
    rows, eras, signs = matched(values, model, frequencies)
    levels = _size(values[rows]) / _size(model[eras])
    levels = levels / np.median(levels)
    heard = {
        n: Heard(n + 1, "", level=0.0, verdict="dead: moves nothing; check its cable and amplifier")
        for n in range(len(by_output))
    }
    for row, era, sign, level in zip(rows, eras, signs, levels, strict=True):
        n, is_reversed = audible[row], bool(sign < 0)
        verdict = _verdict(by_output[n][era], is_reversed=is_reversed, level=level)
        heard[n] = Heard(n + 1, rig.eras[era].name, is_reversed, float(level), verdict)
    return list(heard.values())


def _moves(places: Sequence[Estimate]) -> bool:
    return any(np.median(np.abs(each.values) / each.std[..., None]) >= _MOVED for each in places)


def _verdict(beside: Estimate, *, is_reversed: bool, level: float) -> str:
    """What is wrong with an output that moves the plate, "" for nothing."""
    if beside.even[0] > _RATTLE or np.median(beside.coherence) < _COHERENT:
        return "loose: it rattles; fasten it"
    if level < _WEAK:
        return "loose, or its gain is low: fasten it, and check the amplifier's knob"
    return "backwards: exchange its two wires" if is_reversed else ""


def matched(
    values: ComplexArray, model: ComplexArray, frequencies: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Which responses (o, f, s) are which of a model's (e, f, s): numbers of both, and signs.

    Signs are relative to the majority. Raises InputError where another assignment fits nearly
    as well.
    """
    one, other = _even(values), _even(model)
    late = np.exp(2j * np.pi * np.outer(_DELAYS, frequencies))
    alike = np.einsum("tf,ofs,efs->toe", late, one, other.conj(), optimize=True).real
    best, rows, eras, moment = _assigned(np.abs(alike))
    for row, era in zip(rows, eras, strict=True):
        without = np.abs(alike)
        without[:, row, era] = 0
        if best - _assigned(without)[0] < _MARGIN * len(rows):
            raise InputError(
                "outputs must differ beside their actuators, got two assignments that fit nearly "
                "as well; check that the accelerometer was moved each time, or omit --beside and "
                "say which moved"
            )
    signs = np.sign(alike[moment, rows, eras])
    return rows, eras, np.asarray(signs * (1 if signs.sum() >= 0 else -1), dtype=int)


def _assigned(alike: FloatArray) -> tuple[float, IntArray, IntArray, int]:
    """The best sum over a delay's assignment, its rows and columns, and the delay's number."""
    pairs = [linear_sum_assignment(each, maximize=True) for each in alike]
    sums = [each[pair].sum() for each, pair in zip(alike, pairs, strict=True)]
    best = int(np.argmax(sums))
    return float(sums[best]), *pairs[best], best


def _size(values: ComplexArray) -> FloatArray:
    """The norm of each response (n, f, s)."""
    return np.asarray(np.linalg.norm(values, axis=(1, 2)))


def _even(values: ComplexArray) -> ComplexArray:
    """Responses (n, f, s) of one size, to which each frequency contributes as much."""
    scaled = values / np.sqrt((np.abs(values) ** 2).mean(axis=(0, 2)))[:, None]
    return np.asarray(scaled / _size(scaled)[:, None, None])
