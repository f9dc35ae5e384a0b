"""Fingers on a plate with the stimuli that they should feel, and checks of the input.

A stimulus is continuous or has a duration, with a constant level or an envelope
(`model.answer.envelope`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from model.answer.envelope import Course
from model.arrays import Point
from model.config.units import in_meters
from model.errors import InputError, expect_number, shown
from model.finger import FINGERTIP_RADIUS, STRONG_DB_SL
from model.structure.fingertips import check_loads
from model.structure.plate import Plate
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

_SHARED_BY_ALL = ("duration", "course", "is_limit")
"""Attributes of a stimulus that are equal for all fingers that feel the same vibration."""


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
    course: Course | None = field(default=None, hash=False, repr=False)
    """Envelope of the strength, which also sets the duration."""

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table; raises InputError."""
        if type(self.band_hz) is not tuple or [*map(type, self.band_hz)] != [float, float]:
            band = _pair(
                self.band_hz, what="band_hz", such_as="(40, 120), lowest and highest in Hz"
            )
            object.__setattr__(self, "band_hz", band)
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
            _check_course(self.course, self.duration)
            object.__setattr__(self, "duration", self.course.duration)
        if self.duration is not None:
            _check_duration(self.duration)
        if self.modulation_hz is not None:
            _check_modulation(self.modulation_hz)
            if self.duration is not None and self.course is None:
                raise InputError(
                    "modulation_hz must be left out for a stimulus with a duration but no course"
                )


def _check_course(course: Course, duration: float | None) -> None:
    """Raise InputError for anything but a course, or for another duration [s] than the course's."""
    if not isinstance(course, Course):
        raise InputError(
            f"course must be one such as era.Course((0, 0.5), (1, 0)), got {shown(course)}"
        )
    if duration is None:
        return
    expect_number(duration, what="duration", unit="seconds")
    if duration != course.duration:
        raise InputError(
            f"duration must be left out for a stimulus with a course, got {duration:g}"
        )


def _check_duration(duration: float) -> None:
    """Raise InputError for a duration [s] out of range."""
    expect_number(duration, what="duration", unit="seconds")
    if not _MIN_DURATION <= duration <= _MAX_DURATION:  # False for NaN
        raise InputError(
            f"duration must be from {_MIN_DURATION:g} to {_MAX_DURATION:g} s, got "
            f"{duration:g}; leave it out for a continuous stimulus"
        )


def _check_modulation(frequency: float) -> None:
    """Raise InputError for a frequency of modulation [Hz] out of range."""
    expect_number(frequency, what="modulation_hz", unit="Hz")
    if not MIN_MODULATION <= frequency <= MAX_MODULATION:
        raise InputError(
            f"modulation_hz must be from {MIN_MODULATION:g} to {MAX_MODULATION:g} Hz, got "
            f"{frequency:g}"
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
            position = _pair(
                self.at, what="position of a finger", such_as="(0.08, 0.06), x and y in meters"
            )
            object.__setattr__(self, "at", position)
        for what, unit in _UNITS.items():
            value = getattr(self, what)
            if type(value) is not float:
                expect_number(value, what=what, unit=unit)
            if math.isnan(value):
                raise InputError(f"{what} must be a number of {unit}, got {value}")
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
        """Whether the finger is only a load: a resting hand, or a finger without any request."""
        has_no_request = self.stimulus is None and not self.is_protected
        return has_no_request or self.load > MAX_FINGER_LOAD

    @property
    def name(self) -> str | None:
        """The name of its stimulus, None without one."""
        return None if self.stimulus is None else self.stimulus.name

    def may_feel_one_with(self, other: "Finger", *, are_apart: bool = True) -> bool:
        """Return whether both fingers can feel one vibration.

        are_apart: whether each could have its own vibration.
        """
        stimulus = self.stimulus
        other_stimulus = other.stimulus
        if stimulus is None or other_stimulus is None:
            return False
        if NEVER in (self.sharing, other.sharing):
            return False
        for what in _SHARED_BY_ALL:
            if getattr(stimulus, what) != getattr(other_stimulus, what):
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
        """All positions, targets first."""
        return (*self.targets, *self.quiet)


def together(placed: Placement, stimulus: Stimulus) -> list[Finger]:
    """Build the fingers of a placement: targets that must share one stimulus, and quiet ones."""
    finger_count = len(placed.contacts)
    loads = placed.loads or (1.0,) * finger_count
    if len(loads) != finger_count:
        raise InputError(f"loads must have one value per finger ({finger_count}), got {len(loads)}")
    fingers = []
    for number, (position, load) in enumerate(zip(placed.contacts, loads, strict=True)):
        is_target = number < len(placed.targets)
        finger_stimulus = stimulus if is_target else None
        fingers.append(Finger(position, finger_stimulus, load, sharing=MUST))
    return fingers


def check_on_plate(what: str, places: Iterable[Point], plate: Plate) -> None:
    """Raise InputError for positions [m] off the plate; what: their name in the message."""
    length, width = plate.length, plate.width
    for x, y in places:
        if not (0 <= x <= length and 0 <= y <= width):  # False for NaN
            raise InputError(
                f"{what} must be on the plate, from (0, 0) to ({length:g}, {width:g}) m, got "
                f"({x:g}, {y:g}) m{in_meters(x, y, length=length, width=width)}"
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
        check_loads([finger.load for finger in fingers if finger.stimulus])
        without_stimulus = [finger.load for finger in fingers if not finger.stimulus]
        check_loads(without_stimulus, highest=MAX_HAND_LOAD)
    check_on_plate("finger", [finger.at for finger in fingers], plate)
    for number, finger in enumerate(fingers):
        for other in fingers[:number]:
            _check_apart(finger, other)
            _check_alike(finger, other)


def _check_apart(finger: Finger, other: Finger) -> None:
    """Raise InputError for two fingers within a fingertip, unless they feel the same or nothing."""
    gap = math.dist(other.at, finger.at)
    if gap >= FINGERTIP_RADIUS or finger.is_load or other.is_load:
        return
    are_quiet = finger.stimulus is None and other.stimulus is None
    if gap > 0 and (are_quiet or finger.must_feel_one_with(other)):
        return
    x, y = finger.at
    other_x, other_y = other.at
    raise InputError(
        f"finger ({x:g}, {y:g}) m must be at least {1000 * FINGERTIP_RADIUS:g} mm from the one at "
        f"({other_x:g}, {other_y:g}) m"
    )


def _check_alike(finger: Finger, other: Finger) -> None:
    """Raise InputError for two fingers that must feel one vibration but ask for different ones."""
    stimulus = finger.stimulus
    other_stimulus = other.stimulus
    if stimulus is None or other_stimulus is None or not finger.must_feel_one_with(other):
        return
    for what in _SHARED_BY_ALL:
        if getattr(stimulus, what) != getattr(other_stimulus, what):
            x, y = finger.at
            other_x, other_y = other.at
            raise InputError(
                f"{what} of fingers that must feel one vibration must be the same, got different "
                f"ones at ({x:g}, {y:g}) and ({other_x:g}, {other_y:g}) m; give their stimuli "
                "different names"
            )


def check_level(level_db_sl: float) -> None:
    """Raise InputError for a level [dB SL] outside the allowed range."""
    if not MIN_LEVEL_DB_SL <= level_db_sl <= MAX_LEVEL_DB_SL:
        raise InputError(
            f"level must be between {MIN_LEVEL_DB_SL:g} and {MAX_LEVEL_DB_SL:g} dB SL, got "
            f"{level_db_sl:g}; 20 is strong, 12 is felt, 0 is the threshold, and at "
            f"{MAX_LEVEL_DB_SL:g} the exposure is 10 to 240 m/s² (ISO 5349-1)"
        )


def _pair(value: object, *, what: str, such_as: str) -> tuple[Any, Any]:
    """Return two numbers as a tuple; raises InputError for anything else."""
    numbers = value.tolist() if isinstance(value, np.ndarray) else value
    pair = tuple(numbers) if isinstance(numbers, Sequence) else ()
    if len(pair) != 2 or not (isinstance(pair[0], Real) and isinstance(pair[1], Real)):
        raise InputError(f"{what} must be two numbers such as {such_as}, got {shown(value)}")
    return pair
