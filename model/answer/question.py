"""Question to the tone search (`Contents`), and its result (`Tones`).

The C kernel (`model.answer.kernel_question`) and its numpy reference (`model.answer.tone_search`)
both take `Contents` and the constants below, and return `Tones`.

Each of K contents has its own target fingers, and must not be felt by other fingers. Contents have
different frequencies, so their powers add. Each content is searched separately, with its fingers as
targets and all others quiet, on the same plate with fingers. (Weights shared between contents would
gain 0.3 dB at most.) A search returns a few candidates. Among all combinations of candidates, the
best has the highest contrast at the worst finger on drawn plates. Promises are computed with other
draws, the same for all tones. The contrast at finger k is

    C_k = g_k own_k / sqrt(max_p sum_j g_j^2 power_j(p)),  j other contents, p points of finger k,

and at a quiet finger the ratio of the weakest content to all contents together. A single content
uses the tone with the highest contrast at its level.

Because contents differ in frequency, a contrast depends on the thresholds. The lowest contrast
over the table's threshold sets counts, both in the choice and in the promise. The weights of a
content do not depend on the threshold set. The levels of its second harmonics do; candidates are
evaluated with the set in which these are highest.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from model.answer.envelope import ONSET_RAMP, Course, pulse_ramp, swings_of_pulse
from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray, Point
from model.drive_modes import UNRESTRICTED
from model.structure.sources import Source
from model.transients.excursions import Swing
from model.vibration import Excitation, Tone

PROMISED_PERCENTILE = 9
"""Percentile of the drawn plates that is promised.

Corresponds to about the tenth percentile of exactly solved plates: effects beyond first order in
parameters other than the thickness cost some tenths of a decibel.
"""

REACHED = 1 - 1e-5
"""Fraction of a level that counts as reached."""

KEPT, MISSING = 16, 4
"""Number of frequencies searched for a single content, and how many can miss the level.

The first is a multiple of the kernels' batch size. Frequencies with the highest bounds |c^H w| /
sqrt(w^H R w) of w = R^-1 c are searched, with R the mean over the quiet fingers: a bound takes one
system of equations, a search several.
"""

MIN_CANDIDATES, MAX_CANDIDATES = 4, 32
"""Number of candidates for a single content, and the maximum over all bands of any content.

This many according to the mean over fingertips, and as many according to their points.
"""

MAX_COMBINATIONS, PRUNING_STEP = 200, 4
"""Combinations of candidates kept for the next content, and the step of draws in between.

Fewer are kept for more than four contents, so that time grows with the square of their number.
"""

_ROUNDING = 1e-6  # of single precision


@dataclass(frozen=True)
class Stream:
    """Content for some fingers."""

    targets: tuple[int, ...]
    """Its fingers, by index."""
    level_db_sl: float
    bands: tuple[tuple[int, int], ...]
    """First row of the table's frequencies and one past the last, for each allowed band.

    There is one band unless contents can swap theirs.
    """
    priority: int = 0
    """Higher priorities get the stroke first."""
    duration: float | None = None
    """Time over which the level is felt [s], None for a continuous content."""
    limit_db_sl: float | None = None
    """Upper limit of a level that the other fingers set, None for a fixed level."""
    course: Course | None = None
    """Envelope over the duration, whose maximum has the level."""


@dataclass(frozen=True, eq=False)
class Contents:
    """Question for the tones of K contents for k fingers on a plate."""

    places: tuple[Point, ...]
    """Positions of all fingers [m], then of the additional patches of hands."""
    loads: tuple[float, ...]
    """Load of each finger relative to the rig's fingertip, empty for 1 each."""
    streams: tuple[Stream, ...]
    """The contents."""
    quiet: tuple[int, ...]
    """Indices of fingers that should feel nothing; others without a content are unprotected."""
    apart_hz: float = 0.0
    """Minimum distance between the contents' frequencies [Hz], if their bands allow it."""
    background: Complex64Array | None = None
    """Form of the rest of the plate at all of the table's frequencies; None if there are other
    fingers."""
    drive_mode: str = UNRESTRICTED
    """Drive mode; all except UNRESTRICTED play a single content."""
    is_shaped: bool = False
    """Whether onsets are shaped, which leaves no ringing."""
    least_ramp: float = 0.0
    """Minimum ramp of short contents [s], whose ramp is otherwise a quarter of their duration."""
    avoided: tuple[int, ...] = ()
    """Rows of the table's frequencies that no content can use."""

    @property
    def is_ranked(self) -> bool:
        """Whether only KEPT frequencies are searched first: for a single content of a single
        finger."""
        first = self.streams[0]
        return len(self.streams) == len(first.targets) == len(first.bands) == 1 <= len(self.quiet)

    @property
    def candidates(self) -> int:
        """Number of candidates per content and band, by means and by points."""
        content_count = len(self.streams)
        band_count = len(self.streams[0].bands)
        wanted = MIN_CANDIDATES + content_count // 2
        return max(1, min(wanted, MAX_CANDIDATES // band_count))

    @property
    def combinations(self) -> int:
        """Number of combinations of candidates that are kept."""
        return min(MAX_COMBINATIONS, 4 * MAX_COMBINATIONS // len(self.streams))

    @property
    def rows(self) -> IntArray:
        """Rows of the table's frequencies that contents can use, ascending, (f,)."""
        bands = [np.arange(*band) for stream in self.streams for band in stream.bands]
        return np.setdiff1d(np.concatenate(bands), self.avoided)

    @property
    def levels(self) -> Float32Array:
        """Amplitude of each content relative to the threshold, (K,)."""
        levels = [10 ** (stream.level_db_sl / 20) for stream in self.streams]
        return np.array(levels, dtype=np.float32)

    def others(self, number: int) -> list[int]:
        """Return the fingers from which the content with a given number is kept."""
        fingers = {*self.quiet}
        for stream in self.streams:
            fingers.update(stream.targets)
        return sorted(fingers.difference(self.streams[number].targets))

    def is_pulse(self, stream: Stream) -> bool:
        """Return whether a content has a constant level over a duration, with plain ramps."""
        return stream.duration is not None and stream.course is None and not self.is_shaped

    def ramp(self, stream: Stream) -> float:
        """Return the duration [s] of a content's plain onset and ending."""
        if stream.duration is None or not self.is_pulse(stream):
            return ONSET_RAMP
        return max(pulse_ramp(stream.duration), self.least_ramp)

    def swings(self, stream: Stream) -> tuple[Swing, ...]:
        """Return the possible envelopes of a content's level; none for a continuous content."""
        if stream.course is not None:
            return stream.course.swings
        if stream.duration is not None and self.is_pulse(stream):
            return swings_of_pulse(stream.duration, self.ramp(stream))
        return ()

    def of_first(self, count: int) -> Self:
        """Return the question for the first `count` fingers alone."""
        streams = list[Stream]()
        for stream in self.streams:
            targets = [finger for finger in stream.targets if finger < count]
            streams.append(replace(stream, targets=tuple(targets)))
        quiet = [finger for finger in self.quiet if finger < count]
        return replace(
            self,
            places=self.places[:count],
            loads=self.loads[:count],
            streams=tuple(streams),
            quiet=tuple(quiet),
        )


@dataclass(frozen=True, eq=False)
class Tones:
    """m tones of K contents, one or more each, and the resulting sensation of k fingers.

    For s sets of thresholds, the rig's own first.
    """

    rows: list[int]
    """Row (m,) of each tone's frequency in the table."""
    weights: Sequence[Sequence[complex]]
    """Weights of the ERAs (m, n), up to full stroke."""
    gains: list[float]
    """Gain (m,) of each tone for its level, within the stroke."""
    owners: Sequence[int]
    """Content (m,) of each tone."""
    contrast_db: Sequence[Sequence[float]]
    """Contrast (k, 3): nominal, median of the drawn plates, and promised.

    The lowest over the threshold sets; NaN without other contents or fingers.
    """
    level_db_sl: Sequence[Sequence[float]]
    """Level (k, 2) of a finger's own content relative to the rig's own threshold set: nominal and
    promised."""
    foreign_db_sl: Sequence[Sequence[float]]
    """Upper bound of the level (k, s) of other contents on 90 % of plates, by each threshold set.

    NaN at fingers that neither feel a content nor are quiet.
    """
    worst_db: float
    """Promised contrast of the worst finger, NaN for a single finger."""
    stroke_factor: float
    """Smallest factor on the gains to fit the stroke, 1 for none."""
    is_apart: bool
    """Whether the frequencies keep the minimum distance."""

    def excitations(
        self,
        content: int,
        eras: Sequence[Source],
        frequencies: FloatArray,
        highest_drives: FloatArray,
    ) -> list[Excitation]:
        """Return the excitations of a content, one per tone, the carrier first.

        frequencies (f,) [Hz] and highest_drives (f, eras) are the table's. The strongest ERA, or
        the first ERA nearly as strong, has phase zero.
        """
        excitations = list[Excitation]()
        names = [era.name for era in eras]
        for number, owner in enumerate(self.owners):
            if owner != content:
                continue
            row = self.rows[number]
            gain = self.gains[number]
            weights = self.weights[number]
            frequency = float(frequencies[row])
            # Python's own numbers: one by one, numpy's are ten times slower.
            drives = highest_drives[row].tolist()
            rotation = _rotation_to_zero_phase(weights)
            tones: dict[str, Tone] = {}
            for name, highest, weight in zip(names, drives, weights, strict=True):
                if weight != 0:
                    rotated = _without_rounding(weight * rotation)
                    amplitude = gain * min(abs(rotated), 1.0) * highest
                    tones[name] = Tone(frequency, amplitude, cmath.phase(rotated))
            excitations.append(tones)
        return excitations

    @classmethod
    def none(cls, finger_count: int, set_count: int) -> "Tones":
        """Return no tones, for a number of fingers and of threshold sets."""
        return cls(
            rows=[],
            weights=[],
            gains=[],
            owners=[],
            contrast_db=[(math.inf,) * 3] * finger_count,
            level_db_sl=[(-math.inf,) * 2] * finger_count,
            foreign_db_sl=[(-math.inf,) * set_count] * finger_count,
            worst_db=math.nan,
            stroke_factor=1.0,
            is_apart=True,
        )


def _rotation_to_zero_phase(weights: Sequence[complex]) -> complex:
    """Return the phase factor that gives the first of the strongest weights phase zero."""
    strong = (1 - NEARLY) * max(map(abs, weights))
    strongest = next(weight for weight in weights if abs(weight) >= strong)
    return strongest.conjugate() / abs(strongest)


def _without_rounding(weight: complex) -> complex:
    """Return a weight whose phase is zero if it is zero but for rounding."""
    is_real = weight.real > 0 and abs(weight.imag) < _ROUNDING * weight.real
    return weight.real if is_real else weight
