"""How much of a content file a finger will feel, simulated in time on the plate of a table."""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.content.pattern import Pattern, curve_at, hertz_of
from controller.content.rendition import (
    CLICK_DURATION,
    SMOOTHING,
    Rendition,
    averaged,
    rendered,
    requested_level,
)
from era_haptics.lab.checks.layout_check import loaded_plate
from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus, check_level
from model.arrays import FloatArray, Point, best_of
from model.drive_modes import UNRESTRICTED
from model.finger import decibels, fingertip_points, fingertip_weights, over_threshold
from model.quantities import percent, percent_down
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.transients.base_motion import KNOT_STEP, rise
from model.transients.time_response import from_rest
from model.vibration import base_amplitudes

TOLERANCE_DB, RANGE_DB, MAX_DELAY = 3.0, 20.0, 0.010
"""What is within so many dB of what is expected is kept; that counts within so many dB of
its highest; a plate may be late by so long [s], the same for all of a file."""

DEFAULT_POSITIONS = (0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6)
"""Positions of a finger as shares of the plate's sides: the middle, often on a nodal line, and four
that no symmetry of a plate relates."""

_MIN_DISTANCE = 0.04
"""Distance [m] from a quiet finger to the default positions."""

_MENTIONED = 0.05  # share of the time off its level, or of energy, that is lost without a word
_AFTER = 0.1  # s; followed after the end
_MIN_RATE, _RATE = 1250.0, 3.5  # Hz; and by the highest frequency that plays
# Odd numbers of samples whose Fourier transforms are fast.
_FAST = sorted(3**a * 5**b * 7**c for a, b, c in product(range(13), range(9), range(8)))


@dataclass(frozen=True)
class Part:
    """One stimulus of a content from a time [s] on, and its answer."""

    start: float
    stimulus: Stimulus
    answer: Answer

    @property
    def frequency(self) -> float | None:
        """Of its carrier [Hz]; None of several."""
        return self.answer.layers[0].frequency


@dataclass(frozen=True, eq=False)
class CheckedContent:
    """Content at a finger as it will be felt."""

    at: Point
    """Of the finger [m]."""
    duration: float
    """[s]"""
    parts: tuple[Part, ...]
    """The continuous part, if there is one, and the taps."""
    lost: tuple[str, ...]
    """What was changed or left out, in words."""
    step: float
    """Time [s] between two levels."""
    expected: FloatArray
    """Levels (n,) [dB SL] that the file asks for, root mean squares over 20 ms."""
    given: FloatArray
    """Levels (n,) [dB SL] that the finger feels."""
    kept: FloatArray
    """Shares of the time in which both agree, for delays of 0, 1, 2 ... steps."""
    sharpness_kept: float = 1.0
    """Share of the continuous part, by its energy, that plays at about the file's frequency."""
    out_of_band_share: float = 0.0
    """Share of a sampled signal's energy that was left out, 0 to 1."""

    @property
    def headline(self) -> str:
        """The kept shares in words, rounded down, and what was left out of a signal."""
        level = f"level {percent_down(self.kept_share)} kept"
        sharpness = f"sharpness {percent_down(self.sharpness_kept)} kept"
        if self.out_of_band_share < _MENTIONED:
            return f"{level}, {sharpness}"
        return f"{level}, {sharpness}, {percent(self.out_of_band_share)} of the energy left out"

    @property
    def delay(self) -> float:
        """By how much the plate is late [s]: with it most is kept."""
        return self.step * best_of(self.kept)

    @property
    def kept_share(self) -> float:
        """Share of the time in which what is felt is within 3 dB of what is expected, 0 to 1."""
        return float(self.kept.max())

    def as_json(self) -> dict[str, Any]:
        """Return it as `era content check --json` prints it."""
        every = max(round(KNOT_STEP / self.step), 1)
        expected, given = (
            [round(each, 2) if np.isfinite(each) else None for each in levels[::every].tolist()]
            for levels in (self.expected, self.given)
        )
        return {
            "at_m": [*self.at],
            "kept_share": self.kept_share,
            "sharpness_kept_share": self.sharpness_kept,
            "out_of_band_share": self.out_of_band_share,
            "delay_s": self.delay,
            "lost": [*self.lost],
            "level_db_sl": {"requested": expected, "given": given, "step_s": every * self.step},
            "parts": [
                {
                    "time_s": each.start,
                    "duration_s": each.stimulus.duration,
                    "level_db_sl": each.stimulus.level_db_sl,
                    "frequency_hz": each.frequency,
                    "band_hz": [*each.stimulus.band_hz],
                    "promised_contrast_db": each.answer.fingers[0].promised_contrast_db,
                }
                for each in self.parts
            ],
            "promised_contrast_db": least_promise(self.parts),
        }


def kept_shares(expected: FloatArray, given: FloatArray, count: int) -> FloatArray:
    """Shares of the time in which levels [dB] (n,) agree, for delays of what is given (count,)."""
    late = [_deviations(expected, given, each) for each in range(count)]
    return np.asarray(np.mean(np.abs(late) <= TOLERANCE_DB, axis=1))


def _deviations(expected: FloatArray, given: FloatArray, late: int) -> FloatArray:
    """What is felt so many samples late above what is expected [dB], where that counts."""
    counts = expected > expected.max() - RANGE_DB
    return np.asarray(np.roll(given, -late)[counts] - expected[counts])


def least_promise(parts: Sequence[Part]) -> float | None:
    """The least promised contrast of parts [dB] to what quiet fingers feel; None without these."""
    found = [each.answer.fingers[0].promised_contrast_db for each in parts]
    return min((each for each in found if each is not None), default=None)


def check_content(
    pattern: Pattern,
    table: LocalizationTable,
    level_db_sl: float,
    *,
    at: Point,
    quiet: Sequence[Point] = (),
) -> CheckedContent:
    """Play a pattern at a finger, in time on a table's plate with the fingers' weight.

    level_db_sl: of intensity 1; at, quiet [m]: of the finger, and of others that are to feel
    nothing, beside which it is smoothed. Raises InputError for fingers off the plate or too close.
    """
    rendition, parts, rate, accelerations = play_content(
        pattern, table, level_db_sl, at=at, quiet=quiet
    )
    times = np.arange(len(accelerations)) / rate
    power = 2 * over_threshold(accelerations, rate, table.threshold) ** 2
    over = [averaged(each, 1 / rate, SMOOTHING) for each in power.T]
    given = decibels(fingertip_weights(*at, table.plate) @ np.sqrt(over))
    power = 10 ** (requested_level(pattern, level_db_sl, times) / 10)
    expected = decibels(np.sqrt(np.maximum(averaged(power, 1 / rate, SMOOTHING), 0)))
    kept = kept_shares(expected, given, int(MAX_DELAY * rate) + 1)
    deviations = _deviations(expected, given, best_of(kept))
    lost = (*rendition.remarks, *_weaker(parts), *_off_level(deviations))
    return CheckedContent(
        at=at,
        duration=rendition.duration,
        parts=parts,
        lost=lost,
        step=1 / rate,
        expected=expected,
        given=given,
        kept=kept,
        sharpness_kept=rendition.sharpness_kept,
        out_of_band_share=pattern.out_of_band_share,
    )


def default_positions(plate: Plate, quiet: Sequence[Point] = ()) -> list[Point]:
    """Return the default positions of a finger [m] that are not next to a quiet one [m]."""
    positions = [(u * plate.length, v * plate.width) for u, v in DEFAULT_POSITIONS]
    return [
        position
        for position in positions
        if all(math.dist(position, other) > _MIN_DISTANCE for other in quiet)
    ]


def play_content(
    pattern: Pattern,
    table: LocalizationTable,
    level_db_sl: float,
    *,
    at: Point,
    quiet: Sequence[Point] = (),
) -> tuple[Rendition, tuple[Part, ...], float, FloatArray]:
    """Play a pattern at a finger in time; arguments and errors as of `check_content`.

    Returns its rendition and the parts of that, the sample rate [Hz], and accelerations (n, p)
    [m/s²] at the points of the fingertip, by 0.1 s or more longer than the rendition.
    """
    check_level(level_db_sl)
    rendition = rendered(pattern, level_db_sl, table.frequencies)
    if quiet:
        rendition = rendition.smoothed()
    stimuli = [
        (each.time, Stimulus(each.level_db_sl, each.band, CLICK_DURATION))
        for each in rendition.clicks
    ]
    if rendition.course is not None:
        lasting = Stimulus(rendition.level_db_sl, rendition.band, course=rendition.course)
        stimuli.insert(0, (0.0, lasting))
    answered = partial(answer, table, quiet=quiet, drive_mode=UNRESTRICTED)
    found = {stimulus: answered([Finger(at, stimulus)]) for _, stimulus in stimuli}
    parts = tuple(Part(start, each, found[each]) for start, each in stimuli)
    highest = max((each.frequency or 0.0 for each in parts), default=0.0)
    rate = max(_MIN_RATE, _RATE * highest)
    samples = (rendition.duration + _AFTER) * rate
    times = np.arange((_FAST[bisect_left(_FAST, 2 * samples)] + 1) // 2) / rate
    plate = loaded_plate(table, [at, *quiet])
    moved = from_rest(
        plate,
        _signals(parts, table, times),
        plate.shapes_at(fingertip_points(*at, table.plate)),
        sample_rate=rate,
        factors=np.ones(len(table.eras), dtype=complex),
    )
    return rendition, parts, rate, moved


def _signals(parts: Sequence[Part], table: LocalizationTable, times: FloatArray) -> FloatArray:
    """What moves the ERAs, in full strokes, (eras, n)."""
    signals = np.zeros((len(table.eras), len(times)))
    strokes = np.array([era.full_level for era in table.eras])
    for part in parts:
        (layer, course), tau = (part.answer.layers[0], part.stimulus.course), times - part.start
        if course is None:
            during = slice(*np.searchsorted(tau, [0.0, CLICK_DURATION + layer.ramp]))
            tau = tau[during]
            shares = rise(tau, layer.ramp) - rise(tau - CLICK_DURATION, layer.ramp)
        else:
            during, shares = slice(None), course.at(tau)
        for frequency, bases in zip(*base_amplitudes(layer.excitation, table.eras), strict=True):
            tone = shares * np.exp(2j * np.pi * frequency * tau)
            signals[:, during] += ((bases / strokes)[:, None] * tone).imag
    return signals


def _off_level(deviations: FloatArray) -> Iterator[str]:
    """Where what is felt is off what is wanted by more than the tolerance, in words."""
    for by, how in (
        (deviations, "stronger than wanted: the plate builds up and rings at this place"),
        (-deviations, "weaker than wanted: the plate follows too slowly at this place"),
    ):
        if (share := float(np.mean(by > TOLERANCE_DB))) > _MENTIONED:
            yield f"{percent(share)} of the time, {how}, by up to {by.max():.1f} dB"


def _weaker(parts: Sequence[Part]) -> Iterator[str]:
    """What is weaker than asked, in words."""
    continuous = [part for part in parts if part.stimulus.course]
    taps = [part for part in parts if not part.stimulus.course]
    for kind, of_kind in (("continuous part", continuous), ("taps", taps)):
        lowered = [part.answer.fingers[0].lowered_db for part in of_kind]
        count = np.count_nonzero(lowered)
        if count:
            subject = kind if len(of_kind) == 1 else f"{count} of {len(of_kind)} {kind}"
            yield f"{subject} up to {max(lowered):.1f} dB weaker: all that the plate allows here"


_REQUESTED, _FELT = "#888888", "#0b5cad"
_FAINT = 0.1  # share of the highest amplitude below which no frequency is drawn


def content_figure(pattern: Pattern, checked: CheckedContent) -> Figure:
    """Draw level and frequency over time: of the file in grey, what is felt of it in blue."""
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    levels, tones = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    times = np.asarray(checked.step * np.arange(len(checked.expected)), dtype=float)
    top = float(checked.expected.max())
    low, high = checked.expected - TOLERANCE_DB, checked.expected + TOLERANCE_DB
    counts = checked.expected > top - RANGE_DB
    levels.fill_between(times, low, high, where=counts, color=_REQUESTED, alpha=0.3, lw=0)
    levels.plot(times, checked.expected, color=_REQUESTED, lw=1, label="asked, within 3 dB")
    levels.plot(times - checked.delay, checked.given, color=_FELT, lw=1.2, label="felt")
    levels.set_ylim(top - RANGE_DB, top + 2 * TOLERANCE_DB)
    levels.set_ylabel("level / dB SL")
    late = f"felt {1000 * checked.delay:.0f} ms later"
    levels.set_title(f"{checked.headline}, {late}", fontsize=10)
    levels.legend(loc="best", fontsize=8)
    _draw_frequencies(tones, pattern, checked, times)
    tones.set_xlim(0, checked.duration)
    tones.set_xlabel("time / s")
    tones.set_ylabel("frequency / Hz")
    return figure


def _draw_frequencies(
    axes: Axes, pattern: Pattern, checked: CheckedContent, times: FloatArray
) -> None:
    """Draw frequencies at times [s] (n,) wherever something plays: of the file, and felt."""
    if pattern.intensity:
        hertz = hertz_of(curve_at(pattern.sharpness, times))
        is_silent = curve_at(pattern.intensity, times, beyond=0.0) <= 0
        axes.plot(times, np.where(is_silent, np.nan, hertz), color=_REQUESTED, lw=1)
    starts = [tap.time for tap in pattern.transients]
    sharpness = np.array([tap.sharpness for tap in pattern.transients])
    axes.plot(starts, hertz_of(sharpness), "x", color=_REQUESTED)
    for part in checked.parts:
        if part.frequency is None:
            continue
        course = part.stimulus.course
        if course is None:
            end = part.start + (part.stimulus.duration or 0.0)
            axes.plot([part.start, end], [part.frequency] * 2, color=_FELT, lw=2)
        else:
            is_faint = course.at(times - part.start) < _FAINT
            hertz = np.where(is_faint, np.nan, part.frequency)
            axes.plot(times, hertz, color=_FELT, lw=2)
