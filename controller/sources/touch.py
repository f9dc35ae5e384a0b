"""Touches, their sources, and the contacts that they become.

A source delivers frames with all of its touches at one moment; `ContactTracker` in
`contact_tracker.py` turns them into contacts on the plate.
"""

import logging
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from statistics import linear_regression
from typing import NamedTuple, TypeAlias
from urllib.parse import parse_qsl

from model.errors import InputError
from registry import threads
from registry.limits import MAX_FINGER_LOAD
from registry.plugins import PluginRegistry

CONTACT_TIMEOUT = 0.150
"""Default contact timeout [s]: an unconfirmed contact must not be driven.

Most sources repeat their frames at least every 100 ms; others state their own timeout.
"""

MAX_CONTACT_TIMEOUT = 60.0
"""Longest silence [s] of a sensor under a resting finger."""

MAX_FRAME_AGE = 1.0
"""Age [s] of a frame beyond which its timestamp comes from another or an adjusted clock."""

OVER = 0.060
"""Time window [s] of a velocity; older frames are ignored."""

_MIN_DURATION = 0.020  # s; of the positions that a velocity is computed from
_MIN_DISTANCE = 0.003  # m; that a moving finger covers in this time

LOG_INTERVAL = 1.0  # s

HAND_FEELS_NOTHING = "a resting hand feels no effect; lift it, and touch with a finger"

SURPLUS = "more fingers are on the plate than can feel effects (max_fingers); lift another one"


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
        timeout = self.timeout
        if timeout is None or not 0 < timeout <= MAX_CONTACT_TIMEOUT:  # NaN is not
            timeout = CONTACT_TIMEOUT
        return self.time + timeout


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
        totals = [f"{name} {count}" for name, count in sorted(self.counts.items())]
        self._logger.warning(
            "%s: %s (new=%d, total: %s)",
            reason.replace("_", " "),
            self.examples[reason],
            self._unlogged,
            ", ".join(totals),
        )
        self._unlogged = 0
        self._logged_at = now


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
    values = dict(parse_qsl(options, keep_blank_values=True))
    text = values.pop(name, str(default))
    if values:
        return math.nan
    try:
        return float(text)
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


def open_source(url: str) -> TouchSource:
    """Create the touch source of a URL such as `tuio:127.0.0.1:3333` or `evdev:/dev/input/event5`.

    Raises InputError for an unknown scheme, a failing plug-in or an invalid URL.
    """
    return TOUCH_SOURCES.make(url)


class ContactKey(NamedTuple):
    """Identifies a contact: its source and the id within that source."""

    source: str
    id: int


Track: TypeAlias = tuple[tuple[float, float, float], ...]
"""Time [s], x and y [m] of the recent positions of a finger."""


def track_with(track: Track, time: float, x: float, y: float) -> Track:
    """Return a track with another position at a time [s], without positions that are too old."""
    start = time - OVER
    recent = [place for place in track if start < place[0] < time]
    return (*recent, (time, x, y))


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
    track: Track = field(default=(), compare=False)
    """Its recent positions; the last one is the current position. Empty for a hand."""
    is_surplus: bool = False
    """Whether max_fingers other fingers came before it."""

    @property
    def is_hand(self) -> bool:
        """Whether it is a resting hand, which loads the plate and feels nothing."""
        return self.load > MAX_FINGER_LOAD

    @property
    def why_load_alone(self) -> str | None:
        """Why only its load counts; None for a finger that can feel effects."""
        if self.is_hand:
            return HAND_FEELS_NOTHING
        return SURPLUS if self.is_surplus else None

    def velocity(self, now: float) -> tuple[float, float]:
        """Return the velocity [m/s] at a time [s]; zero for a resting finger.

        This is the least-squares slope of the positions over the last 60 ms. Reported positions
        have errors of a millimeter: a finger whose positions differ by less than 3 mm in that time
        counts as resting.
        """
        start = now - OVER
        places = [place for place in self.track if place[0] > start]
        if not places:
            return 0.0, 0.0
        times, x_values, y_values = zip(*places, strict=True)
        duration = times[-1] - times[0]
        if duration < _MIN_DURATION:
            return 0.0, 0.0
        vx = linear_regression(times, x_values).slope
        vy = linear_regression(times, y_values).slope
        is_moving = math.hypot(vx, vy) * duration >= _MIN_DISTANCE
        return (vx, vy) if is_moving else (0.0, 0.0)

    @property
    def is_under_way(self) -> bool:
        """Whether it moved at its last report."""
        return len(self.track) > 0 and any(self.velocity(self.track[-1][0]))


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
