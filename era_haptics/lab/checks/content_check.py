"""Simulate in time how much of a haptic file a finger will feel on a table's plate."""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.content.pattern import Pattern
from controller.content.rendition import (
    CLICK_DURATION,
    SMOOTHING,
    Rendition,
    averaged,
    rendered,
    requested_level,
)
from era_haptics.lab.checks.touch_simulator import loaded_plate
from model.answer.answer import Answer, Sensation
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus, check_level
from model.arrays import FloatArray, Point, best_of
from model.drive_modes import UNRESTRICTED
from model.finger import decibels, fingertip_points, fingertip_weights, over_threshold
from model.quantities import percent, percent_down
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.transients.base_motion import KNOT_STEP, rise
from model.transients.sampled_response import from_rest
from model.vibration import base_amplitudes

TOLERANCE_DB = 3.0
"""Tolerance of the felt level [dB]."""

RANGE_DB = 20.0
"""Range below the file's highest level that counts [dB]."""

MAX_DELAY = 0.010
"""Longest delay of the plate [s]; the whole file has one delay."""

DEFAULT_POSITIONS = (0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6)
"""Finger positions as fractions of the plate's length and width: the center, often on a nodal line,
and four positions that no symmetry of the plate relates."""

_MIN_DISTANCE = 0.04
"""Minimum distance from a quiet finger to the default positions [m]."""

_MENTIONED = 0.05  # fraction of the time or energy; smaller losses are not reported
_AFTER = 0.1  # s, simulated after the end
_MIN_RATE = 1250.0  # Hz
_RATE_FACTOR = 3.5  # sample rate over the highest frequency played
# Odd numbers of samples whose Fourier transforms are fast.
_FAST_COUNTS = sorted(3**a * 5**b * 7**c for a, b, c in product(range(13), range(9), range(8)))


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

    @property
    def sensation(self) -> Sensation:
        """Sensation of the finger."""
        return self.answer.fingers[0]

    def as_json(self) -> dict[str, Any]:
        """Return a row for `era content check --json`."""
        return {
            "time_s": self.start,
            "duration_s": self.stimulus.duration,
            "level_db_sl": self.stimulus.level_db_sl,
            "frequency_hz": self.frequency,
            "band_hz": [*self.stimulus.band_hz],
            "promised_contrast_db": self.sensation.promised_contrast_db,
        }


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
    felt: FloatArray
    """Levels felt at the finger (n,) [dB SL]."""
    kept_shares: FloatArray
    """Fraction of the time in which both levels agree, for delays of 0, 1, 2 ... steps."""
    sharpness_kept: float = 1.0
    """Fraction of the continuous part's energy that plays at about the file's frequency."""
    out_of_band_share: float = 0.0
    """Fraction of a sampled signal's energy that was left out, 0 to 1."""

    @property
    def is_counted(self) -> NDArray[np.bool_]:
        """Whether each level of the file is loud enough to count, (n,)."""
        return _is_counted(self.expected)

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
        return self.step * best_of(self.kept_shares)

    @property
    def kept_share(self) -> float:
        """Fraction of the time in which the felt level is within 3 dB of the file's, 0 to 1."""
        return float(self.kept_shares.max())

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era content check --json`."""
        stride = max(round(KNOT_STEP / self.step), 1)
        return {
            "at_m": [*self.at],
            "kept_share": self.kept_share,
            "sharpness_kept_share": self.sharpness_kept,
            "out_of_band_share": self.out_of_band_share,
            "delay_s": self.delay,
            "lost": [*self.lost],
            "level_db_sl": {
                "requested": _rounded(self.expected[::stride]),
                "given": _rounded(self.felt[::stride]),
                "step_s": stride * self.step,
            },
            "parts": [part.as_json() for part in self.parts],
            "promised_contrast_db": least_promise(self.parts),
        }


def _rounded(levels: FloatArray) -> list[float | None]:
    """Round levels for JSON; None for silence."""
    return [round(level, 2) if math.isfinite(level) else None for level in levels.tolist()]


def kept_shares(expected: FloatArray, felt: FloatArray, count: int) -> FloatArray:
    """Return the fraction of the time in which levels (n,) [dB] agree, for each delay (count,)."""
    differences = [_differences(expected, felt, delay) for delay in range(count)]
    return np.asarray(np.mean(np.abs(differences) <= TOLERANCE_DB, axis=1))


def _is_counted(expected: FloatArray) -> NDArray[np.bool_]:
    """Return whether each of the file's levels (n,) [dB] is loud enough to count."""
    return np.asarray(expected > expected.max() - RANGE_DB)


def _differences(expected: FloatArray, felt: FloatArray, delay: int) -> FloatArray:
    """Return felt minus expected level [dB] at a delay in samples, where the file is loud."""
    is_counted = _is_counted(expected)
    advanced = np.roll(felt, -delay)
    return np.asarray(advanced[is_counted] - expected[is_counted])


def least_promise(parts: Sequence[Part]) -> float | None:
    """Return the lowest promised contrast of the parts [dB]; None without quiet fingers."""
    contrasts = []
    for part in parts:
        contrast = part.sensation.promised_contrast_db
        if contrast is not None:
            contrasts.append(contrast)
    return min(contrasts, default=None)


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
    step = 1 / rate
    expected = _expected_levels(pattern, level_db_sl, count=len(accelerations), rate=rate)
    felt = _felt_levels(accelerations, rate, table, at)
    shares = kept_shares(expected, felt, int(MAX_DELAY * rate) + 1)
    differences = _differences(expected, felt, best_of(shares))
    lost = (*rendition.remarks, *_weaker(parts), *_off_level(differences))
    return CheckedContent(
        at=at,
        duration=rendition.duration,
        parts=parts,
        lost=lost,
        step=step,
        expected=expected,
        felt=felt,
        kept_shares=shares,
        sharpness_kept=rendition.sharpness_kept,
        out_of_band_share=pattern.out_of_band_share,
    )


def _expected_levels(
    pattern: Pattern, level_db_sl: float, *, count: int, rate: float
) -> FloatArray:
    """Return the levels in a file (count,) [dB SL], RMS over 20 ms, at a sample rate [Hz]."""
    times = np.arange(count) / rate
    power = 10 ** (requested_level(pattern, level_db_sl, times) / 10)
    averaged_power = np.maximum(averaged(power, 1 / rate, SMOOTHING), 0)
    return np.asarray(decibels(np.sqrt(averaged_power)))


def _felt_levels(
    accelerations: FloatArray, rate: float, table: LocalizationTable, at: Point
) -> FloatArray:
    """Return the levels (n,) [dB SL] of accelerations (n, p) [m/s²] at a fingertip's points."""
    power = 2 * over_threshold(accelerations, rate, table.threshold) ** 2
    averaged_powers = [averaged(point_power, 1 / rate, SMOOTHING) for point_power in power.T]
    weights = fingertip_weights(*at, table.plate)
    return np.asarray(decibels(weights @ np.sqrt(averaged_powers)))


def default_positions(plate: Plate, quiet: Sequence[Point] = ()) -> list[Point]:
    """Return the default finger positions [m] that are not next to a quiet finger [m]."""
    positions = []
    for length_share, width_share in DEFAULT_POSITIONS:
        position = (length_share * plate.length, width_share * plate.width)
        distances = [math.dist(position, quiet_position) for quiet_position in quiet]
        if min(distances, default=math.inf) > _MIN_DISTANCE:
            positions.append(position)
    return positions


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
    parts = tuple(_parts(rendition, table, at, quiet))
    frequencies = [part.frequency or 0.0 for part in parts]
    rate = max(_MIN_RATE, _RATE_FACTOR * max(frequencies, default=0.0))
    min_count = 2 * (rendition.duration + _AFTER) * rate
    count = _FAST_COUNTS[bisect_left(_FAST_COUNTS, min_count)]
    times = np.arange((count + 1) // 2) / rate
    plate = loaded_plate(table, [at, *quiet])
    accelerations = from_rest(
        plate,
        _signals(parts, table, times),
        plate.shapes_at(fingertip_points(*at, table.plate)),
        sample_rate=rate,
        factors=np.ones(len(table.eras), dtype=complex),
    )
    return rendition, parts, rate, accelerations


def _parts(
    rendition: Rendition, table: LocalizationTable, at: Point, quiet: Sequence[Point]
) -> Iterator[Part]:
    """Yield the parts of a rendition with their answers; equal stimuli share an answer."""
    answers: dict[Stimulus, Answer] = {}
    for start, stimulus in _stimuli(rendition):
        if stimulus not in answers:
            finger = Finger(at, stimulus)
            answers[stimulus] = answer(table, [finger], quiet=quiet, drive_mode=UNRESTRICTED)
        yield Part(start, stimulus, answers[stimulus])


def _stimuli(rendition: Rendition) -> Iterator[tuple[float, Stimulus]]:
    """Yield the stimuli of a rendition with their starts [s], the continuous part first."""
    if rendition.course is not None:
        level = rendition.level_db_sl
        yield 0.0, Stimulus(level, rendition.band, course=rendition.course)
    for click in rendition.clicks:
        yield click.time, Stimulus(click.level_db_sl, click.band, CLICK_DURATION)


def _signals(parts: Sequence[Part], table: LocalizationTable, times: FloatArray) -> FloatArray:
    """Return the drive signals of all ERAs (eras, n), 1 = full stroke."""
    signals = np.zeros((len(table.eras), len(times)))
    strokes = np.array([era.full_level for era in table.eras])
    for part in parts:
        layer = part.answer.layers[0]
        course = part.stimulus.course
        elapsed = times - part.start
        if course is None:
            start, end = np.searchsorted(elapsed, [0.0, CLICK_DURATION + layer.ramp])
            during = slice(start, end)
            elapsed = elapsed[during]
            fall = rise(elapsed - CLICK_DURATION, layer.ramp)
            envelope = rise(elapsed, layer.ramp) - fall
        else:
            during = slice(None)
            envelope = course.at(elapsed)
        for frequency, bases in zip(*base_amplitudes(layer.excitation, table.eras), strict=True):
            tone = envelope * np.exp(2j * np.pi * frequency * elapsed)
            signals[:, during] += ((bases / strokes)[:, None] * tone).imag
    return signals


def _off_level(differences: FloatArray) -> Iterator[str]:
    """Describe where the felt level differs from the file's by more than the tolerance."""
    stronger = "stronger than wanted: the plate builds up and rings at this position"
    weaker = "weaker than wanted: the plate follows too slowly at this position"
    for excess, description in ((differences, stronger), (-differences, weaker)):
        share = float(np.mean(excess > TOLERANCE_DB))
        if share > _MENTIONED:
            yield f"{percent(share)} of the time, {description}, by up to {excess.max():.1f} dB"


def _weaker(parts: Sequence[Part]) -> Iterator[str]:
    """Describe the parts that are weaker than in the file."""
    continuous = [part for part in parts if part.stimulus.course]
    taps = [part for part in parts if not part.stimulus.course]
    for name, kind_parts in (("continuous part", continuous), ("taps", taps)):
        losses_db = [part.sensation.lowered_db for part in kind_parts]
        count = np.count_nonzero(losses_db)
        if count:
            total = len(kind_parts)
            subject = name if total == 1 else f"{count} of {total} {name}"
            yield f"{subject} up to {max(losses_db):.1f} dB weaker: the plate's limit here"
