"""The contacts on the plate, from any sequence of touch frames."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from controller.sources.touch import Touch, TouchFrame
from model.finger import MAX_CONTACTS
from model.structure.plate import Plate

# s; sources repeat their frames at least every 100 ms, and a contact that is not confirmed must not
# be driven.
CONTACT_TIMEOUT = 0.150


class ContactKey(NamedTuple):
    """Identifies a contact: its source and the id within that source."""

    source: str
    id: int


@dataclass(frozen=True, slots=True)
class Contact:
    """A finger on the plate at x, y [m] from its south-west corner, down since a time [s]."""

    key: ContactKey
    x: float
    y: float
    since: float


@dataclass(frozen=True, slots=True)
class Change:
    """Contacts that came down, moved and lifted, each as it is or was.

    rejected: a reason for each touch that was not accepted.
    """

    down: tuple[Contact, ...] = ()
    moved: tuple[Contact, ...] = ()
    up: tuple[Contact, ...] = ()
    rejected: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether any contact changed."""
        return bool(self.down or self.moved or self.up)


class ContactTracker:
    """The contacts on one plate. Deterministic: reads no clock.

    x = X L and y = (1 - Y) W, since touch sensors count Y downwards. Rejects touches that are off
    the plate (outside 0..1), have non-finite coordinates, repeat an id within a frame (the last one
    counts) or exceed the maximum number of contacts; a contact whose touch is rejected is
    lifted.
    """

    def __init__(self, plate: Plate) -> None:
        self._plate = plate
        self._contacts: dict[ContactKey, Contact] = {}
        self._last_frame: dict[str, float] = {}

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts in order of arrival; the newest is the last."""
        return tuple(self._contacts.values())

    @property
    def next_expiry(self) -> float | None:
        """When [s] the first source with contacts times out unless a frame of it arrives."""
        return min(self._last_frame.values()) + CONTACT_TIMEOUT if self._last_frame else None

    def update(self, frame: TouchFrame) -> Change:
        """Apply a frame, which replaces the previous one of its source."""
        rejected: list[str] = []
        places: dict[ContactKey, tuple[float, float]] = {}
        if math.isfinite(frame.time):
            places = self._places(frame.source, frame.touches, rejected)
        elif frame.touches:
            rejected.append("no_time")
        up = self._lift(
            key for key in self._contacts if key.source == frame.source and key not in places
        )
        down: list[Contact] = []
        moved: list[Contact] = []
        for key, (x, y) in places.items():
            known = self._contacts.get(key)
            if known is None and len(self._contacts) >= MAX_CONTACTS:
                rejected.append("too_many")
                continue
            contact = Contact(key, x, y, since=known.since if known else frame.time)
            self._contacts[key] = contact
            if known is None:
                down.append(contact)
            elif known != contact:
                moved.append(contact)
        if any(key.source == frame.source for key in self._contacts):
            self._last_frame[frame.source] = frame.time
        else:
            self._last_frame.pop(frame.source, None)
        return Change(tuple(down), tuple(moved), up, tuple(rejected))

    def expire(self, now: float) -> Change:
        """Lift the contacts of all sources that have timed out at now [s]."""
        for source, received in list(self._last_frame.items()):
            # Same expression as next_expiry, so both round alike.
            if received + CONTACT_TIMEOUT <= now:
                del self._last_frame[source]
            else:  # clamp timestamps in the future
                self._last_frame[source] = min(received, now)
        return Change(
            up=self._lift(key for key in self._contacts if key.source not in self._last_frame)
        )

    def _places(
        self, source: str, touches: tuple[Touch, ...], rejected: list[str]
    ) -> dict[ContactKey, tuple[float, float]]:
        """Return the places [m] of the touches that can be contacts."""
        last = {touch.id: touch for touch in touches}
        rejected += ["twice"] * (len(touches) - len(last))
        places = {}
        for touch in last.values():
            if not (math.isfinite(touch.x) and math.isfinite(touch.y)):
                rejected.append("not_finite")
            elif not (0 <= touch.x <= 1 and 0 <= touch.y <= 1):
                rejected.append("off_plate")
            else:
                places[ContactKey(source, touch.id)] = (
                    touch.x * self._plate.length,
                    (1 - touch.y) * self._plate.width,
                )
        return places

    def _lift(self, keys: Iterable[ContactKey]) -> tuple[Contact, ...]:
        """Remove contacts and return them."""
        return tuple(self._contacts.pop(key) for key in tuple(keys))
