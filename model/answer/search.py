"""Contents for fingers on a plate, and the tones that are found for them.

Content j for its fingers is the question "these are targets, all others quiet", and K contents are
K searches over one load of the plate: weights that share the prices of the fingers gain 0.3 dB at
most. Tones of different frequencies add in power. The combination of a few candidates each is
chosen by the worst finger on drawn plates; the promise is of other draws, the same for all tones.

    C_k = g_k own_k / sqrt(max_p sum_j g_j^2 power_j(p)),  j other contents, p points of finger k

and for a quiet finger the weakest content counts, over all contents. An only content has the tone
of the highest contrast at its level. Contents differ in frequency, so that this depends on whose
thresholds their amplitudes are above: the least over the table's sets of thresholds counts, of
combinations as of the promise. Weights of a content, of one frequency, do not depend on the set;
its second harmonics do, and candidates are judged by the set to which these are loudest.

`model.answer.search_in_c` finds them in C, `model.answer.search_in_numpy` in numpy.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.answer.course import Course
from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray, Point
from model.drive_modes import UNRESTRICTED
from model.structure.attachments import Source
from model.vibration import Excitation, Tone

PROMISED_PERCENTILE = 9
"""Percentile of the draws that is promised.

It is about the tenth of plates solved exactly: what is beyond the first order in other parameters
than the thickness costs some tenths of a decibel.
"""

KEPT, MISSING = 16, 4
"""Frequencies that are searched for an only content, a multiple of what kernels take at once, and
how many of them may miss the level.

Those of the highest bounds |c^H w| / sqrt(w^H R w) of w = R^-1 c, R the mean over the quiet
fingers: one system of equations where a search takes several.
"""

MIN_CANDIDATES, MAX_CANDIDATES = 4, 32
"""Candidates of a content by the mean over fingertips, and as many by their points: of an only
content, and of any in all its bands."""

MAX_COMBINATIONS, PRUNING_STEP = 200, 4
"""Combinations of candidates that are kept for the next content and the choice, by some draws; of
more than four contents fewer, so that time grows with the square of their number."""

APART_HZ = 30.0
"""Distance of the frequencies of two contents: nearer ones would be felt to beat."""

REACHED = 1 - 1e-5
"""Of a level, what counts as reached."""

_ROUNDING = 1e-6  # of single precision


@dataclass(frozen=True)
class Stream:
    """A content for fingers, by index, at a level; higher priorities take the stroke first.

    bands: of the table's frequencies that it may have the first and one past the last, by row, for
    each band (one unless bands may be exchanged); duration [s]: over which the level is felt, None
    for one that lasts; limit_db_sl: up to which it is as strong as the others allow, None for the
    level itself; course: over the duration, whose highest share has the level.
    """

    targets: tuple[int, ...]
    level_db_sl: float
    bands: tuple[tuple[int, int], ...]
    priority: int = 0
    duration: float | None = None
    limit_db_sl: float | None = None
    course: Course | None = None


@dataclass(frozen=True, eq=False)
class Contents:
    """K contents for k fingers on a plate, some of which are quiet; all others are not protected.

    places: of the fingers [m]; loads: of each relative to the rig's fingertip, empty for 1; quiet:
    by index; apart_hz: distance of the contents' frequencies where bands allow it; background: form
    of the rest of the plate at all of the table's frequencies, for no other finger; drive_mode: any
    but UNRESTRICTED has one content; is_shaped: whether onsets are shaped, along which nothing
    rings; least_ramp [s]: of short ones, which are a quarter of their duration else; avoided: rows
    of the table's frequencies that no content may have.
    """

    places: tuple[Point, ...]
    loads: tuple[float, ...]
    streams: tuple[Stream, ...]
    quiet: tuple[int, ...]
    apart_hz: float = 0.0
    background: Complex64Array | None = None
    drive_mode: str = UNRESTRICTED
    is_shaped: bool = False
    least_ramp: float = 0.0
    avoided: tuple[int, ...] = ()

    @property
    def is_ranked(self) -> bool:
        """Whether the KEPT frequencies are searched first: of one content for one finger."""
        first = self.streams[0]
        return len(self.streams) == len(first.targets) == len(first.bands) == 1 <= len(self.quiet)

    @property
    def candidates(self) -> int:
        """Candidates of each content in each of its bands, and as many by points."""
        count, bands = len(self.streams), len(self.streams[0].bands)
        return max(1, min(MIN_CANDIDATES + count // 2, MAX_CANDIDATES // bands))

    @property
    def combinations(self) -> int:
        """Combinations of candidates that are kept."""
        return min(MAX_COMBINATIONS, 4 * MAX_COMBINATIONS // len(self.streams))

    @property
    def rows(self) -> IntArray:
        """Rows of the table's frequencies that contents may have, ascending, (f,)."""
        bands = [np.arange(*band) for stream in self.streams for band in stream.bands]
        return np.setdiff1d(np.concatenate(bands), self.avoided)

    def others(self, number: int) -> list[int]:
        """Fingers that a content, by its number, is kept from."""
        every = {*self.quiet}.union(*(stream.targets for stream in self.streams))
        return sorted(every - {*self.streams[number].targets})

    @property
    def levels(self) -> Float32Array:
        """Amplitude to threshold of each content, (K,)."""
        levels = [10 ** (stream.level_db_sl / 20) for stream in self.streams]
        return np.array(levels, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Tones:
    """Tones of K contents, one of each or more, and what k fingers feel of them.

    rows (m,): of the table's frequencies; weights (m, n): up to full stroke; gains (m,): to the
    levels, within the stroke; owners (m,): the content of each tone; contrast_db (k, 3): nominal,
    of half of the drawn plates and promised, the least over the sets of thresholds, NaN without
    other contents or fingers; level_db_sl (k, 2): of a finger's own content, nominal and promised,
    by the rig's own set; foreign_db_sl (k, s): of other contents by each set, the rig's own first,
    which nine of ten plates do not exceed, NaN at fingers that are neither felt nor quiet;
    worst_db: contrast of all fingers that is promised, NaN for one alone; stroke_factor: least
    factor on the gains for the stroke; is_apart: whether the frequencies are.
    """

    rows: list[int]
    weights: Sequence[Sequence[complex]]
    gains: list[float]
    owners: Sequence[int]
    contrast_db: Sequence[Sequence[float]]
    level_db_sl: Sequence[Sequence[float]]
    foreign_db_sl: Sequence[Sequence[float]]
    worst_db: float
    stroke_factor: float
    is_apart: bool

    def excitations(
        self,
        content: int,
        eras: Sequence[Source],
        frequencies: FloatArray,
        highest_drives: FloatArray,
    ) -> list[Excitation]:
        """What plays a content, a tone of each ERA for each of its tones, its carrier first.

        frequencies [Hz], highest_drives (f, eras): of the table. The strongest ERA, the first of
        those nearly as strong, has phase zero.
        """
        found = list[Excitation]()
        every = zip(self.rows, self.weights, self.gains, self.owners, strict=True)
        for row, values, gain, owner in every:
            if owner != content:
                continue
            frequency, tones = float(frequencies[row]), dict[str, Tone]()
            # Python's numbers: numpy's take ten times as long, one by one.
            enough = (1 - NEARLY) * max(map(abs, values))
            (strongest, *_) = [value for value in values if abs(value) >= enough]
            factor = strongest.conjugate() / abs(strongest)
            for era, highest, value in zip(eras, highest_drives[row].tolist(), values, strict=True):
                if value != 0:
                    w = value * factor
                    if w.real > 0 and abs(w.imag) < _ROUNDING * w.real:
                        w = w.real
                    amplitude = gain * min(abs(w), 1.0) * highest
                    tones[era.name] = Tone(frequency, amplitude, cmath.phase(w))
            found.append(tones)
        return found

    @classmethod
    def none(cls, fingers: int, sets: int) -> "Tones":
        """Nothing that plays at so many fingers; sets: of thresholds."""
        contrast, level = [(math.inf,) * 3] * fingers, [(-math.inf,) * 2] * fingers
        heard = [(-math.inf,) * sets] * fingers
        return cls([], [], [], [], contrast, level, heard, math.nan, 1.0, is_apart=True)
