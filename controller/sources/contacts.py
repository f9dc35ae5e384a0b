"""From what touch sources say to the set of contacts on the plate, whatever they say."""

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from controller.sources.touch import Touch, TouchFrame
from model.structure.plate import Plate

# A source repeats its frame every 100 ms at least; one that missed that by half is gone, and a
# finger nobody sees must not be driven.
CONTACT_TIMEOUT = 0.150

# Ten fingers; more than that is a forearm, a spill or a broken panel.
MAX_CONTACTS = 10


class ContactKey(NamedTuple):
    """Which contact: the source that sees it, and the id that the source gave it."""

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
    """What a frame or a moment changed: contacts that came, moved and went, each as it is or was.

    rejected: why touches of the frame were not taken, once per touch.
    """

    down: tuple[Contact, ...] = ()
    moved: tuple[Contact, ...] = ()
    up: tuple[Contact, ...] = ()
    rejected: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether the set of contacts or a place in it is another now."""
        return bool(self.down or self.moved or self.up)


class ContactTracker:
    """The contacts on one plate, from any sequence of frames; depends on nothing else.

    x = X L and y = (1 - Y) W, since touch sensors count Y downwards. Rejected and counted are
    touches that are not finite, off the plate (outside 0..1), there twice in a frame (the last one
    holds) or beyond the tenth contact; a contact whose touch is rejected is lifted.
    """

    def __init__(self, plate: Plate) -> None:
        self.rejected: Counter[str] = Counter()
        self._plate = plate
        self._contacts: dict[ContactKey, Contact] = {}
        self._heard: dict[str, float] = {}

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts in order of arrival; the newest is the last."""
        return tuple(self._contacts.values())

    @property
    def next_expiry(self) -> float | None:
        """When [s] the first source with contacts is overdue, if nothing is heard until then."""
        return min(self._heard.values()) + CONTACT_TIMEOUT if self._heard else None

    def update(self, frame: TouchFrame) -> Change:
        """Take over a frame: it replaces all that its source has said before."""
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
            self._heard[frame.source] = frame.time
        else:
            self._heard.pop(frame.source, None)
        self.rejected.update(rejected)
        return Change(tuple(down), tuple(moved), up, tuple(rejected))

    def expire(self, now: float) -> Change:
        """Lift all contacts of sources that were not heard for the lease; now [s]."""
        for source, heard in list(self._heard.items()):
            if heard + CONTACT_TIMEOUT <= now:  # as next_expiry puts it, to the last bit
                del self._heard[source]
            else:  # news from the future is news from now
                self._heard[source] = min(heard, now)
        return Change(up=self._lift(key for key in self._contacts if key.source not in self._heard))

    def _places(
        self, source: str, touches: tuple[Touch, ...], rejected: list[str]
    ) -> dict[ContactKey, tuple[float, float]]:
        """Places [m] of the touches that can be contacts."""
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
        """Forget contacts."""
        return tuple(self._contacts.pop(key) for key in tuple(keys))
