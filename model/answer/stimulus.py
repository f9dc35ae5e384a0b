"""Fingers on a plate, the stimulus that each is to feel, and the envelope along which it is driven.

A stimulus lasts, or has a duration, over which it is even or follows a course. The plate follows
its drive late: over 40 ms the root mean square at a finger is several decibels below that of the
steady vibration, ten decibels on a sharp resonance, and the plate rings on after the end. A finger
therefore feels the mean of its demodulated acceleration over the duration; any other fingertip
counts by its power, ringing included; both by the strongest moments where there is a course
(`DriveEnvelope`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from numbers import Real

import numpy as np
from scipy import fft

from model.arrays import FloatArray, Point
from model.config.units import in_metres
from model.errors import InputError, expect_number, shown
from model.finger import FINGERTIP_RADIUS, STRONG_DB_SL
from model.structure.attachments import check_loads
from model.structure.plate import Plate
from model.transients.base_motion import rise
from model.transients.excursions import CLICKS_APART, DECAYED, Swing
from model.transients.knots import RISE
from registry.limits import MAX_CONTACTS, MAX_FINGER_LOAD, MAX_HAND_LOAD

MIN_LEVEL_DB_SL, MAX_LEVEL_DB_SL = -100.0, 60.0
"""Bounds of a stimulus's level [dB SL].

The lower one is below the smallest amplitude of a channel. The exposure at the upper one is
discussed in docs/concepts/people.md.
"""

_MIN_DURATION, _MAX_DURATION = 0.001, 1e6
"""Bounds of a stimulus's duration [s]: no time step of a plate is nearly as short or as long."""

MIN_MODULATION, MAX_MODULATION = 10.0, 30.0
"""Bounds of a modulation [Hz] that is played by side bands; slower ones are changes of level."""

MAX_PRIORITY = (1 << 31) - 1
"""Highest priority of a finger; the lowest is its negative."""

ANY_BAND = (0.0, math.inf)
"""The band [Hz] of a stimulus that may have any frequency."""

NEVER, BY_NAME, ANY, MUST = SHARING = ("never", "by name", "any", "must")
"""Rules by which a finger may feel the vibration of another one (`Finger.sharing`)."""

_UNITS = {
    "load": "the load of the rig's fingertip",
    "min_contrast_db": "dB",
    "max_foreign_db_sl": "dB SL",
}


@dataclass(frozen=True)
class Stimulus:
    """What a finger is to feel."""

    level_db_sl: float = STRONG_DB_SL
    """Level over its duration, onset included, on the plate as modelled.

    Of a stimulus that lasts: the level that nine of ten plates give. With a course: at a share
    of 1.
    """
    band_hz: tuple[float, float] = ANY_BAND
    """Lowest and highest frequency."""
    duration: float | None = None
    """Duration [s], None for a stimulus that lasts; a click has 0.04 s."""
    modulation_hz: float | None = None
    """How often per second its strength comes and goes, None for a steady one.

    From MIN_MODULATION to MAX_MODULATION, of a stimulus that lasts or has a course.
    """
    is_limit: bool = False
    """Whether the level is an upper limit, up to which it is as strong as quiet fingers allow."""
    name: str | None = None
    """Fingers whose stimuli have the same name may be given one vibration."""
    course: "Course | None" = field(default=None, hash=False, repr=False)
    """How strongly it is felt over its duration, which is that of the course."""

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table; raises InputError."""
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
            if not _MIN_DURATION <= self.duration <= _MAX_DURATION:  # False for NaN
                raise InputError(
                    f"duration must be from {_MIN_DURATION:g} to {_MAX_DURATION:g} s, got "
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
    """A finger on the plate and what it asks for."""

    at: Point
    """Its place [m]."""
    stimulus: Stimulus | None = None
    """What it is to feel, None for nothing."""
    load: float = 1.0
    """Its load on the plate, relative to the rig's fingertip.

    A load above 10 is that of a hand that rests (`HAND_LOAD`): it changes what others feel, is
    known within a factor of 3 only, and has neither a stimulus nor protection.
    """
    priority: int = 0
    """Vibrations of lower priority are given up or lowered first."""
    sharing: str = BY_NAME
    """Whether it may feel the vibration of another finger.

    `never`; that of a finger of the same name (`by name`); that of the nearest finger that may
    have `any`; or it `must` feel one with all fingers of its name. In all cases but `never` it may
    also feel that of a finger so near that no vibration could be kept from either.
    """
    is_protected: bool = True
    """Whether others' vibrations are kept from it even where its own is given up.

    Without a stimulus and protection its load alone counts, wherever it is.
    """
    min_contrast_db: float = -math.inf
    """Least promised contrast to others' vibrations; below it these or its own are given up."""
    max_foreign_db_sl: float = math.inf
    """Largest level of others' vibrations here, else they are held back.

    By the rig's own thresholds, on nine of ten plates.
    """

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table; raises InputError."""
        # The types are tested first: most fingers pass, and calls would take longer.
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
    def is_load(self) -> bool:
        """Whether its load alone counts: a hand that rests, or what asks for nothing at all."""
        asks_nothing = self.stimulus is None and not self.is_protected
        return asks_nothing or self.load > MAX_FINGER_LOAD

    @property
    def name(self) -> str | None:
        """The name of its stimulus, None without one."""
        return None if self.stimulus is None else self.stimulus.name

    def may_feel_one_with(self, other: "Finger", *, are_apart: bool = True) -> bool:
        """Whether both fingers may feel one vibration.

        are_apart: whether each could be given a vibration of its own.
        """
        one, two = self.stimulus, other.stimulus
        if one is None or two is None or NEVER in (self.sharing, other.sharing):
            return False
        if (one.duration, one.is_limit, one.course) != (two.duration, two.is_limit, two.course):
            return False
        if not are_apart or self.sharing == other.sharing == ANY:
            return True
        return self.name is not None and self.name == other.name

    def must_feel_one_with(self, other: "Finger") -> bool:
        """Whether both fingers must feel one vibration."""
        are_felt = self.stimulus is not None and other.stimulus is not None
        return are_felt and self.name == other.name and self.sharing == other.sharing == MUST


@dataclass(frozen=True)
class Placement:
    """Places [m] of the fingers that are to feel a vibration, and of all others."""

    targets: tuple[Point, ...]
    quiet: tuple[Point, ...] = ()
    loads: tuple[float, ...] = ()
    """Load of each finger relative to the rig's fingertip, targets first; empty for 1 each."""

    @property
    def contacts(self) -> tuple[Point, ...]:
        """All places, targets first."""
        return (*self.targets, *self.quiet)


def together(placed: Placement, stimulus: Stimulus) -> list[Finger]:
    """Make fingers of a placement: targets that must feel one stimulus together, and quiet ones."""
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
    """Raise InputError for places [m] off the plate; what: their name in the message."""
    length, width = plate.length, plate.width
    for x, y in places:
        if not (0 <= x <= length and 0 <= y <= width):  # False for NaN
            raise InputError(
                f"{what} must be on the plate, from (0, 0) to ({length:g}, {width:g}) m, got "
                f"({x:g}, {y:g}) m{in_metres(x, y, length=length, width=width)}"
            )
        if not plate.contains(x, y):
            raise InputError(f"{what} must be within the outline, got ({x:g}, {y:g}) m")


def check_fingers(fingers: Sequence[Finger], plate: Plate) -> None:
    """Raise InputError for fingers that contradict each other or are not on the plate."""
    loads = [finger.load for finger in fingers]
    if all(finger.stimulus is None for finger in fingers):
        raise InputError("an answer must have at least one finger with a stimulus, got none")
    if len(fingers) > MAX_CONTACTS:
        raise InputError(f"an answer must have up to {MAX_CONTACTS} fingers, got {len(fingers)}")
    if loads.count(1.0) < len(loads):
        check_loads([each.load for each in fingers if each.stimulus])
        check_loads([each.load for each in fingers if not each.stimulus], highest=MAX_HAND_LOAD)
    check_on_plate("finger", [finger.at for finger in fingers], plate)
    for number, finger in enumerate(fingers):
        x, y = finger.at
        for other in fingers[:number]:
            gap = math.dist(other.at, finger.at)
            if gap >= FINGERTIP_RADIUS or finger.is_load or other.is_load:
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


_MAX_POINTS = 20_000
"""Most times of a course."""

COURSE_KNOT_STEP = 0.010
"""Time [s] between the knots along which amplifiers play a course, if the wires carry so many."""

STRONGEST = 0.040
"""Time [s] of the strongest moments of a course, by which it is felt."""

_STEP, _SHORT = 0.005, 1.0  # s; between samples of a course; courses up to _SHORT have half of it

SILENCE = 1e-6
"""Share in place of 0, for which levels are finite."""


@dataclass(frozen=True)
class Course:
    """Shares of the highest amplitude of a stimulus over its duration."""

    times: Sequence[float]
    """Times [s], ascending from 0 to the duration."""
    shares: Sequence[float]
    """Share at each time, 0 to 1; linear in between."""

    def __post_init__(self) -> None:
        """Check times and shares; raises InputError."""
        if not 2 <= len(self.times) == len(self.shares) <= _MAX_POINTS:
            raise InputError(
                f"a course must have 2 to {_MAX_POINTS} times and as many shares, got "
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
        """The course as amplifiers may play it from knot to knot: once, then over and over.

        One for each distance of the knots: wires that carry fewer have them further apart.
        """
        found = []
        for step in (COURSE_KNOT_STEP, 2 * COURSE_KNOT_STEP, 4 * COURSE_KNOT_STEP):
            count, rest = (math.ceil(each / step) for each in (self.duration, DECAYED))
            times = np.asarray(step * np.arange(1, count + rest + 1), dtype=float)
            once = np.where(times < self.duration, self.at(times), 0.0)
            again = self.at(np.mod(times, self.duration))
            found.append(Swing((0.0, *once.tolist(), *again.tolist()), step))
        return tuple(found)

    def at(self, times: FloatArray) -> FloatArray:
        """Shares at times [s] (n,), 0 outside."""
        return np.asarray(np.interp(times, *self._line, left=0.0, right=0.0))

    @cached_property
    def _line(self) -> tuple[FloatArray, FloatArray]:
        """Times and shares as arrays, made once: they are read for every piece that is played."""
        return np.array(self.times), np.array(self.shares)


ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of it (docs/concepts/transients.md).
"""

FADE_RAMP = 0.020
"""Duration of the fade [s] under fingers that stay on the plate; a shorter one feels like a tap."""

_RINGING = 0.100
"""Time [s] after a short effect over which the ringing at other fingers counts.

Weights keep it down for that time and no longer: with 20 ms it was up to 7 dB stronger afterwards
on four ERAs, and 18 dB on a large table.
"""

SHAPED_FROM = 0.2
"""Shortest duration [s] of a stimulus with a shaped onset, which settles in half of it."""

_PULSE_STEP, _MAX_PULSE_STEPS = 0.001, 48
"""Steps [s] of pulses, and how many one has at most within its duration."""

_RESOLUTION = 1.0  # Hz, at least; of the spectrum of an envelope


def pulse_ramp(duration: float) -> float:
    """Return the plain ramp [s] of a vibration of some duration [s]: a quarter of it.

    The vibration is then even over its duration: no 40 ms of a click of 40 ms are more than 0.8 dB
    (median) stronger than the first 40 ms; with a ramp of half the duration 1.5 dB, of all of it
    3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


def shaped_gain(duration: float) -> float:
    """Return the mean amplitude over a duration [s] with a shaped onset, 1 for steady.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@lru_cache
def swings_of_pulse(duration: float, ramp: float) -> tuple[Swing, Swing]:
    """Return the swings of pulses of a duration [s] one after the other, along plain ramps [s].

    The first swing ends along the pulse's ramp, the second along FADE_RAMP. A pulse longer than
    SHAPED_FROM counts by that much: by then its onset has decayed as far as its end will.
    """
    length = min(duration, SHAPED_FROM)
    count = math.ceil((length + DECAYED) / _PULSE_STEP)
    times = np.asarray(_PULSE_STEP * np.arange(count), dtype=float)
    again = max(duration, CLICKS_APART)
    onset, after = rise(times, ramp), np.asarray(times - length)
    plain, faded = (
        Swing(tuple((onset - rise(after, end)).tolist()), _PULSE_STEP, again)
        for end in (ramp, FADE_RAMP)
    )
    return plain, faded


@dataclass(frozen=True, eq=False)
class OverDuration:
    """What k fingers feel of a drive over its duration, on the nominal plate."""

    gains: FloatArray
    """Mean amplitude (k,) relative to the steady one."""
    heard: FloatArray
    """Squared amplitude to threshold (k, p) at each point, mean over the strongest such time."""


@dataclass(frozen=True, eq=False)
class DriveEnvelope:
    """Envelope of a drive, up to _RINGING after its end or until it is steady."""

    values: FloatArray
    """Envelope (n,) at even steps."""
    step: float
    """Time [s] between values."""
    within: int
    """Number of steps over which it is felt: the strongest ones of a course, else the first."""
    share: float = 1.0
    """Share of these steps in the duration, the rest of which is steady."""
    is_course: bool = False

    @classmethod
    def of_pulse(cls, duration: float, ramp: float) -> "DriveEnvelope":
        """Make the envelope of a pulse of a duration along plain ramps [s].

        It includes the ringing after the end, where a quiet finger may feel most.
        """
        length = min(duration, SHAPED_FROM)  # the rest is steady
        count = min(_MAX_PULSE_STEPS, max(1, math.ceil(length / _PULSE_STEP)))
        step = length / count
        every = count + math.ceil(_RINGING / step)
        times = np.asarray(step * (np.arange(every) + 0.5), dtype=float)
        values = rise(times, ramp) - rise(np.asarray(times - length), ramp)
        return cls(np.asarray(values), step, count, length / duration)

    @classmethod
    def of_course(cls, course: Course) -> "DriveEnvelope":
        """Make the envelope along a course, with a plain ramp where it starts or ends above 0."""
        count = math.ceil((course.duration + _RINGING) / course.step)
        times = np.asarray(course.step * np.arange(count), dtype=float)
        after, (first, *_, last) = np.asarray(times - course.duration), course.shares
        values = course.at(times) - first * (1 - rise(times, ONSET_RAMP))
        values += np.where(after > 0, last * (1 - rise(after, ONSET_RAMP)), 0.0)
        within = round(STRONGEST / course.step)
        return cls(np.maximum(values, SILENCE), course.step, within, is_course=True)

    def moments(self, squares: FloatArray) -> FloatArray:
        """Means of squares (n, ...) over the time that is felt, from each step on, (n', ...)."""
        sums = np.cumsum(squares, axis=0, dtype=float)
        sums[self.within :] -= sums[: -self.within].copy()
        return np.asarray(sums[self.within - 1 :] / self.within)

    def felt(self, squares: FloatArray, weights: FloatArray) -> OverDuration:
        """Return what k fingers feel, from squared amplitudes to threshold (n + 1, k, p).

        The last of the squares is that of the steady vibration; weights (k, p): of the points in
        the mean over a fingertip.
        """
        power = self.share * self.moments(squares[:-1]) + (1 - self.share) * squares[-1]
        own = power if self.is_course else power[:1]
        felt = (np.sqrt(own) * weights).sum(axis=2).max(axis=0)
        steady = (np.sqrt(squares[-1]) * weights).sum(axis=1)
        return OverDuration(felt / np.maximum(steady, 1e-30), power.max(axis=0))

    def shares_at(self, off: FloatArray) -> FloatArray:
        """Shares (b,) of the steady power, of tones at distances off (b,) [Hz] from the drive's.

        Together the tones have the energy of the drive on any plate (Parseval); for a course, the
        energy of the strongest moments of each. What lies between two tones is split in proportion
        to nearness; beside the drive's own frequency, which may be in a null, by its square.
        """
        count = max(len(self.values), math.ceil(1 / _RESOLUTION / self.step))
        count = fft.next_fast_len(count)
        transform, nu = fft.fft(self.values, count), fft.fftfreq(count, self.step)
        near = np.array([np.interp(nu, off, each) for each in np.eye(len(off))])
        own = int(np.argmin(np.abs(off)))
        is_beside = near[own] > 0
        near[:, is_beside] **= 2
        near[own, is_beside] += 1 - near[:, is_beside].sum(axis=0)
        squares = np.abs(fft.ifft((transform * np.sqrt(near)).astype(np.complex64))) ** 2
        if self.is_course:
            power, all_ = self.moments(squares.T).max(axis=0), self.moments(self.values**2).max()
            return np.asarray(power * (all_ / power.sum()))
        power = self.share * squares.sum(axis=1) / self.within
        power[own] += 1 - self.share
        return np.asarray(power)
