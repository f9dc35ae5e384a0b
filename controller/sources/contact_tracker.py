"""Tracking: follows the contacts on the plate through any sequence of frames.

If there are more contacts than the plate supports, `to_evict` decides which one to drop.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from controller.sources.contact_load import IN_MM, LANDING, MIN_CHANGE, followed
from controller.sources.touch import (
    Change,
    Contact,
    ContactKey,
    Touch,
    TouchFrame,
    Track,
    track_with,
)
from registry.limits import MAX_CONTACTS, MAX_FINGER_LOAD, MAX_FINGERS, MAX_HAND_LOAD

if TYPE_CHECKING:  # numpy is slow to import
    from model.structure.plate import Plate

RIM = 0.0065
"""Distance [m] beyond the plate's edge, a finger's radius, within which a finger touches the edge.

The position that cameras and frames report for a finger on the edge depends on noise and
calibration.
"""

MAX_GLIMPSE = 0.005
"""A contact shorter than this [s] was really longer: its frames were delayed and came together."""

TAP_TIME = 0.060
"""Such a contact is kept for this time [s], so that a click can be selected, loaded and felt."""


_IndexedSource: TypeAlias = tuple[int, str]
"""Index of a contact, in order of arrival, and its source."""

_Grouping: TypeAlias = Callable[[str], str]
"""Returns the group of a source."""


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
        self.max_fingers = max_fingers
        self.contacts: tuple[Contact, ...] = ()
        """All contacts in order of arrival, newest last."""
        self.next_expiry = math.inf
        """Time [s] when the next contacts are lifted, unless a frame of their source arrives."""
        self._changed: dict[ContactKey | None, float] = {}
        self._plate = plate
        self._contacts: dict[ContactKey, Contact] = {}
        self._frames: dict[str, TouchFrame] = {}  # last frame of each source
        self._tap_ends: dict[ContactKey, float] = {}  # s; of contacts that are lifted already
        self._newest = -math.inf  # s; time of the newest frame

    @property
    def changed(self) -> Mapping[ContactKey | None, float]:
        """Time [s] of each contact's first change not yet answered by a set; None: first lift."""
        return self._changed

    def take_changes(
        self, keys: Collection[ContactKey | None] | None = None
    ) -> dict[ContactKey | None, float]:
        """Return the changes of some contacts, or of all, which are answered now."""
        if keys is None:
            keys = self._changed.keys()
        answered = {key: time for key, time in self._changed.items() if key in keys}
        for key in answered:
            del self._changed[key]
        return answered

    def expiry_of(self, key: ContactKey) -> float:
        """Return the time [s] when a contact is lifted unless a frame arrives; -inf if unknown."""
        if key not in self._contacts:
            return -math.inf
        return min(self._frames[key.source].expiry, self._tap_ends.get(key, math.inf))

    def sources_of(self, prefix: str) -> list[str]:
        """Return the sources with contacts whose names have a prefix."""
        return [name for name in self._frames if name.startswith(prefix)]

    def update(self, frame: TouchFrame, *, keeps_taps: bool = False) -> Change:
        """Apply a frame, which replaces the previous one of its source.

        keeps_taps: whether to keep a contact for a while if its lift arrives together with it.
        """
        rejected: list[str] = []
        contacts: dict[ContactKey, Contact] = {}
        if math.isfinite(frame.time):
            touches = _valid_touches(frame, self._plate, rejected)
            # Before the first lift, so that the tracker stays consistent after an exception.
            contacts = self._contacts_at(touches, frame.time)
            if keeps_taps:
                self._keep_taps(frame)
        else:
            if frame.touches:
                rejected.append("no_time")
            # The contacts of its source are lifted at the time of the newest frame.
            frame = replace(frame, time=self._newest)
        up = self._lift(self._lifted_by(frame.source, contacts))
        self._frames[frame.source] = frame
        former_contacts = dict(self._contacts)
        for key, contact in contacts.items():
            if key not in former_contacts and len(self._contacts) >= MAX_CONTACTS:
                evicted = self._evicted_by(key.source)
                if evicted is None:
                    rejected.append("too_many")
                    continue
                up += self._lift([evicted])
            self._contacts[key] = contact
        return self._finish(former_contacts, up, frame.time, rejected)

    def expire(self, now: float) -> Change:
        """Lift the contacts of all sources that have timed out at now [s]."""
        if self._newest <= now < self.next_expiry:
            return Change()
        former_contacts = dict(self._contacts)
        up = self._lift([key for key in self._contacts if self.expiry_of(key) <= now])
        # Frames dated in the future are treated as received now.
        for name, frame in self._frames.items():
            if frame.time > now:
                self._frames[name] = replace(frame, time=now)
        return self._finish(former_contacts, up, now)

    def wait_again(self, answered: Mapping[ContactKey | None, float]) -> None:
        """Mark contacts as changed since these times [s]: their answer was not played."""
        for key, at in answered.items():
            waiting = key if key in self._contacts else None  # lifted meanwhile
            self._changed[waiting] = min(at, self._changed.get(waiting, at))

    def _contacts_at(
        self, touches: Mapping[ContactKey, Touch], time: float
    ) -> dict[ContactKey, Contact]:
        """Return the contacts of touches at a time [s]."""
        contacts = {}
        for key, touch in touches.items():
            # A contact that is kept as a tap is lifted already; its id is now another touch.
            former = None if key in self._tap_ends else self._contacts.get(key)
            contacts[key] = self._contact(key, touch, former, time)
        return contacts

    def _contact(
        self, key: ContactKey, touch: Touch, former: Contact | None, time: float
    ) -> Contact:
        """Return the contact of a touch at a time [s]; former: its last state, None if new.

        A contact keeps its load if the panel stops reporting loads. A hand stays a hand until it is
        lifted, at its largest size so far, so that its last traces are not taken for a finger.
        """
        x = touch.x * self._plate.length
        y = (1 - touch.y) * self._plate.width
        since = time
        load = 1.0
        track: Track = ()
        if former is not None:
            since = former.since
            load = former.load
            track = former.track
        reported = self._reported_load(touch)
        largest = max(load, reported or 0.0)
        if largest > MAX_FINGER_LOAD:
            hand_load = min(largest, MAX_HAND_LOAD)
            if hand_load < MIN_CHANGE * load:
                hand_load = load
            return Contact(key, x, y, since, hand_load)
        if reported is not None and time - since >= LANDING:
            load = followed(load, reported)
        return Contact(key, x, y, since, load, track_with(track, time, x, y))

    def _reported_load(self, touch: Touch) -> float | None:
        """Return the load of a touch, or the load for its size; None if neither is reported."""
        if touch.load is not None or touch.size is None:
            return touch.load
        width, height = touch.size
        major = max(width * self._plate.length, height * self._plate.width)
        return IN_MM.load(touch_major=1e3 * major)

    def _lifted_by(self, source: str, touches: Collection[ContactKey]) -> list[ContactKey]:
        """Return the contacts of a source that its touches end."""
        own_keys = [key for key in self._contacts if key.source == source]
        return [key for key in own_keys if self._is_ended(key, touches)]

    def _is_ended(self, key: ContactKey, touches: Collection[ContactKey]) -> bool:
        """Whether the touches of its source end a contact."""
        if key in self._tap_ends:  # lifted already, so the same id is another touch
            return key in touches
        return key not in touches

    def _evicted_by(self, source: str) -> ContactKey | None:
        """Return the contact to lift for a new contact of a source, or None."""
        keys = list(self._contacts)
        origins = {name: frame.origin or name for name, frame in self._frames.items()}
        index = to_evict([key.source for key in keys], source, origins)
        return None if index is None else keys[index]

    def _keep_taps(self, frame: TouchFrame) -> None:
        """Keep contacts that have just come down and are missing from a frame."""
        ids = {touch.id for touch in frame.touches}
        for key, contact in self._contacts.items():
            is_lifted = key.source == frame.source and key.id not in ids
            if is_lifted and frame.time - contact.since < MAX_GLIMPSE:
                self._tap_ends.setdefault(key, contact.since + TAP_TIME)

    def _lift(self, keys: Iterable[ContactKey]) -> tuple[Contact, ...]:
        """Remove contacts and return them."""
        lifted = tuple(self._contacts.pop(key) for key in tuple(keys))
        for contact in lifted:
            self._tap_ends.pop(contact.key, None)
        return lifted

    def _finish(
        self,
        former_contacts: Mapping[ContactKey, Contact],
        up: tuple[Contact, ...],
        time: float,
        rejected: Sequence[str] = (),
    ) -> Change:
        """Finish an update at a time [s]: mark surplus contacts, and note and return all changes.

        up: contacts lifted since former_contacts.
        """
        self._mark_surplus()
        self.contacts = tuple(self._contacts.values())
        change = self._change(former_contacts, up, rejected)
        self._note_changes((*change.down, *change.moved, *change.pressed), up, time)
        self._update_times()
        return change

    def _change(
        self,
        former_contacts: Mapping[ContactKey, Contact],
        up: tuple[Contact, ...],
        rejected: Sequence[str],
    ) -> Change:
        """Compare the contacts with their former states."""
        down = []
        moved = []
        pressed = []
        for contact in self.contacts:
            former = former_contacts.get(contact.key)
            if former is None:
                down.append(contact)
            elif (former.x, former.y) != (contact.x, contact.y):
                moved.append(contact)
            elif former != contact:
                pressed.append(contact)
        return Change(tuple(down), tuple(moved), tuple(pressed), up, tuple(rejected))

    def _update_times(self) -> None:
        """Forget sources without contacts; determine the newest frame and the next expiry."""
        self._frames = {key.source: self._frames[key.source] for key in self._contacts}
        frames = self._frames.values()
        self._newest = max([frame.time for frame in frames], default=-math.inf)
        expiries = [*self._tap_ends.values(), *(frame.expiry for frame in frames)]
        self.next_expiry = min(expiries, default=math.inf)

    def _mark_surplus(self) -> None:
        """Mark all fingers beyond max_fingers as surplus; hands do not count."""
        fingers = 0
        for key, contact in self._contacts.items():
            is_surplus = fingers >= self.max_fingers and not contact.is_hand
            if contact.is_surplus != is_surplus:
                self._contacts[key] = replace(contact, is_surplus=is_surplus)
            fingers += not contact.is_hand

    def _note_changes(
        self, contacts: Iterable[Contact], up: Iterable[Contact], time: float
    ) -> None:
        """Note when [s] contacts changed or were lifted, unless an earlier change is noted."""
        for contact in up:
            changed_at = self._changed.pop(contact.key, time)
            self._changed[None] = min(changed_at, self._changed.get(None, time))
        for contact in contacts:
            self._changed.setdefault(contact.key, time)


def _valid_touches(
    frame: TouchFrame, plate: "Plate", rejected: list[str]
) -> dict[ContactKey, Touch]:
    """Return the valid touches; add a reason for each rejected one."""
    touches = {touch.id: touch for touch in frame.touches}  # the last one of each id
    rejected += ["twice"] * (len(frame.touches) - len(touches))
    valid = {}
    for touch in touches.values():
        if not (math.isfinite(touch.x) and math.isfinite(touch.y)):
            rejected.append("not_finite")
            continue
        x = min(max(touch.x, 0.0), 1.0)
        y = min(max(touch.y, 0.0), 1.0)
        beyond = math.hypot((touch.x - x) * plate.length, (touch.y - y) * plate.width)
        if beyond > RIM or not plate.contains(x * plate.length, (1 - y) * plate.width):
            rejected.append("off_plate")
            continue
        if (x, y) != (touch.x, touch.y):
            touch = replace(touch, x=x, y=y)
        valid[ContactKey(frame.source, touch.id)] = touch
    return valid


def to_evict(sources: Sequence[str], newcomer: str, origins: Mapping[str, str]) -> int | None:
    """Return the index of the contact to lift for a new contact of a source, or None.

    This is the newest contact of the input, then the origin, then the source with the most
    contacts, if it has at least two more than the new contact's. sources: sources of all contacts
    in order of arrival; origins: by source.
    """
    groupings: tuple[_Grouping, ...] = (_input_of, origins.__getitem__, str)
    contacts = list(enumerate(sources))
    for depth, group_of in enumerate(groupings):
        counts = Counter(group_of(source) for _, source in contacts)
        own_group = group_of(newcomer)
        if max(counts.values(), default=0) > counts[own_group] + 1:
            return _newest_of_fullest(contacts, groupings[depth:])
        contacts = _members(contacts, group_of, own_group)
    return None


def _newest_of_fullest(contacts: list[_IndexedSource], groupings: Sequence[_Grouping]) -> int:
    """Return the index of the newest contact in the fullest group, its fullest subgroup, etc."""
    for group_of in groupings:
        counts = Counter(group_of(source) for _, source in contacts)
        ((fullest, _),) = counts.most_common(1)
        contacts = _members(contacts, group_of, fullest)
    newest, _ = contacts[-1]
    return newest


def _members(
    contacts: list[_IndexedSource], group_of: _Grouping, group: str
) -> list[_IndexedSource]:
    """Return the contacts in a group."""
    return [contact for contact in contacts if group_of(contact[1]) == group]


def _input_of(source: str) -> str:
    """Return the first part of a source name: its input, or else its kind."""
    return source.partition(":")[0]
