"""Touches: sources and their frames, calibration to the plate, and tracking of contacts.

A source delivers frames with all of its touches at one moment. A calibration is an affine map from
sensor to plate coordinates: x' = a x + b y + c, y' = d x + e y + f, with coordinates 0..1 from the
top left corner. A tracker follows the contacts on the plate through any sequence of frames, and
decides which contact to drop if there are more than the plate supports.

The load of a finger is relative to the rig's `fingertip`, a lightly pressing finger, and grows with
the contact area (`Fingertip.scaled`). Area, and so load, grows with the force to the power of 2/3
(Hertz); this is between 1/3, the exponent of Hertz's stiffness, and 1, that of a pulp with
exponential stiffening. docs/concepts/people.md gives the sources and their uncertainty.

The velocity of a finger is the least-squares slope of its positions over the last 60 ms. Reported
positions have errors of a millimetre: a finger whose positions differ by less than 3 mm in that
time counts as resting.
"""

import logging
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, TypeAlias
from urllib.parse import parse_qsl

from model.errors import InputError
from registry import threads
from registry.limits import (
    HAND_LOAD,
    MAX_CONTACTS,
    MAX_FINGER_LOAD,
    MAX_FINGERS,
    MAX_HAND_LOAD,
)
from registry.plugins import PluginRegistry

if TYPE_CHECKING:  # numpy is slow to import
    from model.structure.plate import Plate

LOG_INTERVAL = 1.0  # s


class RejectCounter:
    """Counts rejections by reason; logs new reasons, and others at most once per LOG_INTERVAL."""

    def __init__(
        self,
        logger: logging.Logger,
        *,
        clock: Callable[[], float] = threads.now,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        """Printable detail of the newest rejection for each reason."""
        self._logger = logger
        self._clock = clock
        self._unlogged = 0
        self._logged_at = -math.inf

    def count(self, reason: str, detail: str) -> None:
        """Count a rejection; log its detail if the reason is new or was not logged recently."""
        self.counts[reason] += 1
        self.examples[reason] = detail if detail.isprintable() else ascii(detail)
        self._unlogged += 1
        now = self._clock()
        if self.counts[reason] > 1 and now - self._logged_at < LOG_INTERVAL:
            return
        self._logger.warning(
            "%s: %s (new=%d, total: %s)",
            reason.replace("_", " "),
            self.examples[reason],
            self._unlogged,
            ", ".join(f"{key} {count}" for key, count in sorted(self.counts.items())),
        )
        self._unlogged = 0
        self._logged_at = now


@dataclass(frozen=True, slots=True)
class Touch:
    """One finger as reported by its source, not validated: coordinates can be NaN."""

    id: int
    """Constant from touch-down to lift."""
    x: float
    """0..1 across the sensor from its top left corner, as for TUIO and most panels."""
    y: float
    """0..1 downwards."""
    load: float | None = None
    """Load relative to the rig's fingertip, above MAX_FINGER_LOAD for a resting hand (HAND_LOAD if
    its size is unknown); None if not reported."""
    size: tuple[float, float] | None = None
    """Width and height of the contact relative to the sensor; gives the load if none is reported.
    None if unknown."""


@dataclass(frozen=True, slots=True)
class TouchFrame:
    """All touches of a source at one moment; a touch missing from it has been lifted."""

    source: str
    time: float
    """Arrival time [s] on the event loop's clock."""
    touches: tuple[Touch, ...]
    timeout: float | None = None
    """Time [s] without a frame of the source after which its touches are lifted; None:
    CONTACT_TIMEOUT."""
    origin: str | None = None
    """Host or client, which can have several sources; None: the source itself."""

    @property
    def expiry(self) -> float:
        """Time [s] when its touches are lifted, unless another frame of the source arrives."""
        stated = self.timeout
        is_valid = stated is not None and 0 < stated <= MAX_CONTACT_TIMEOUT  # NaN is not
        return self.time + (stated if stated is not None and is_valid else CONTACT_TIMEOUT)


MAX_FRAME_AGE = 1.0
"""Age [s] of a frame beyond which its timestamp comes from another or an adjusted clock."""


def frame_moment(stated: float, now: float) -> float:
    """Return the time [s] of a frame: its timestamp, or now if that is from another clock."""
    return stated if now - MAX_FRAME_AGE <= stated <= now else now


class TouchSource(ABC):
    """A source of touch frames, repeated at least every 100 ms while there are touches.

    A source that cannot repeat its frames states a longer timeout in them.
    """

    @cached_property
    def rejects(self) -> RejectCounter:
        """Counter of malformed input; a daemon sets its own, before `run`."""
        return RejectCounter(logging.getLogger(__name__))

    @property
    def problem(self) -> str | None:
        """Why a running source delivers no touches, and the remedy; None if it works."""
        return None

    @abstractmethod
    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver frames until cancelled or, for a recording, until its end.

        Malformed input must be counted in `rejects`, not raised. Raises InputError if the source
        cannot be opened, or is lost.
        """


def number_option(options: str, name: str, *, default: float) -> float:
    """Return the numeric value of the only allowed option; NaN for anything else."""
    given = dict(parse_qsl(options, keep_blank_values=True))
    text = given.pop(name, str(default))
    try:
        return math.nan if given else float(text)
    except ValueError:
        return math.nan


TOUCH_SOURCES: PluginRegistry[Callable[[str], TouchSource]] = PluginRegistry(
    "touch source",
    "era_haptics.touch_sources",
    TouchSource,
    error=InputError,
    own={
        "evdev": "controller.sources.evdev:EvdevSource",
        "tuio": "controller.sources.tuio:TuioSource",
    },
    ending=":",
    example="tuio:127.0.0.1:3333",
)


def source_schemes() -> tuple[str, ...]:
    """URL schemes of touch sources, plug-ins last."""
    return TOUCH_SOURCES.names()


def open_source(url: str) -> TouchSource:
    """Create the touch source of a URL such as `tuio:127.0.0.1:3333` or `evdev:/dev/input/event5`.

    Raises InputError for an unknown scheme, a failing plug-in or an invalid URL.
    """
    return TOUCH_SOURCES.make(url)


_Row: TypeAlias = tuple[float, float, float]
_Point: TypeAlias = tuple[float, float]

MAX_RESIDUAL = 0.005
"""Largest residual [m] of a correctly touched point: less than a fingertip's radius of 6.5 mm."""

_MIN_DETERMINANT = 1e-3  # below it, the points on the plate are almost collinear

_ROTATIONS: dict[int, tuple[_Row, _Row]] = {
    0: ((1, 0, 0), (0, 1, 0)),
    90: ((0, -1, 1), (1, 0, 0)),
    180: ((-1, 0, 1), (0, -1, 1)),
    270: ((0, 1, 0), (-1, 0, 1)),
}


@dataclass(frozen=True)
class TouchCalibration:
    """Map from sensor to plate: the rows for x' and y'."""

    matrix: tuple[_Row, _Row] = _ROTATIONS[0]

    def apply(self, touch: Touch) -> Touch:
        """Map a touch to coordinates 0..1 across the plate; NaN stays NaN."""
        (a, b, c), (d, e, f) = self.matrix
        wide, high = touch.size or (0.0, 0.0)
        return replace(
            touch,
            x=a * touch.x + b * touch.y + c,
            y=d * touch.x + e * touch.y + f,
            size=touch.size and (math.hypot(a * wide, b * high), math.hypot(d * wide, e * high)),
        )


ALIGNED = TouchCalibration()
"""Calibration of a sensor aligned with the plate."""


def turned(degrees: int = 0, *, mirror: str | None = None) -> TouchCalibration:
    """Return the calibration of a sensor mounted turned clockwise by 0, 90, 180 or 270 degrees.

    mirror: "x" to swap left and right after that, "y" for top and bottom.
    """
    x_row, y_row = (
        (-a, -b, 1 - c) if axis == mirror else (a, b, c)
        for axis, (a, b, c) in zip("xy", _ROTATIONS[degrees], strict=True)
    )
    return TouchCalibration((x_row, y_row))


def fit_touch_calibration(
    touched: Sequence[_Point], positions: Sequence[_Point], plate: "Plate"
) -> TouchCalibration:
    """Fit a calibration by least squares to at least three points.

    touched: sensor coordinates 0..1; positions: on the plate [m] from its south-west corner, y
    upwards. Raises InputError for points on a line or residuals above 5 mm.
    """
    import numpy as np  # a source without a calibration does not need it

    expected = np.array([(x / plate.length, 1 - y / plate.width) for x, y in positions])
    measured = np.column_stack((np.array(touched, dtype=float), np.ones(len(touched))))
    solution = np.linalg.lstsq(measured, expected, rcond=None)[0]
    is_invertible = abs(np.linalg.det(solution[:2])) >= _MIN_DETERMINANT
    if np.linalg.matrix_rank(measured, tol=0.05) < 3 or not is_invertible:
        raise InputError(
            "points of the touch calibration must not lie on a line; touch three corners"
        )
    error = (measured @ solution - expected) * (plate.length, plate.width)
    distances = np.hypot(error[:, 0], error[:, 1])
    worst = int(np.argmax(distances))
    if distances[worst] > MAX_RESIDUAL:
        raise InputError(
            f"residual of touch calibration point {worst + 1} must be at most "
            f"{MAX_RESIDUAL * 1e3:g} mm, got {distances[worst] * 1e3:.1f} mm; check its position "
            "and whether the panel is curved"
        )
    (a, d), (b, e), (c, f) = solution.tolist()
    return TouchCalibration(((a, b, c), (d, e, f)))


LIGHT_FORCE = 0.5
"""Force [N] of a lightly pressing finger: mean of taps on touch screens."""

LIGHT_MAJOR = 9.4
"""Longer axis [mm] of its contact: mean of index fingers on touch screens."""

MIN_REPORTED, MAX_REPORTED = 0.4, 2.5
"""Bounds of a reported load: contacts of 6 to 15 mm, forces of 0.13 to 2 N.

They are two standard deviations of the rig's default `uncertainty` of a load. Values outside are
due to the panel rather than the finger.
"""

MAX_FINGER_MAJOR, HAND_MAJOR = 25.0, 50.0
"""Longer axis [mm] above which a contact is a hand (the largest fingers have 20 mm), and that of a
hand with `HAND_LOAD` (50 mm: a circle of 20 cm²)."""

LANDING = 0.1
"""Time [s] until the contact area of a landing finger is stable; earlier loads are ignored."""

MIN_CHANGE = 1.5
"""Minimum factor between a reported and the current load of a contact for a change."""

_BY_FORCE, _BY_SIZE = 2 / 3, 2.0  # exponents of the load


@dataclass(frozen=True)
class LightPress:
    """Values of a panel's axes under a lightly pressing finger.

    None for an axis that the panel lacks, or whose unit it does not report.
    """

    pressure: float | None = None
    touch_major: float | None = None

    def load(self, *, touch_major: float, pressure: float = 0.0) -> float | None:
        """Return the load of a contact with these values; force is preferred.

        None without a positive value of an axis. A contact larger than a finger has the load of a
        hand of its size, at least HAND_LOAD; a finger has at most MAX_FINGER_LOAD.
        """
        size = touch_major / (self.touch_major or math.inf)
        if size > MAX_FINGER_MAJOR / LIGHT_MAJOR:
            return HAND_LOAD * float(max(1.0, (size * LIGHT_MAJOR / HAND_MAJOR) ** _BY_SIZE))
        if self.pressure is not None and pressure > 0:
            return float(min((pressure / self.pressure) ** _BY_FORCE, MAX_FINGER_LOAD))
        return float(size**_BY_SIZE) if size > 0 else None


IN_MM = LightPress(touch_major=LIGHT_MAJOR)
"""Return the load for the longer axis [mm] of a contact."""


def followed(known: float, reported: float) -> float:
    """Return the load of a contact: the reported one, bounded, if it differs enough."""
    if not reported > 0:  # NaN is not
        return known
    bounded = min(max(reported, MIN_REPORTED), MAX_REPORTED)
    return bounded if max(bounded / known, known / bounded) >= MIN_CHANGE else known


OVER = 0.060
"""Time window [s] of a velocity; older frames are ignored."""

_LEAST_TIME, _LEAST_WAY = 0.020, 0.003  # s, m; of a velocity


@dataclass(frozen=True, slots=True)
class FingerMotion:
    """The recent path of a finger."""

    places: tuple[tuple[float, float, float], ...] = ()
    """Time [s], x and y [m] of each position; the last one is the current position."""

    def followed(self, time: float, x: float, y: float) -> "FingerMotion":
        """Return the path with another position at a time [s]."""
        since = time - OVER
        return FingerMotion(
            (*[each for each in self.places if since < each[0] < time], (time, x, y))
        )

    def velocity(self, now: float) -> tuple[float, float]:
        """Return the velocity [m/s] at a time [s]; zero for a resting finger."""
        places = [each for each in self.places if each[0] > now - OVER]
        if not places or places[-1][0] - places[0][0] < _LEAST_TIME:
            return 0.0, 0.0
        mean = [sum(values) / len(places) for values in zip(*places, strict=True)]
        variance = sum((time - mean[0]) ** 2 for time, _, _ in places)
        vx = sum((time - mean[0]) * (x - mean[1]) for time, x, _ in places) / variance
        vy = sum((time - mean[0]) * (y - mean[2]) for time, _, y in places) / variance
        is_moving = math.hypot(vx, vy) * (places[-1][0] - places[0][0]) >= _LEAST_WAY
        return (vx, vy) if is_moving else (0.0, 0.0)

    @property
    def is_under_way(self) -> bool:
        """Whether it moved at its last report."""
        return len(self.places) > 0 and any(self.velocity(self.places[-1][0]))


AT_REST = FingerMotion()
"""Motion of a finger with unknown path."""


def to_evict(sources: Sequence[str], newcomer: str, origins: Mapping[str, str]) -> int | None:
    """Return the index of the contact to lift for a new contact of a source, or None.

    This is the newest contact of the input, then the origin, then the source with the most
    contacts, if it has at least two more than the new contact's. sources: sources of all contacts
    in order of arrival; origins: by source.
    """
    groupings: tuple[Callable[[str], str], ...] = (_input_of, origins.__getitem__, str)
    left: list[int] = [*range(len(sources))]
    for depth, group_of in enumerate(groupings):
        counts = Counter(group_of(sources[each]) for each in left)
        own = group_of(newcomer)
        if max(counts.values(), default=0) > counts[own] + 1:
            for deeper in groupings[depth:]:
                ((fullest, _),) = Counter(deeper(sources[each]) for each in left).most_common(1)
                left = [each for each in left if deeper(sources[each]) == fullest]
            return left[-1]
        left = [each for each in left if group_of(sources[each]) == own]
    return None


def _input_of(source: str) -> str:
    """Return the first part of a source name: its input, or else its kind."""
    return source.partition(":")[0]


RIM = 0.0065
"""Distance [m] beyond the plate's edge where a finger still counts as on it: a fingertip's radius.

The position that cameras and frames report for a finger on the edge depends on noise and
calibration.
"""

CONTACT_TIMEOUT = 0.150
"""Default contact timeout [s]: an unconfirmed contact must not be driven.

Most sources repeat their frames at least every 100 ms; others state their own timeout.
"""

MAX_CONTACT_TIMEOUT = 60.0
"""Longest silence [s] of a sensor under a resting finger."""

MAX_GLIMPSE = 0.005
"""A contact shorter than this [s] was really longer: its frames were delayed and came together."""

TAP_TIME = 0.060
"""Such a contact is kept for this time [s], so that a click can be selected, loaded and felt."""


HAND_FEELS_NOTHING = "a resting hand feels no effect; lift it, and touch with a finger"

SURPLUS = "more fingers are on the plate than can feel effects (max_fingers); lift another one"


class ContactKey(NamedTuple):
    """Identifies a contact: its source and the id within that source."""

    source: str
    id: int


@dataclass(frozen=True, slots=True)
class Contact:
    """A finger on the plate."""

    key: ContactKey
    x: float
    """[m] from the south-west corner of the plate."""
    y: float
    """[m]"""
    since: float
    """Time [s] of its touch-down."""
    load: float = 1.0
    """Load relative to the rig's fingertip, bounded and in steps; 1 if not reported."""
    motion: FingerMotion = field(default=AT_REST, compare=False)
    """Its recent path."""
    is_surplus: bool = False
    """Whether max_fingers other fingers came before it."""

    @property
    def is_hand(self) -> bool:
        """Whether it is a resting hand, which loads the plate and feels nothing."""
        return self.load > MAX_FINGER_LOAD

    @property
    def why_load_alone(self) -> str | None:
        """Why only its load counts; None for a finger that can feel effects."""
        return HAND_FEELS_NOTHING if self.is_hand else SURPLUS if self.is_surplus else None


@dataclass(frozen=True, slots=True)
class Change:
    """Changed contacts, in their current or last state."""

    down: tuple[Contact, ...] = ()
    moved: tuple[Contact, ...] = ()
    pressed: tuple[Contact, ...] = ()
    """Contacts whose load has changed, or which have become surplus or fingers again."""
    up: tuple[Contact, ...] = ()
    rejected: tuple[str, ...] = ()
    """Reason of each rejected touch."""

    def __bool__(self) -> bool:
        """Whether any contact changed."""
        return bool(self.down or self.moved or self.pressed or self.up)


class ContactTracker:
    """Follows the contacts on one plate; times are arguments.

    x = X L and y = (1 - Y) W, because touch sensors count Y downwards. A touch up to a fingertip's
    radius outside the plate (0..1) is moved to the edge. Touches farther away, with non-finite
    coordinates, or with a repeated id in a frame (the last one counts) are rejected; a contact
    whose touch is rejected is lifted. Above the maximum number of contacts, the newest contact of
    the source with the most contacts is lifted for the new one, or the new one is rejected.
    Contacts beyond max_fingers are surplus until a finger lifts or turns out to be a hand.
    """

    def __init__(self, plate: "Plate", *, max_fingers: int = MAX_FINGERS) -> None:
        self._plate, self.max_fingers = plate, max_fingers
        self._contacts: dict[ContactKey, Contact] = {}
        self._sources: dict[str, TouchFrame] = {}  # last frame of each source
        self._taps: dict[ContactKey, float] = {}  # s; end times of contacts already lifted
        self._newest = -math.inf  # s; time of the newest frame
        self.contacts: tuple[Contact, ...] = ()
        """All contacts in order of arrival, newest last."""
        self.next_expiry = math.inf
        """Time [s] when the next contacts are lifted, unless a frame of their source arrives."""
        self.changed: dict[ContactKey | None, float] = {}
        """Time [s] of each contact's first change not yet answered by a set; None: of lifts."""

    def expiry_of(self, key: ContactKey) -> float:
        """Return the time [s] when a contact is lifted unless a frame arrives; -inf if unknown."""
        if key not in self._contacts:
            return -math.inf
        return min(self._sources[key.source].expiry, self._taps.get(key, math.inf))

    def sources_of(self, prefix: str) -> list[str]:
        """Return the sources with contacts whose names have a prefix."""
        return [name for name in self._sources if name.startswith(prefix)]

    def update(self, frame: TouchFrame, *, keeps_taps: bool = False) -> Change:
        """Apply a frame, which replaces the previous one of its source.

        keeps_taps: whether to keep a contact for a while if its lift arrives together with it.
        """
        rejected: list[str] = []
        touches: dict[ContactKey, Touch] = {}
        if math.isfinite(frame.time):
            touches = _valid_touches(frame, self._plate, rejected)
        elif frame.touches:
            rejected.append("no_time")
        if keeps_taps:
            self._keep_taps(frame)
        own = [key for key in self._contacts if key.source == frame.source]
        up = self._lift([key for key in own if (key in touches) == (key in self._taps)])
        self._sources[frame.source] = frame
        before = {**self._contacts}
        for key, touch in touches.items():
            known = before.get(key)
            if known is None and len(self._contacts) >= MAX_CONTACTS:
                origins = {name: each.origin or name for name, each in self._sources.items()}
                evicted = to_evict([each.source for each in self._contacts], key.source, origins)
                if evicted is None:
                    rejected.append("too_many")
                    continue
                up += self._lift([[*self._contacts][evicted]])
            self._contacts[key] = self._contact(key, touch, known, frame.time)
        return self._change(before, up, frame.time, rejected)

    def expire(self, now: float) -> Change:
        """Lift the contacts of all sources that have timed out at now [s]."""
        if self._newest <= now < self.next_expiry:
            return Change()
        # Frames dated in the future are treated as received now.
        expired = [name for name, source in self._sources.items() if source.expiry <= now]
        ended = [key for key, end in self._taps.items() if end <= now]
        before, up = {**self._contacts}, tuple[Contact, ...]()
        if expired or ended:
            up = self._lift(key for key in self._contacts if key.source in expired or key in ended)
        for name, source in self._sources.items():
            if source.time > now:
                self._sources[name] = replace(source, time=now)
        return self._change(before, up, now)

    def wait_again(self, answered: Mapping[ContactKey | None, float]) -> None:
        """Mark contacts as changed since these times [s]: their answer was not played."""
        for key, at in answered.items():
            waiting = key if key in self._contacts else None  # lifted meanwhile
            self.changed[waiting] = min(at, self.changed.get(waiting, at))

    def _contact(
        self, key: ContactKey, touch: Touch, known: Contact | None, time: float
    ) -> Contact:
        """Return the contact of a touch; a new contact is down since a time [s].

        A contact keeps its load if the panel stops reporting loads. A hand stays a hand until it is
        lifted, at its largest size so far, so that its last remains are not taken for a finger.
        """
        length, width = self._plate.length, self._plate.width
        since, load = (time, 1.0) if known is None else (known.since, known.load)
        x, y, reported = touch.x * length, (1 - touch.y) * width, touch.load
        if reported is None and touch.size is not None:
            longer = max(touch.size[0] * length, touch.size[1] * width)
            reported = IN_MM.load(touch_major=1e3 * longer)
        if (largest := max(load, reported or 0.0)) > MAX_FINGER_LOAD:
            largest = min(largest, MAX_HAND_LOAD)
            return Contact(key, x, y, since, load if largest < MIN_CHANGE * load else largest)
        if reported is not None and time - since >= LANDING:
            load = followed(load, reported)
        motion = AT_REST if known is None else known.motion
        return Contact(key, x, y, since, load, motion.followed(time, x, y))

    def _keep_taps(self, frame: TouchFrame) -> None:
        """Keep contacts that have just come down and are missing from a frame."""
        ids = {touch.id for touch in frame.touches}
        for key, contact in self._contacts.items():
            is_lifted = key.source == frame.source and key.id not in ids
            if is_lifted and frame.time - contact.since < MAX_GLIMPSE:
                self._taps.setdefault(key, contact.since + TAP_TIME)

    def _lift(self, keys: Iterable[ContactKey]) -> tuple[Contact, ...]:
        """Remove contacts and return them."""
        lifted = tuple(self._contacts.pop(key) for key in tuple(keys))
        for contact in lifted:
            self._taps.pop(contact.key, None)
        return lifted

    def _change(
        self,
        before: Mapping[ContactKey, Contact],
        up: tuple[Contact, ...],
        time: float,
        rejected: Sequence[str] = (),
    ) -> Change:
        """Determine surplus contacts, and return the changes at a time [s].

        up: contacts lifted since. Sources without contacts are forgotten.
        """
        down, moved, pressed, count = list[Contact](), list[Contact](), list[Contact](), 0
        for contact in up:  # for the last time
            self.changed[None] = min(
                self.changed.pop(contact.key, time), self.changed.get(None, time)
            )
        for key, contact in self._contacts.items():
            if count >= self.max_fingers and not contact.is_hand:
                contact = replace(contact, is_surplus=True)
            elif contact.is_surplus:
                contact = replace(contact, is_surplus=False)
            self._contacts[key], count = contact, count + (not contact.is_hand)
            known = before.get(key)
            if known is None:
                down.append(contact)
            elif (known.x, known.y) != (contact.x, contact.y):
                moved.append(contact)
            elif known != contact:
                pressed.append(contact)
        for contact in (*down, *moved, *pressed):
            self.changed.setdefault(contact.key, time)
        self.contacts = tuple(self._contacts.values())
        self._sources = {each.source: self._sources[each.source] for each in self._contacts}
        frames = self._sources.values()
        self._newest = max([each.time for each in frames], default=-math.inf)
        self.next_expiry = min(
            [*self._taps.values(), *[each.expiry for each in frames]], default=math.inf
        )
        return Change(tuple(down), tuple(moved), tuple(pressed), up, tuple(rejected))


def _valid_touches(
    frame: TouchFrame, plate: "Plate", rejected: list[str]
) -> dict[ContactKey, Touch]:
    """Return the valid touches; add a reason for each rejected one."""
    last: dict[int, Touch] = {}
    for touch in frame.touches:
        last[touch.id] = touch
    rejected += ["twice"] * (len(frame.touches) - len(last))
    valid = {}
    for touch in last.values():
        if not (math.isfinite(touch.x) and math.isfinite(touch.y)):
            rejected.append("not_finite")
        else:
            x, y = min(max(touch.x, 0.0), 1.0), min(max(touch.y, 0.0), 1.0)
            beyond = math.hypot((touch.x - x) * plate.length, (touch.y - y) * plate.width)
            if beyond > RIM or not plate.contains(x * plate.length, (1 - y) * plate.width):
                rejected.append("off_plate")
            else:
                valid[ContactKey(frame.source, touch.id)] = replace(touch, x=x, y=y)
    return valid
