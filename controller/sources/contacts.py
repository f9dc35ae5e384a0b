"""The contacts on the plate, from any sequence of touch frames."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from controller.sources.eviction import to_evict
from controller.sources.loads import LANDING, followed
from controller.sources.motion import AT_REST, Motion
from controller.sources.touch import Touch, TouchFrame
from model.finger import MAX_CONTACTS
from model.structure.plate import Plate

RIM = 0.0065
"""How far beyond the plate's edge [m] a finger counts as on it: a fingertip's radius.

Where cameras and frames report a finger on the edge depends on noise and calibration.
"""

# s; most sources repeat their frames at least every 100 ms, others state their own timeout. A
# contact that is not confirmed must not be driven.
CONTACT_TIMEOUT = 0.150

# s; no sensor may stay silent for longer under a resting finger.
MAX_CONTACT_TIMEOUT = 60.0

# s; no finger leaves the plate so soon: its frames were held up and came together.
MAX_GLIMPSE = 0.005

# s; how long such a contact is kept, so that a click is decided, loaded and felt.
TAP_TIME = 0.060


class ContactKey(NamedTuple):
    """Identifies a contact: its source and the id within that source."""

    source: str
    id: int


@dataclass(frozen=True, slots=True)
class Contact:
    """A finger on the plate at x, y [m] from its south-west corner, down since a time [s].

    load: relative to the rig's fingertip, bounded and in steps, 1 where nothing is
    reported. motion: its way of late.
    """

    key: ContactKey
    x: float
    y: float
    since: float
    load: float = 1.0
    motion: Motion = field(default=AT_REST, compare=False)


@dataclass(frozen=True, slots=True)
class Change:
    """Contacts that came down, moved, pressed harder or less and lifted, each as it is or was.

    rejected: a reason for each touch that was not accepted.
    """

    down: tuple[Contact, ...] = ()
    moved: tuple[Contact, ...] = ()
    pressed: tuple[Contact, ...] = ()
    up: tuple[Contact, ...] = ()
    rejected: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether any contact changed."""
        return bool(self.down or self.moved or self.pressed or self.up)


_UNCHANGED = Change()


@dataclass(frozen=True, slots=True)
class _Source:
    """A source with contacts: the time [s] of its last frame, and its origin.

    expiry [s]: when its contacts are lifted unless another frame arrives.
    """

    received: float
    timeout: float
    expiry: float
    origin: str


class ContactTracker:
    """The contacts on one plate. Deterministic: times are arguments.

    x = X L and y = (1 - Y) W, since touch sensors count Y downwards. A touch at most `RIM` outside
    the plate (0..1) is at its edge. Rejects touches that are farther off, have non-finite
    coordinates or repeat an id within a frame (the last one counts); a contact whose touch is
    rejected is lifted. Where the maximum number of contacts
    is reached, a contact of the input, origin or source with most is evicted if it has at least
    two more than that of the touch; else the touch is rejected.
    """

    def __init__(self, plate: Plate) -> None:
        self._plate = plate
        self._contacts: dict[ContactKey, Contact] = {}
        self._sources: dict[str, _Source] = {}
        self._taps: dict[ContactKey, float] = {}  # s; when contacts end that are lifted already
        self._newest = -math.inf  # s; time of the newest frame
        self.contacts: tuple[Contact, ...] = ()
        """All contacts in order of arrival; the newest is the last."""
        self.next_expiry = math.inf
        """When [s] the first contacts are lifted unless a frame of their source arrives."""
        self.changed: dict[ContactKey | None, float] = {}
        """When [s] contacts changed first that no set has answered; None: the first that lifted."""

    def expiry_of(self, key: ContactKey) -> float:
        """Return when [s] a contact is lifted unless a frame arrives; -inf for none of that key."""
        if key not in self._contacts:
            return -math.inf
        return min(self._sources[key.source].expiry, self._taps.get(key, math.inf))

    def sources_of(self, prefix: str) -> list[str]:
        """Return the sources with contacts whose names begin so."""
        return [name for name in self._sources if name.startswith(prefix)]

    def update(self, frame: TouchFrame, *, keeps_taps: bool = False) -> Change:
        """Apply a frame, which replaces the previous one of its source.

        keeps_taps: whether a contact is kept for a while whose lift comes together with it.
        """
        rejected: list[str] = []
        touches: dict[ContactKey, Touch] = {}
        if math.isfinite(frame.time):
            touches = _valid_touches(frame, self._plate, rejected)
        elif frame.touches:
            rejected.append("no_time")
        if keeps_taps:
            self._keep_taps(frame)
        gone = []
        for key in self._contacts:
            if key.source == frame.source and (key in touches) == (key in self._taps):
                gone.append(key)
        up = self._lift(gone) if gone else ()
        self._sources[frame.source] = _source_of(frame)
        down: list[Contact] = []
        moved: list[Contact] = []
        pressed: list[Contact] = []
        for key, touch in touches.items():
            known = self._contacts.get(key)
            if known is None and len(self._contacts) >= MAX_CONTACTS:
                origins = {name: each.origin for name, each in self._sources.items()}
                evicted = to_evict([each.source for each in self._contacts], key.source, origins)
                if evicted is None:
                    rejected.append("too_many")
                    continue
                up += self._lift([[*self._contacts][evicted]])
            contact = self._contacts[key] = self._contact(key, touch, known, frame.time)
            if known is None:
                down.append(contact)
            elif (known.x, known.y) != (contact.x, contact.y):
                moved.append(contact)
            elif known.load != contact.load:
                pressed.append(contact)
        if up:
            self._note_lifts(up, frame.time)
        for contact in (*down, *moved, *pressed):
            self.changed.setdefault(contact.key, frame.time)
        self._note_next()
        return Change(tuple(down), tuple(moved), tuple(pressed), up, tuple(rejected))

    def expire(self, now: float) -> Change:
        """Lift the contacts of all sources that have timed out at now [s]."""
        if self._newest <= now < self.next_expiry:
            return _UNCHANGED
        # Frames dated in the future are treated as received now.
        expired = [name for name, source in self._sources.items() if source.expiry <= now]
        ended = [key for key, end in self._taps.items() if end <= now]
        up: tuple[Contact, ...] = ()
        if expired or ended:
            up = self._lift(key for key in self._contacts if key.source in expired or key in ended)
        for name, source in self._sources.items():
            if source.received > now:
                self._sources[name] = replace(source, received=now, expiry=now + source.timeout)
        self._note_lifts(up, now)
        self._note_next()
        return Change(up=up) if up else _UNCHANGED

    def wait_again(self, answered: Mapping[ContactKey | None, float]) -> None:
        """Note contacts as changed since times [s], whose answer has not been played after all."""
        for key, at in answered.items():
            waiting = key if key in self._contacts else None  # it has lifted meanwhile
            self.changed[waiting] = min(at, self.changed.get(waiting, at))

    def _contact(
        self, key: ContactKey, touch: Touch, known: Contact | None, time: float
    ) -> Contact:
        """Return the contact of a touch, down since a time [s] unless it is known.

        One whose panel stops reporting loads keeps its own.
        """
        since, load = (time, 1.0) if known is None else (known.since, known.load)
        if touch.load is not None and time - since >= LANDING:
            load = followed(load, touch.load)
        x, y = touch.x * self._plate.length, (1 - touch.y) * self._plate.width
        motion = AT_REST if known is None else known.motion
        return Contact(key, x, y, since, load, motion.followed(time, x, y))

    def _keep_taps(self, frame: TouchFrame) -> None:
        """Keep contacts that have just come down and are not in a frame any more."""
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

    def _note_lifts(self, up: Iterable[Contact], time: float) -> None:
        """Note that contacts have changed for the last time at a time [s]."""
        for contact in up:
            first = self.changed.pop(contact.key, time)
            self.changed[None] = min(first, self.changed.get(None, time))

    def _note_next(self) -> None:
        """Forget sources without contacts, and note when the others expire."""
        sources, ends = {}, [*self._taps.values()]
        for key in self._contacts:
            sources[key.source] = self._sources[key.source]
        self._newest = -math.inf
        for source in sources.values():
            ends.append(source.expiry)
            self._newest = max(self._newest, source.received)
        self._sources, self.contacts = sources, tuple(self._contacts.values())
        self.next_expiry = min(ends, default=math.inf)


def _source_of(frame: TouchFrame) -> _Source:
    timeout = frame.timeout
    if timeout is None or not 0 < timeout <= MAX_CONTACT_TIMEOUT:  # NaN is not
        timeout = CONTACT_TIMEOUT
    origin = frame.source if frame.origin is None else frame.origin
    return _Source(frame.time, timeout, frame.time + timeout, origin)


def _valid_touches(frame: TouchFrame, plate: Plate, rejected: list[str]) -> dict[ContactKey, Touch]:
    """Return the touches that can be contacts; add a reason for each of the others."""
    last: dict[int, Touch] = {}
    for touch in frame.touches:
        last[touch.id] = touch
    rejected += ["twice"] * (len(frame.touches) - len(last))
    valid = {}
    for touch in last.values():
        if not (math.isfinite(touch.x) and math.isfinite(touch.y)):
            rejected.append("not_finite")
        elif 0 <= touch.x <= 1 and 0 <= touch.y <= 1:
            valid[ContactKey(frame.source, touch.id)] = touch
        else:
            x, y = min(max(touch.x, 0.0), 1.0), min(max(touch.y, 0.0), 1.0)
            beyond = math.hypot((touch.x - x) * plate.length, (touch.y - y) * plate.width)
            if beyond > RIM:
                rejected.append("off_plate")
            else:
                valid[ContactKey(frame.source, touch.id)] = replace(touch, x=x, y=y)
    return valid
