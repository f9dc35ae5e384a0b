"""From touch frames to contacts."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.contacts import CONTACT_TIMEOUT, ContactKey, ContactTracker
from controller.sources.touch import Touch, TouchFrame
from model.finger import MAX_CONTACTS
from model.structure.plate import Material, Plate

PLATE = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))


def frame(time: float, *touches: tuple[int, float, float], source: str = "a") -> TouchFrame:
    """A frame of a source."""
    return TouchFrame(source, time, tuple(Touch(*touch) for touch in touches))


def ids(tracker: ContactTracker) -> list[int]:
    """Ids of the contacts in order of arrival."""
    return [contact.key.id for contact in tracker.contacts]


@pytest.mark.parametrize(
    ("touch", "place"),
    [
        ((0.0, 0.0), (0.0, 0.2)),  # top left of the sensor: north-west
        ((1.0, 0.0), (0.3, 0.2)),
        ((0.0, 1.0), (0.0, 0.0)),  # bottom left: south-west, the plate's origin
        ((0.25, 0.75), (0.075, 0.05)),
    ],
)
def test_tracker_maps_touches_to_the_plate(
    touch: tuple[float, float], place: tuple[float, float]
) -> None:
    """Touch y runs down from the top left corner, plate y up from the south-west one."""
    tracker = ContactTracker(PLATE)
    (contact,) = tracker.update(frame(0.0, (1, *touch))).down
    assert (contact.x, contact.y) == pytest.approx(place)


def test_tracker_reports_down_moved_up() -> None:
    """Each once; a contact keeps the time since when it is down."""
    tracker = ContactTracker(PLATE)
    change = tracker.update(frame(1.0, (7, 0.5, 0.5)))
    assert [contact.key for contact in change.down] == [ContactKey("a", 7)]
    assert not tracker.update(frame(1.01, (7, 0.5, 0.5)))
    change = tracker.update(frame(1.02, (7, 0.6, 0.5)))
    assert [(contact.x, contact.since) for contact in change.moved] == [(pytest.approx(0.18), 1.0)]
    change = tracker.update(frame(1.03))
    assert [contact.x for contact in change.up] == [pytest.approx(0.18)]
    assert tracker.contacts == ()


def test_tracker_keeps_the_order_of_arrival() -> None:
    """The newest contact is the last, in whatever order frames list them."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(0.0, (5, 0.1, 0.1)))
    tracker.update(frame(0.0, (1, 0.5, 0.5), source="b"))
    tracker.update(frame(0.1, (9, 0.2, 0.1), (5, 0.2, 0.2)))
    assert ids(tracker) == [5, 1, 9]
    tracker.update(frame(0.2, (9, 0.2, 0.1)))
    tracker.update(frame(0.3, (9, 0.2, 0.1), (5, 0.2, 0.2)))
    assert ids(tracker) == [1, 9, 5]


@pytest.mark.parametrize(
    ("x", "y", "reason"),
    [
        (math.nan, 0.5, "not_finite"),
        (0.5, math.inf, "not_finite"),
        (-0.001, 0.5, "off_plate"),
        (0.5, 1.001, "off_plate"),
    ],
)
def test_tracker_rejects_invalid_touches(x: float, y: float, reason: str) -> None:
    """An invalid position makes no contact, lifts its previous one, and is reported."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(0.0, (1, 0.5, 0.5), (2, 0.5, 0.5)))
    change = tracker.update(frame(0.01, (1, x, y), (2, 0.5, 0.5), (3, x, y)))
    assert [contact.key.id for contact in change.up] == [1]
    assert change.rejected == (reason, reason)
    assert ids(tracker) == [2]


def test_tracker_rejects_duplicates() -> None:
    """Of two touches with one id in a frame the last counts; it is reported."""
    tracker = ContactTracker(PLATE)
    change = tracker.update(frame(0.0, (1, 0.1, 0.5), (1, 0.9, 0.5)))
    assert [contact.x for contact in change.down] == [pytest.approx(0.27)]
    assert change.rejected == ("twice",)


def test_tracker_accepts_ten_contacts() -> None:
    """The eleventh contact is refused, the ten that came first stay, and it gets a place later."""
    tracker = ContactTracker(PLATE)
    many = [(id, 0.5, 0.5) for id in range(11)]
    change = tracker.update(frame(0.0, *many))
    assert change.rejected == ("too_many",)
    tracker.update(frame(0.01, *reversed(many)))
    assert ids(tracker) == list(range(10))
    tracker.update(frame(0.02, *many[1:]))
    assert ids(tracker) == list(range(1, 11))


def test_tracker_lifts_contacts_after_the_timeout() -> None:
    """A source without news for 150 ms has all its contacts lifted, others keep theirs."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(10.0, (1, 0.5, 0.5), (2, 0.5, 0.5)))
    tracker.update(frame(10.1, (1, 0.5, 0.5), source="b"))
    assert tracker.next_expiry == pytest.approx(10.15)
    assert not tracker.expire(10.149)
    assert [contact.key for contact in tracker.expire(10.151).up] == [("a", 1), ("a", 2)]
    assert [contact.key for contact in tracker.contacts] == [("b", 1)]
    tracker.update(frame(10.2, (1, 0.5, 0.5), source="b"))
    assert not tracker.expire(10.3)
    assert tracker.expire(10.36)
    assert tracker.next_expiry is None


@pytest.mark.parametrize("time", [math.nan, math.inf])
def test_tracker_rejects_frames_without_a_time(time: float) -> None:
    """Touches that could not time out make no contact."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(0.0, (1, 0.5, 0.5)))
    change = tracker.update(frame(time, (1, 0.5, 0.5)))
    assert change.rejected == ("no_time",)
    assert tracker.contacts == ()


def test_tracker_times_out_frames_from_the_future() -> None:
    """A frame from the future counts from when it is first processed."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(1e6, (1, 0.5, 0.5)))
    assert not tracker.expire(10.0)
    assert tracker.expire(10.0 + CONTACT_TIMEOUT)


NUMBERS = st.floats(allow_nan=True, allow_infinity=True) | st.floats(0, 1)
FRAMES = st.builds(
    TouchFrame,
    st.sampled_from("ab"),
    st.floats(allow_nan=True, allow_infinity=True) | st.floats(0, 1),
    st.lists(st.builds(Touch, st.integers(0, 14), NUMBERS, NUMBERS), max_size=14).map(tuple),
)


@given(st.lists(FRAMES | st.floats(0, 2)))
def test_tracker_invariants_for_any_sequence(events: list[TouchFrame | float]) -> None:
    """Contacts are on the plate, bounded and unique; changes add up to them."""
    tracker = ContactTracker(PLATE)
    told: dict[ContactKey, tuple[float, float]] = {}
    latest = 0.0
    for event in events:
        if isinstance(event, TouchFrame):
            change = tracker.update(event)
        else:
            latest = max(latest, event)
            change = tracker.expire(event)
        for contact in change.up:
            del told[contact.key]
        for contact in change.down:
            assert contact.key not in told
        for contact in change.moved:
            assert told[contact.key] != (contact.x, contact.y)
        told |= {c.key: (c.x, c.y) for c in (*change.down, *change.moved)}
        contacts = tracker.contacts
        assert told == {contact.key: (contact.x, contact.y) for contact in contacts}
        assert len(told) == len(contacts) <= MAX_CONTACTS
        assert all(PLATE.contains(contact.x, contact.y) for contact in contacts)
        assert all(math.isfinite(contact.since) for contact in contacts)
        assert (tracker.next_expiry is None) == (not contacts)
    tracker.expire(latest)
    tracker.expire(latest + CONTACT_TIMEOUT)
    assert tracker.contacts == ()
