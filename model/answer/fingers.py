"""Fingers on a plate, and the stimulus that each is to feel."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from numbers import Real

import numpy as np

from model.answer.course import Course
from model.arrays import Point
from model.config.points import in_metres
from model.errors import InputError, expect_number, shown
from model.finger import FINGERTIP_RADIUS, MAX_CONTACTS, STRONG_DB_SL
from model.structure.attachments import check_loads
from model.structure.plate import Plate

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
