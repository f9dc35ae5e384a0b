"""Which output of a sound card drives which actuator: one output after the other plays.

A soft tone is felt or seen by whoever stands there. An accelerometer anywhere on the plate tells it
by the rig's model: of two octaves, above which models of an unmeasured plate say little, responses
are compared with those to each actuator. The delay of the sound card is unknown: that by which all
outputs together fit best is taken, and polarities are those relative to the majority.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from model.arrays import ComplexArray, FloatArray, IntArray
from model.calibration.sensed_plate import sensed_plate
from model.errors import InputError
from model.rig.rig import Rig
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.loopback import check_levels
from sim.desk.measuring.multisine import Estimate, Multisine, estimate, ramped
from sim.desk.measuring.single_run import run_time, settled
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


def listen(desk: Desk, card: SoundCard, *, outputs: int, level: float) -> list[Heard]:
    """Play on each output for a few seconds and tell by the sensors what it drives.

    Raises InputError, LinkError for clipped or silent sensors; InputError where the sensors do not
    tell outputs apart.
    """
    limits = desk.rig.limits
    low, high = limits.frequency_min, min(limits.frequency_max, _OCTAVES * limits.frequency_min)
    lines = np.arange(1.0, high + 1e-6, _STEP)
    sines = Multisine(lines[lines >= low], 1, card.rate, level)
    desk.check_times(seconds=run_time(_PERIODS), slew=sines.slew)
    runs = [
        settled(card, sines, output, outputs=outputs, periods=_PERIODS)
        for output in range(1, outputs + 1)
    ]
    check_levels(np.concatenate(runs), desk.sensors)
    return judged(desk, sines.frequencies, [estimate(sines, [run]) for run in runs])


def judged(desk: Desk, frequencies: FloatArray, found: Sequence[Estimate]) -> list[Heard]:
    """What each output drives, by the responses of the sensors to it at frequencies (f,) [Hz].

    Raises InputError where the sensors do not tell outputs apart.
    """
    columns, names = desk.columns, [era.name for era in desk.rig.eras]
    points = np.array([[sensor.x, sensor.y] for sensor in desk.sensors])
    model = sensed_plate(desk.rig, points, frequencies).responses().transpose(1, 0, 2)
    model = model * desk.full_levels[:, None, None]
    audible = [n for n, each in enumerate(found) if _moves(each, columns)]
    if not audible:
        raise InputError("no output moves the plate: check amplifier, its supply and cables")
    values = np.array([found[n].values[:, columns, 0] / desk.sensitivities for n in audible])
    rows, eras, signs = matched(values, model, frequencies)
    levels = _size(values[rows]) / _size(model[eras])
    levels = levels / np.median(levels)
    drives = {
        audible[row]: (int(era), bool(sign < 0), float(level))
        for row, era, sign, level in zip(rows, eras, signs, levels, strict=True)
    }
    heard = []
    for n, each in enumerate(found):
        if n not in drives:
            verdict = "dead: moves nothing; check its cable and amplifier"
            heard.append(Heard(n + 1, "", level=0.0, verdict=verdict))
            continue
        era, is_reversed, level = drives[n]
        verdict = _verdict(each, columns, is_reversed=is_reversed, level=level)
        heard.append(Heard(n + 1, names[era], is_reversed, level, verdict))
    return heard


def _moves(found: Estimate, columns: Sequence[int]) -> bool:
    share = np.abs(found.values[:, columns, 0]) / found.std[:, columns]
    return bool(np.median(share, axis=0).max() >= _MOVED)


def _verdict(found: Estimate, columns: Sequence[int], *, is_reversed: bool, level: float) -> str:
    """What is wrong with an output that moves the plate, "" for nothing."""
    rattles = found.even[columns].min() > _RATTLE
    if rattles or np.median(found.coherence[:, columns], axis=0).max() < _COHERENT:
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
    one, other = values / _size(values)[:, None, None], model / _size(model)[:, None, None]
    late = np.exp(2j * np.pi * np.outer(_DELAYS, frequencies))
    alike = np.einsum("tf,ofs,efs->toe", late, one, other.conj(), optimize=True).real
    best, rows, eras, moment = _assigned(np.abs(alike))
    for row, era in zip(rows, eras, strict=True):
        without = np.abs(alike)
        without[:, row, era] = 0
        if best - _assigned(without)[0] < _MARGIN * len(rows):
            raise InputError(
                "outputs must differ at the sensors, got two assignments that fit nearly as well; "
                "put a sensor nearer to a corner and off the plate's symmetry lines, take more "
                "than one, or omit --sensors and say which moved"
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
