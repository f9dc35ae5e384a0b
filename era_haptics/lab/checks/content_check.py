"""Simulate in time how much of a haptic file a finger will feel on a table's plate."""

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
"""Tolerance of the felt level [dB]; range below the file's highest level that counts [dB]; longest
delay of the plate, one for the whole file [s]."""

DEFAULT_POSITIONS = (0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6)
"""Finger positions as fractions of the plate's length and width: the center, often on a nodal line,
and four positions that no symmetry of the plate relates."""

_MIN_DISTANCE = 0.04
"""Minimum distance from a quiet finger to the default positions [m]."""

_MENTIONED = 0.05  # fraction of the time or energy; smaller losses are not reported
_AFTER = 0.1  # s, simulated after the end
_MIN_RATE, _RATE = 1250.0, 3.5  # Hz; multiple of the highest frequency played
# Odd numbers of samples whose Fourier transforms are fast.
_FAST = sorted(3**a * 5**b * 7**c for a, b, c in product(range(13), range(9), range(8)))


@dataclass(frozen=True)
class Part:
    """One stimulus of a content, its start [s], and its answer."""

    start: float
    stimulus: Stimulus
    answer: Answer

    @property
    def frequency(self) -> float | None:
        """Carrier frequency [Hz]; None for several carriers."""
        return self.answer.layers[0].frequency


@dataclass(frozen=True, eq=False)
class CheckedContent:
    """Content as felt at one finger."""

    at: Point
    """Of the finger [m]."""
    duration: float
    """[s]"""
    parts: tuple[Part, ...]
    """The continuous part, if any, and the taps."""
    lost: tuple[str, ...]
    """Changes and omissions, one sentence each."""
    step: float
    """Interval of the levels [s]."""
    expected: FloatArray
    """Levels in the file (n,) [dB SL], RMS over 20 ms."""
    given: FloatArray
    """Levels felt at the finger (n,) [dB SL]."""
    kept: FloatArray
    """Fraction of the time in which both levels agree, for delays of 0, 1, 2 ... steps."""
    sharpness_kept: float = 1.0
    """Fraction of the continuous part's energy that plays at about the file's frequency."""
    out_of_band_share: float = 0.0
    """Fraction of a sampled signal's energy that was left out, 0 to 1."""

    @property
    def headline(self) -> str:
        """Summarize the kept percentages, rounded down, and the energy left out of a sampled
        signal."""
        level = f"level {percent_down(self.kept_share)} kept"
        sharpness = f"sharpness {percent_down(self.sharpness_kept)} kept"
        if self.out_of_band_share < _MENTIONED:
            return f"{level}, {sharpness}"
        return f"{level}, {sharpness}, {percent(self.out_of_band_share)} of the energy left out"

    @property
    def delay(self) -> float:
        """Delay of the plate [s] at which the most is kept."""
        return self.step * best_of(self.kept)

    @property
    def kept_share(self) -> float:
        """Fraction of the time in which the felt level is within 3 dB of the file's, 0 to 1."""
        return float(self.kept.max())

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era content check --json`."""
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
    """Return the fraction of the time in which levels (n,) [dB] agree, for each delay (count,)."""
    late = [_deviations(expected, given, each) for each in range(count)]
    return np.asarray(np.mean(np.abs(late) <= TOLERANCE_DB, axis=1))


def _deviations(expected: FloatArray, given: FloatArray, late: int) -> FloatArray:
    """Return felt minus expected level [dB] at a delay in samples, where the file is loud."""
    counts = expected > expected.max() - RANGE_DB
    return np.asarray(np.roll(given, -late)[counts] - expected[counts])


def least_promise(parts: Sequence[Part]) -> float | None:
    """Return the lowest promised contrast of the parts [dB]; None without quiet fingers."""
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
    """Simulate a pattern at one finger on a table's plate, loaded by all fingers.

    level_db_sl: level of intensity 1; at [m]: position of the finger; quiet [m]: positions of
    fingers that should feel nothing. With quiet fingers the pattern is smoothed. Raises InputError
    for fingers off the plate or too close together.
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
    """Return the default finger positions [m] that are not next to a quiet finger [m]."""
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
    """Simulate a pattern at one finger; same arguments and errors as `check_content`.

    Returns the rendition, its parts, the sample rate [Hz], and accelerations (n, p) [m/s²] at the
    points of the fingertip, which continue for at least 0.1 s after the end.
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
    """Return the drive signals of all ERAs (eras, n), 1 = full stroke."""
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
    """Describe where the felt level differs from the file's by more than the tolerance."""
    for by, how in (
        (deviations, "stronger than wanted: the plate builds up and rings at this position"),
        (-deviations, "weaker than wanted: the plate follows too slowly at this position"),
    ):
        if (share := float(np.mean(by > TOLERANCE_DB))) > _MENTIONED:
            yield f"{percent(share)} of the time, {how}, by up to {by.max():.1f} dB"


def _weaker(parts: Sequence[Part]) -> Iterator[str]:
    """Describe the parts that are weaker than in the file."""
    continuous = [part for part in parts if part.stimulus.course]
    taps = [part for part in parts if not part.stimulus.course]
    for kind, of_kind in (("continuous part", continuous), ("taps", taps)):
        lowered = [part.answer.fingers[0].lowered_db for part in of_kind]
        count = np.count_nonzero(lowered)
        if count:
            subject = kind if len(of_kind) == 1 else f"{count} of {len(of_kind)} {kind}"
            yield f"{subject} up to {max(lowered):.1f} dB weaker: the plate's limit here"


_REQUESTED, _FELT = "#888888", "#0b5cad"
_FAINT = 0.1  # fraction of the highest amplitude; weaker frequencies are not drawn


def content_figure(pattern: Pattern, checked: CheckedContent) -> Figure:
    """Draw level and frequency over time: the file in dashed gray, felt vibration in blue."""
    figure = Figure(figsize=(6.9, 4.0), layout="constrained")
    levels, tones = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    times = np.asarray(checked.step * np.arange(len(checked.expected)), dtype=float)
    top = float(checked.expected.max())
    low, high = checked.expected - TOLERANCE_DB, checked.expected + TOLERANCE_DB
    counts = checked.expected > top - RANGE_DB
    levels.fill_between(times, low, high, where=counts, color=_REQUESTED, alpha=0.3, lw=0)
    levels.plot(
        times, checked.expected, color=_REQUESTED, lw=1.2, ls="--", label="requested (band: ±3 dB)"
    )
    levels.plot(times - checked.delay, checked.given, color=_FELT, lw=1.5, label="felt")
    levels.set_ylim(top - RANGE_DB, top + 2 * TOLERANCE_DB)
    levels.set_ylabel("level / dB SL")
    late = f"felt {1000 * checked.delay:.0f} ms later"
    levels.set_title(f"{checked.headline}, {late}", fontsize=10)
    levels.legend(loc="best", fontsize=9)
    _draw_frequencies(tones, pattern, checked, times)
    tones.margins(y=0.15)  # room for the legend between the curves
    tones.legend(loc="best", fontsize=8)
    tones.set_xlim(0, checked.duration)
    tones.set_xlabel("time / s")
    tones.set_ylabel("frequency / Hz")
    return figure


def _draw_frequencies(
    axes: Axes, pattern: Pattern, checked: CheckedContent, times: FloatArray
) -> None:
    """Draw the frequencies of the file and of the felt vibration at times (n,) [s]."""
    if pattern.intensity:
        hertz = hertz_of(curve_at(pattern.sharpness, times))
        is_silent = curve_at(pattern.intensity, times, beyond=0.0) <= 0
        requested = np.where(is_silent, np.nan, hertz)
        axes.plot(times, requested, color=_REQUESTED, lw=1.2, ls="--", label="requested")
    if pattern.transients:
        starts = [tap.time for tap in pattern.transients]
        sharpness = np.array([tap.sharpness for tap in pattern.transients])
        axes.plot(starts, hertz_of(sharpness), "x", color=_REQUESTED, label="requested tap")
    label = "felt"
    for part in checked.parts:
        if part.frequency is None:
            continue
        course = part.stimulus.course
        if course is None:
            end = part.start + (part.stimulus.duration or 0.0)
            axes.plot([part.start, end], [part.frequency] * 2, color=_FELT, lw=2, label=label)
        else:
            is_faint = course.at(times - part.start) < _FAINT
            hertz = np.where(is_faint, np.nan, part.frequency)
            axes.plot(times, hertz, color=_FELT, lw=2, label=label)
        label = "_nolegend_"  # one entry for all parts
