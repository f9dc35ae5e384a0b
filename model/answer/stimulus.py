"""Fingers on a plate, the stimulus for each, and the envelope of its drive.

A stimulus is continuous, or has a duration with a constant level or an envelope. The plate follows
its drive late: over 40 ms, the RMS at a finger is several decibels below that of the steady
vibration, ten decibels on a sharp resonance, and the plate rings after the end. Therefore a finger
is assumed to feel the mean of its demodulated acceleration over the duration. Any other fingertip
counts by its power, including ringing. With an envelope, both are evaluated over the strongest
moments (`DriveEnvelope`).
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

The lower bound is below the smallest amplitude of a channel. docs/concepts/people.md discusses the
exposure at the upper bound.
"""

_MIN_DURATION, _MAX_DURATION = 0.001, 1e6
"""Bounds of a stimulus's duration [s], far beyond any time step of a plate."""

MIN_MODULATION, MAX_MODULATION = 10.0, 30.0
"""Bounds of a modulation played by side bands [Hz]; slower modulations are changes of level."""

MAX_PRIORITY = (1 << 31) - 1
"""Highest priority of a finger; the lowest is its negative."""

ANY_BAND = (0.0, math.inf)
"""Band [Hz] of a stimulus without a frequency constraint."""

NEVER, BY_NAME, ANY, MUST = SHARING = ("never", "by name", "any", "must")
"""Rules for feeling the vibration of another finger (`Finger.sharing`)."""

_UNITS = {
    "load": "the load of the rig's fingertip",
    "min_contrast_db": "dB",
    "max_foreign_db_sl": "dB SL",
}


@dataclass(frozen=True)
class Stimulus:
    """Requested sensation of a finger."""

    level_db_sl: float = STRONG_DB_SL
    """Level over its duration, onset included, on the nominal plate.

    For a continuous stimulus, this is the level that 90 % of plates reach. With an envelope, it is
    the level at the envelope's maximum, 1.
    """
    band_hz: tuple[float, float] = ANY_BAND
    """Lowest and highest frequency."""
    duration: float | None = None
    """Duration [s], None for a continuous stimulus; a click lasts 0.04 s."""
    modulation_hz: float | None = None
    """Modulation frequency of its strength [Hz], None for a steady one.

    From MIN_MODULATION to MAX_MODULATION, for a stimulus that is continuous or has an envelope.
    """
    is_limit: bool = False
    """Whether the level is an upper limit; the stimulus is then as strong as quiet fingers
    allow."""
    name: str | None = None
    """Fingers whose stimuli have the same name can share one vibration."""
    course: "Course | None" = field(default=None, hash=False, repr=False)
    """Envelope of the strength, which also sets the duration."""

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
                    f"duration must be left out for a stimulus with a course, got {self.duration:g}"
                )
            object.__setattr__(self, "duration", self.course.duration)
        if self.duration is not None:
            expect_number(self.duration, what="duration", unit="seconds")
            if not _MIN_DURATION <= self.duration <= _MAX_DURATION:  # False for NaN
                raise InputError(
                    f"duration must be from {_MIN_DURATION:g} to {_MAX_DURATION:g} s, got "
                    f"{self.duration:g}; leave it out for a continuous stimulus"
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
                    "modulation_hz must be left out for a stimulus with a duration but no course"
                )


@dataclass(frozen=True)
class Finger:
    """A finger on the plate with its request."""

    at: Point
    """Position [m]."""
    stimulus: Stimulus | None = None
    """Stimulus that the finger should feel, None for nothing."""
    load: float = 1.0
    """Load on the plate, relative to the rig's fingertip.

    A load above 10 is a resting hand (`HAND_LOAD`): it changes what others feel, is known only
    within a factor of 3, and has neither a stimulus nor protection.
    """
    priority: int = 0
    """Vibrations of lower priority give way or are lowered first."""
    sharing: str = BY_NAME
    """Whether the finger can feel the vibration of another finger.

    `never`: it cannot. `by name`: of a finger with the same name. `any`: of the nearest finger that
    also allows `any`. `must`: it feels one vibration with all fingers of its name. Except with
    `never`, it can also feel the vibration of a finger so close that the two cannot be separated.
    """
    is_protected: bool = True
    """Whether others' vibrations are kept from it even if its own is given up.

    A finger with neither a stimulus nor protection counts only as a load.
    """
    min_contrast_db: float = -math.inf
    """Minimum promised contrast to others' vibrations; below it, others' vibrations or the finger's
    own are given up."""
    max_foreign_db_sl: float = math.inf
    """Maximum level of others' vibrations here, relative to the rig's own thresholds, on 90 % of
    plates; louder ones are held back."""

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table; raises InputError."""
        # Types are tested first: most fingers pass, and calls would take longer.
        if type(self.at) is not tuple or [*map(type, self.at)] != [float, float]:
            _check_pair(
                self.at, what="place of a finger", such_as="(0.08, 0.06), x and y in meters"
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
        if str(self.sharing) not in SHARING:  # an array has no truth value
            raise InputError(
                f"sharing must be one of {', '.join(SHARING)}, got {shown(self.sharing)}"
            )

    @property
    def is_load(self) -> bool:
        """Whether only its load counts: a resting hand, or a finger without any request."""
        asks_nothing = self.stimulus is None and not self.is_protected
        return asks_nothing or self.load > MAX_FINGER_LOAD

    @property
    def name(self) -> str | None:
        """The name of its stimulus, None without one."""
        return None if self.stimulus is None else self.stimulus.name

    def may_feel_one_with(self, other: "Finger", *, are_apart: bool = True) -> bool:
        """Return whether both fingers can feel one vibration.

        are_apart: whether each could have its own vibration.
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
    """Positions [m] of the fingers that should feel a vibration, and of all others."""

    targets: tuple[Point, ...]
    quiet: tuple[Point, ...] = ()
    loads: tuple[float, ...] = ()
    """Load of each finger relative to the rig's fingertip, targets first; empty for 1 each."""

    @property
    def contacts(self) -> tuple[Point, ...]:
        """All places, targets first."""
        return (*self.targets, *self.quiet)


def together(placed: Placement, stimulus: Stimulus) -> list[Finger]:
    """Build the fingers of a placement: targets that must share one stimulus, and quiet ones."""
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
    """Raise InputError for positions [m] off the plate; what: their name in the message."""
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
    """Raise InputError for a level [dB SL] outside the allowed range."""
    if not MIN_LEVEL_DB_SL <= level_db_sl <= MAX_LEVEL_DB_SL:
        raise InputError(
            f"level must be between {MIN_LEVEL_DB_SL:g} and {MAX_LEVEL_DB_SL:g} dB SL, got "
            f"{level_db_sl:g}; 20 is strong, 12 is felt, 0 is the threshold, and at "
            f"{MAX_LEVEL_DB_SL:g} the exposure is 10 to 240 m/s² (ISO 5349-1)"
        )


def _check_pair(given: object, *, what: str, such_as: str) -> None:
    """Raise InputError for anything but two numbers."""
    pair = given if isinstance(given, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not (isinstance(pair[0], Real) and isinstance(pair[1], Real)):
        raise InputError(f"{what} must be two numbers such as {such_as}, got {shown(given)}")


_MAX_POINTS = 20_000
"""Maximum number of times in an envelope."""

COURSE_KNOT_STEP = 0.010
"""Interval of the knots with which amplifiers play an envelope [s], if the wires are fast
enough."""

STRONGEST = 0.040
"""Total time of the strongest moments by which an envelope is felt [s]."""

_STEP, _SHORT = 0.005, 1.0  # s; sampling interval of envelopes, halved for durations up to _SHORT

SILENCE = 1e-6
"""Replaces 0, so that levels are finite."""


@dataclass(frozen=True)
class Course:
    """Envelope of a stimulus: fraction of its highest amplitude over the duration."""

    times: Sequence[float]
    """Times [s], ascending from 0 to the duration."""
    shares: Sequence[float]
    """Fraction at each time, 0 to 1; linear in between."""

    def __post_init__(self) -> None:
        """Check times and fractions; raises InputError."""
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
        """Sampling interval [s]."""
        return _STEP if self.duration > _SHORT else _STEP / 2

    @cached_property
    def strongest_db(self) -> float:
        """RMS of its strongest moments [dB], relative to a constant 1."""
        times = np.asarray(self.step * np.arange(self.duration / self.step + 1), dtype=float)
        samples, count = np.maximum(self.at(times), SILENCE), round(STRONGEST / self.step)
        return float(10 * np.log10(np.convolve(samples**2, np.full(count, 1 / count)).max()))

    @cached_property
    def swings(self) -> tuple[Swing, ...]:
        """Possible playbacks of the envelope from knot to knot: once, then repeated.

        One per knot interval: slower wires use longer intervals.
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
        """Return fractions at times [s] (n,), 0 outside."""
        return np.asarray(np.interp(times, *self._line, left=0.0, right=0.0))

    @cached_property
    def _line(self) -> tuple[FloatArray, FloatArray]:
        """Times and fractions as arrays, cached: they are read for every piece played."""
        return np.array(self.times), np.array(self.shares)


ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of the ramp (docs/concepts/transients.md).
"""

FADE_RAMP = 0.020
"""Duration of the fade under fingers that stay on the plate [s]; a shorter one feels like a tap."""

_RINGING = 0.100
"""Time after a short effect over which the ringing at other fingers counts [s].

Weights suppress ringing only for this time: with 20 ms it was up to 7 dB stronger afterwards on
four ERAs, and 18 dB on a large table.
"""

SHAPED_FROM = 0.2
"""Shortest duration of a stimulus with a shaped onset [s], which settles in half of that."""

_PULSE_STEP, _MAX_PULSE_STEPS = 0.001, 48
"""Step [s] of pulses, and maximum number of steps within the duration."""

_RESOLUTION = 1.0  # Hz, minimum resolution of an envelope's spectrum


def pulse_ramp(duration: float) -> float:
    """Return the plain ramp [s] of a vibration: a quarter of its duration [s].

    The vibration is then nearly constant: no 40 ms of a 40 ms click (ringing included) are more
    than 0.8 dB (median) stronger than the first 40 ms. With a ramp of half the duration it is 1.5
    dB, with the full duration 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


def shaped_gain(duration: float) -> float:
    """Return the mean amplitude over a duration [s] with a shaped onset, 1 if steady.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@lru_cache
def swings_of_pulse(duration: float, ramp: float) -> tuple[Swing, Swing]:
    """Return the envelopes of consecutive pulses of a duration [s], with plain ramps [s].

    The first ends along the pulse's ramp, the second along FADE_RAMP. A pulse longer than
    SHAPED_FROM counts as that long: by then its onset has decayed as far as its end will.
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
    """Sensation of k fingers over the duration of a drive, on the nominal plate."""

    gains: FloatArray
    """Mean amplitude (k,) relative to the steady one."""
    heard: FloatArray
    """Squared amplitude at each point relative to the threshold (k, p), mean over the strongest
    time."""


@dataclass(frozen=True, eq=False)
class DriveEnvelope:
    """Envelope of a drive, up to _RINGING after its end or until it is steady."""

    values: FloatArray
    """Envelope (n,) at even steps."""
    step: float
    """Time [s] between values."""
    within: int
    """Number of steps over which it is felt: the strongest ones of an envelope, else the first."""
    share: float = 1.0
    """Fraction of the duration covered by these steps; the rest is steady."""
    is_course: bool = False

    @classmethod
    def of_pulse(cls, duration: float, ramp: float) -> "DriveEnvelope":
        """Build the envelope of a pulse of a duration [s] with plain ramps [s].

        It includes the ringing after the end, where a quiet finger can feel most.
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
        """Build the envelope of a course, with a plain ramp if it starts or ends above 0."""
        count = math.ceil((course.duration + _RINGING) / course.step)
        times = np.asarray(course.step * np.arange(count), dtype=float)
        after, (first, *_, last) = np.asarray(times - course.duration), course.shares
        values = course.at(times) - first * (1 - rise(times, ONSET_RAMP))
        values += np.where(after > 0, last * (1 - rise(after, ONSET_RAMP)), 0.0)
        within = round(STRONGEST / course.step)
        return cls(np.maximum(values, SILENCE), course.step, within, is_course=True)

    def moments(self, squares: FloatArray) -> FloatArray:
        """Means of squares (n, ...) over the felt time, starting at each step, (n', ...)."""
        sums = np.cumsum(squares, axis=0, dtype=float)
        sums[self.within :] -= sums[: -self.within].copy()
        return np.asarray(sums[self.within - 1 :] / self.within)

    def felt(self, squares: FloatArray, weights: FloatArray) -> OverDuration:
        """Return the sensation of k fingers from squared amplitudes relative to the threshold (n +
        1, k, p).

        The last square is that of the steady vibration; weights (k, p): of the points in the mean
        over a fingertip.
        """
        power = self.share * self.moments(squares[:-1]) + (1 - self.share) * squares[-1]
        own = power if self.is_course else power[:1]
        felt = (np.sqrt(own) * weights).sum(axis=2).max(axis=0)
        steady = (np.sqrt(squares[-1]) * weights).sum(axis=1)
        return OverDuration(felt / np.maximum(steady, 1e-30), power.max(axis=0))

    def shares_at(self, off: FloatArray) -> FloatArray:
        """Return the fraction (b,) of the steady power in tones at distances (b,) [Hz] from the
        drive's.

        Together the tones have the energy of the drive on any plate (Parseval); for an envelope,
        the energy of its strongest moments. Energy between two tones is split in proportion to
        nearness, but near the drive's own frequency, which can be in a null, by the square of
        nearness.
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
