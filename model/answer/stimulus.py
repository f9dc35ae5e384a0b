"""Fingers on a plate, and the stimulus that each is to feel.

Courses: how strongly a stimulus is felt over its duration, as an envelope of its amplitude.

Contents for fingers on a plate, and the tones that are found for them.

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

`model.answer.tone_search` finds them in C, `model.answer.tone_search` in numpy.
"""

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real

import numpy as np

from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray, Point
from model.config.fields import in_metres
from model.drive_modes import UNRESTRICTED
from model.errors import InputError, expect_number, shown
from model.finger import FINGERTIP_RADIUS, MAX_CONTACTS, STRONG_DB_SL
from model.structure.attachments import Source, check_loads
from model.structure.plate import Plate
from model.transients.excursions import DECAYED, Swing
from model.vibration import Excitation, Tone

MAX_POINTS = 20_000

KNOT_STEP = 0.010
"""Time [s] between the knots along which amplifiers play a course, where wires carry as many."""

STRONGEST = 0.040
"""Time [s] of the strongest moments of a course, by which it is felt."""

_STEP, _SHORT = 0.005, 1.0  # s; between samples of courses, half as much of short ones

SILENCE = 1e-6
"""Share that stands for 0: of a silence levels are finite."""


@dataclass(frozen=True)
class Course:
    """Shares of the highest amplitude of a stimulus over its duration.

    times [s]: ascending, the first is 0, the last its duration; shares: 0 to 1, along straight
    lines between.
    """

    times: tuple[float, ...]
    shares: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check everything."""
        if not 2 <= len(self.times) == len(self.shares) <= MAX_POINTS:
            raise InputError(
                f"a course must have 2 to {MAX_POINTS} times and as many shares, got "
                f"{len(self.times)} and {len(self.shares)}"
            )
        if self.times[0] != 0 or not (np.diff(self.times) > 0).all():
            raise InputError("times of a course must ascend from 0")
        shares = np.array(self.shares)
        if not ((shares >= 0) & (shares <= 1)).all():  # False for NaN
            raise InputError(
                f"shares of a course must be 0 to 1, got {min(self.shares):g} to "
                f"{max(self.shares):g}"
            )

    @property
    def duration(self) -> float:
        """Its last time [s]."""
        return self.times[-1]

    @property
    def step(self) -> float:
        """Time [s] between its samples."""
        return _STEP if self.duration > _SHORT else _STEP / 2

    @cached_property
    def strongest_db(self) -> float:
        """Root mean square of its strongest moments [dB], relative to a share of 1."""
        times = np.asarray(self.step * np.arange(self.duration / self.step + 1), dtype=float)
        samples, count = np.maximum(self.at(times), SILENCE), round(STRONGEST / self.step)
        return float(10 * np.log10(np.convolve(samples**2, np.full(count, 1 / count)).max()))

    @cached_property
    def swings(self) -> tuple[Swing, ...]:
        """It as amplifiers may play it from knot to knot: once, then over and over.

        Where wires carry fewer knots, these are further apart.
        """
        return tuple([self._swing(factor * KNOT_STEP) for factor in (1, 2, 4)])

    def _swing(self, step: float) -> Swing:
        count, rest = (math.ceil(each / step) for each in (self.duration, DECAYED))
        times = np.asarray(step * np.arange(1, count + rest + 1), dtype=float)
        once = np.where(times < self.duration, self.at(times), 0.0)
        anew = self.at(np.mod(times, self.duration))
        return Swing((0.0, *once.tolist(), *anew.tolist()), step)

    def at(self, times: FloatArray) -> FloatArray:
        """Shares at times [s] (n,), 0 outside."""
        return np.asarray(np.interp(times, *self._line, left=0.0, right=0.0))

    @cached_property
    def _line(self) -> tuple[FloatArray, FloatArray]:
        """Times and shares as arrays, made once: it is read for every piece that is played."""
        return np.array(self.times), np.array(self.shares)


MIN_LEVEL_DB_SL, MAX_LEVEL_DB_SL = -100.0, 60.0
"""Below the smallest amplitude of a channel, and the most that layouts and programs may ask for.

In dB SL; what exposure that is: docs/concepts/people.md.
"""

MIN_DURATION, MAX_DURATION = 0.001, 1e6
"""Durations of a stimulus that has an end [s]: no time step of a plate is nearly as long or short.
"""

MAX_PRIORITY = (1 << 31) - 1
"""Highest priority of a finger, and the lowest with a minus."""

SHAPED_FROM = 0.2
"""Shortest duration [s] of a stimulus with a shaped onset, which settles in half of it."""

MIN_MODULATION, MAX_MODULATION = 10.0, 30.0
"""Modulations that side bands play [Hz]; slower ones are changes of level."""

ANY_BAND = (0.0, math.inf)

NEVER, BY_NAME, ANY, MUST = SHARING = ("never", "by name", "any", "must")
"""Whether a finger may feel the vibration of another one."""

_UNITS = {
    "load": "the load of the rig's fingertip",
    "min_contrast_db": "dB",
    "max_foreign_db_sl": "dB SL",
}


@dataclass(frozen=True)
class Stimulus:
    """What a finger is to feel.

    level_db_sl: over its duration, onset included, on the plate as modelled; of a stimulus that
    lasts what nine of ten plates give; band_hz: lowest and highest frequency; duration [s]: None
    for one that lasts, a click has 0.04; modulation_hz: how often a second the strength of one that
    lasts, or has a course, comes and goes, MIN_MODULATION to MAX_MODULATION, None for a steady one;
    is_limit: whether it is as strong as the quiet fingers allow, up to that level; name: fingers of
    one name may be given one vibration; course: how strongly it is felt over its duration, which is
    that of the course, level_db_sl at a share of 1.
    """

    level_db_sl: float = STRONG_DB_SL
    band_hz: tuple[float, float] = ANY_BAND
    duration: float | None = None
    modulation_hz: float | None = None
    is_limit: bool = False
    name: str | None = None
    course: Course | None = field(default=None, hash=False, repr=False)  # long

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table."""
        if type(self.band_hz) is not tuple or [*map(type, self.band_hz)] != [float, float]:
            _check_pair(self.band_hz, what="band_hz", such_as="(40, 120), lowest and highest in Hz")
        if type(self.level_db_sl) is not float:
            expect_number(self.level_db_sl, what="level_db_sl", unit="dB above the threshold")
        low, high = self.band_hz
        if not 0 <= low <= high:  # False for NaN
            raise InputError(
                f"band_hz must be from a lowest to a highest frequency, got {low:g} to {high:g}"
            )
        check_level(self.level_db_sl)
        if not (self.name is None or isinstance(self.name, str)):
            raise InputError(f"name of a stimulus must be text, got {shown(self.name)}")
        if not isinstance(self.is_limit, bool):
            raise InputError(f"is_limit must be True or False, got {shown(self.is_limit)}")
        if self.course is not None:
            if not isinstance(self.course, Course):
                raise InputError(
                    "course must be one such as era.Course((0, 0.5), (1, 0)), got "
                    f"{shown(self.course)}"
                )
            if self.duration not in (None, self.course.duration):
                raise InputError(
                    f"duration must be left out of a stimulus with a course, got {self.duration:g}"
                )
            object.__setattr__(self, "duration", self.course.duration)
        if self.duration is not None:
            expect_number(self.duration, what="duration", unit="seconds")
            if not MIN_DURATION <= self.duration <= MAX_DURATION:  # False for NaN
                raise InputError(
                    f"duration must be from {MIN_DURATION:g} to {MAX_DURATION:g} s, got "
                    f"{self.duration:g}; leave it out of a stimulus that lasts"
                )
        if self.modulation_hz is not None:
            expect_number(self.modulation_hz, what="modulation_hz", unit="Hz")
            if not MIN_MODULATION <= self.modulation_hz <= MAX_MODULATION:
                raise InputError(
                    f"modulation_hz must be from {MIN_MODULATION:g} to {MAX_MODULATION:g} Hz, got "
                    f"{self.modulation_hz:g}"
                )
            if self.duration is not None and self.course is None:
                raise InputError(
                    "modulation_hz must be left out of a stimulus with a duration but no course"
                )


@dataclass(frozen=True)
class Finger:
    """A finger at a place [m], and what it asks.

    stimulus: what it is to feel, None for nothing; load: relative to the rig's fingertip; priority:
    lower ones give way first; sharing: whether it may feel the vibration of another finger:
    `never`, that of one of the same name (`by name`), of the nearest that may have `any`, or it
    `must` feel one with all of its name; all but `never` also that of a finger so near that no
    vibration could be kept from either; is_protected: whether it keeps the others' vibrations away
    where its own is given up; min_contrast_db: promised contrast to the vibrations of others below
    which these or its own give way; max_foreign_db_sl: level of others' vibrations here, by the
    rig's own thresholds, that nine of ten plates do not exceed, else they are held back.
    """

    at: Point
    stimulus: Stimulus | None = None
    load: float = 1.0
    priority: int = 0
    sharing: str = BY_NAME
    is_protected: bool = True
    min_contrast_db: float = -math.inf
    max_foreign_db_sl: float = math.inf

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table."""
        # Without a call for each of the many fingers that are as they should be.
        if type(self.at) is not tuple or [*map(type, self.at)] != [float, float]:
            _check_pair(
                self.at, what="place of a finger", such_as="(0.08, 0.06), x and y in metres"
            )
        for what in ("load", "min_contrast_db", "max_foreign_db_sl"):
            given = getattr(self, what)
            if type(given) is not float:
                expect_number(given, what=what, unit=_UNITS[what])
            if math.isnan(given):
                raise InputError(f"{what} must be a number of {_UNITS[what]}, got {given}")
        if not (self.stimulus is None or isinstance(self.stimulus, Stimulus)):
            raise InputError(
                f"stimulus must be one such as era.Stimulus(20), got {shown(self.stimulus)}"
            )
        if isinstance(self.priority, bool) or not isinstance(self.priority, int):
            raise InputError(f"priority must be a whole number, got {shown(self.priority)}")
        if abs(self.priority) > MAX_PRIORITY:
            raise InputError(
                f"priority must be from {-MAX_PRIORITY} to {MAX_PRIORITY}, got "
                f"{shown(self.priority)}"
            )
        if not isinstance(self.is_protected, bool):
            raise InputError(f"is_protected must be True or False, got {shown(self.is_protected)}")
        if str(self.sharing) not in SHARING:  # an array has no truth
            raise InputError(
                f"sharing must be one of {', '.join(SHARING)}, got {shown(self.sharing)}"
            )

    @property
    def name(self) -> str | None:
        """Of its stimulus."""
        return None if self.stimulus is None else self.stimulus.name

    def may_feel_one_with(self, other: "Finger", *, are_apart: bool = True) -> bool:
        """Whether both fingers may feel one vibration; are_apart: whether each could its own."""
        one, two = self.stimulus, other.stimulus
        if one is None or two is None or NEVER in (self.sharing, other.sharing):
            return False
        if (one.duration, one.is_limit, one.course) != (two.duration, two.is_limit, two.course):
            return False
        if not are_apart or self.sharing == other.sharing == ANY:
            return True
        return self.name is not None and self.name == other.name

    def must_feel_one_with(self, other: "Finger") -> bool:
        """Whether both fingers feel one vibration from the start."""
        are_felt = self.stimulus is not None and other.stimulus is not None
        return are_felt and self.name == other.name and self.sharing == other.sharing == MUST


@dataclass(frozen=True)
class Placement:
    """Places [m] of the fingers that are to feel a vibration, and of all others.

    loads: of each relative to the rig's fingertip, targets first; empty for 1.
    """

    targets: tuple[Point, ...]
    quiet: tuple[Point, ...] = ()
    loads: tuple[float, ...] = ()

    @property
    def contacts(self) -> tuple[Point, ...]:
        """All places, targets first."""
        return (*self.targets, *self.quiet)


def together(placed: Placement, stimulus: Stimulus) -> list[Finger]:
    """Return fingers that must feel one stimulus, and the others."""
    loads = placed.loads or (1.0,) * len(placed.contacts)
    if len(loads) != len(placed.contacts):
        raise InputError(
            f"loads must have one value per finger ({len(placed.contacts)}), got {len(loads)}"
        )
    count = len(placed.targets)
    return [
        Finger(at, stimulus if n < count else None, load, sharing=MUST)
        for n, (at, load) in enumerate(zip(placed.contacts, loads, strict=True))
    ]


def check_on_plate(what: str, places: Iterable[Point], plate: Plate) -> None:
    """Raise InputError for places [m] off the plate; what: the name of what is there."""
    length, width = plate.length, plate.width
    for x, y in places:
        if not (0 <= x <= length and 0 <= y <= width):  # False for NaN
            raise InputError(
                f"{what} must be on the plate, from (0, 0) to ({length:g}, {width:g}) m, got "
                f"({x:g}, {y:g}) m{in_metres(x, y, length=length, width=width)}"
            )


def check_fingers(fingers: Sequence[Finger], plate: Plate) -> None:
    """Raise InputError for fingers that contradict each other or are not on the plate."""
    loads, places, is_asked = [], [], False
    for finger in fingers:  # without a call for each
        loads.append(finger.load)
        places.append(finger.at)
        is_asked = is_asked or finger.stimulus is not None
    if not is_asked:
        raise InputError("an answer must have at least one finger with a stimulus, got none")
    if len(fingers) > MAX_CONTACTS:
        raise InputError(f"an answer must have up to {MAX_CONTACTS} fingers, got {len(fingers)}")
    if loads.count(1.0) < len(loads):
        check_loads(loads)
    check_on_plate("finger", places, plate)
    for number, finger in enumerate(fingers):
        x, y = finger.at
        for other in fingers[:number]:
            gap = math.dist(other.at, finger.at)
            if gap >= FINGERTIP_RADIUS:
                continue
            is_one = finger.stimulus == other.stimulus is None or finger.must_feel_one_with(other)
            if not (is_one and gap > 0):
                raise InputError(
                    f"finger ({x:g}, {y:g}) m must be at least {1000 * FINGERTIP_RADIUS:g} mm "
                    f"from the one at ({other.at[0]:g}, {other.at[1]:g}) m"
                )


def check_level(level_db_sl: float) -> None:
    """Raise InputError for a level [dB SL] that no stimulus may have."""
    if not MIN_LEVEL_DB_SL <= level_db_sl <= MAX_LEVEL_DB_SL:
        raise InputError(
            f"level must be between {MIN_LEVEL_DB_SL:g} and {MAX_LEVEL_DB_SL:g} dB SL, got "
            f"{level_db_sl:g}; 20 is strong, 12 is felt, 0 is the threshold, and at "
            f"{MAX_LEVEL_DB_SL:g} the exposure is 12 to 60 m/s² (ISO 5349-1)"
        )


def _check_pair(given: object, *, what: str, such_as: str) -> None:
    """Raise InputError for anything but two numbers."""
    pair = given if isinstance(given, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not (isinstance(pair[0], Real) and isinstance(pair[1], Real)):
        raise InputError(f"{what} must be two numbers such as {such_as}, got {shown(given)}")


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
