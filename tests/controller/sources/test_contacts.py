"""From touch frames to contacts."""

import math
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.contacts import CONTACT_TIMEOUT, ContactKey, ContactTracker
from controller.sources.touch import Touch, TouchFrame
from model.finger import MAX_CONTACTS
from model.structure.plate import Material, Plate

PLATE = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))


def frame(
    time: float,
    *touches: tuple[int, float, float],
    source: str = "a",
    timeout: float | None = None,
    origin: str | None = None,
) -> TouchFrame:
    """A frame of a source."""
    return TouchFrame(source, time, tuple(Touch(*touch) for touch in touches), timeout, origin)


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
    """Each change is reported once; a contact keeps the time since when it is down."""
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


def test_tracker_accepts_twenty_contacts() -> None:
    """The 21st contact is refused, the twenty that came first stay, and it gets a place later."""
    tracker = ContactTracker(PLATE)
    many = [(id, 0.5, 0.5) for id in range(21)]
    change = tracker.update(frame(0.0, *many))
    assert change.rejected == ("too_many",)
    tracker.update(frame(0.01, *reversed(many)))
    assert ids(tracker) == list(range(20))
    tracker.update(frame(0.02, *many[1:]))
    assert ids(tracker) == list(range(1, 21))


def fingers(count: int) -> list[tuple[int, float, float]]:
    """So many touches."""
    return [(id, 0.5, 0.5) for id in range(count)]


def shares(tracker: ContactTracker) -> dict[str, int]:
    """Number of contacts by source."""
    return dict(Counter(contact.key.source for contact in tracker.contacts))


def test_origin_that_has_all_contacts_gives_way_to_another() -> None:
    """Its newest contacts are lifted, one for each of the other's, until both have ten.

    No frame of either takes any back; what one lifts the other may have.
    """
    tracker = ContactTracker(PLATE)
    greedy = frame(0.0, *fingers(22), source="tuio:a", origin="x")
    tracker.update(greedy)
    change = tracker.update(frame(0.0, *fingers(1), source="tuio:b"))
    assert [contact.key for contact in change.up] == [("tuio:a", 19)]
    for _ in range(3):
        tracker.update(frame(0.0, *fingers(19), source="tuio:b"))
        tracker.update(greedy)
        assert shares(tracker) == {"tuio:a": 10, "tuio:b": 10}
    tracker.update(frame(0.0, *fingers(2), source="tuio:b"))
    tracker.update(greedy)
    assert shares(tracker) == {"tuio:a": 18, "tuio:b": 2}


def test_sources_of_one_origin_have_equal_shares() -> None:
    """Two browsers behind one gateway: the one with twenty fingers leaves ten to the other."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(0.0, *fingers(20), source="api:1:a", origin="api:1"))
    tracker.update(frame(0.0, *fingers(19), source="api:1:b", origin="api:1"))
    assert shares(tracker) == {"api:1:a": 10, "api:1:b": 10}


def test_origin_gains_nothing_by_many_sources() -> None:
    """Twenty names of one origin, or origins of one input, do not keep a panel out."""
    for origin in ("one", None):
        tracker = ContactTracker(PLATE)
        for number in range(20):
            tracker.update(frame(0.0, *fingers(1), source=f"tuio:{number}", origin=origin))
        tracker.update(frame(0.0, *fingers(10), source="panel:evdev"))
        assert shares(tracker)["panel:evdev"] == 10
        tracker.update(frame(0.0, *fingers(19), source="tuio:other"))
        expected = 5 if origin else 0  # all origins of the input have one contact each
        assert shares(tracker).get("tuio:other", 0) == expected
        assert shares(tracker)["panel:evdev"] == 10
        assert len(tracker.contacts) == MAX_CONTACTS


@pytest.mark.parametrize(
    ("stated", "timeout"),
    [(3.0, 3.0), (None, 0.15), (math.nan, 0.15), (math.inf, 0.15), (-1.0, 0.15), (61.0, 0.15)],
)
def test_tracker_waits_as_long_as_the_frame_states(stated: float | None, timeout: float) -> None:
    """A timeout of up to a minute counts; the next frame of the source may state another."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(10.0, (1, 0.5, 0.5), timeout=stated))
    assert tracker.next_expiry == pytest.approx(10.0 + timeout)
    assert not tracker.expire(10.0 + timeout - 0.001)
    assert tracker.expire(10.0 + timeout + 0.001)
    tracker.update(frame(20.0, (1, 0.5, 0.5), timeout=stated))
    tracker.update(frame(20.1, (1, 0.5, 0.5), timeout=1.0))
    assert tracker.next_expiry == pytest.approx(21.1)


def test_tracker_follows_loads_in_steps_once_a_finger_has_landed() -> None:
    """None in the first 100 ms; then only what differs by half, within 0.4 and 2.5.

    Times [s], reported loads, and the contact's; each change is one of pressure only.
    """
    tracker = ContactTracker(PLATE)
    for time, reported, load in [
        *((10.0, 0.2, 1.0), (10.05, 2.0, 1.0), (10.1, 1.45, 1.0), (10.11, 1.55, 1.55)),
        *((10.12, 1.04, 1.55), (10.13, 2.3, 1.55), (10.14, 2.4, 2.4), (10.15, 50.0, 2.4)),
        *((10.16, None, 2.4), (10.17, math.nan, 2.4), (10.18, -1.0, 2.4), (10.19, 1e-9, 0.4)),
        *((10.2, math.inf, 2.5), (10.21, 0.0, 2.5)),
    ]:
        before = tracker.contacts
        change = tracker.update(TouchFrame("a", time, (Touch(1, 0.5, 0.5, load=reported),)))
        (contact,) = tracker.contacts
        assert contact.load == load
        is_other = bool(before) and before[0].load != load
        assert change.pressed == ((contact,) if is_other else ())
        assert bool(change) == (is_other or not before)


@given(st.lists(st.floats(), max_size=30))
def test_tracker_bounds_whatever_is_reported(reported: list[float]) -> None:
    """A load is always within the bounds, and consecutive ones differ by half."""
    tracker, loads = ContactTracker(PLATE), [1.0]
    tracker.update(frame(0.0, (1, 0.5, 0.5)))
    for number, each in enumerate(reported):
        tracker.update(TouchFrame("a", 0.1 + number / 100, (Touch(1, 0.5, 0.5, load=each),)))
        loads.append(tracker.contacts[0].load)
    assert all(0.4 <= load <= 2.5 for load in loads)
    ratios = [max(a / b, b / a) for a, b in pairwise(loads)]
    assert all(ratio == 1 or ratio >= 1.5 for ratio in ratios)


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
    assert tracker.next_expiry == math.inf


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
    st.none() | st.floats(0, 1),
    st.none() | st.sampled_from("xy"),
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
        assert (tracker.next_expiry == math.inf) == (not contacts)
    tracker.expire(latest)
    tracker.expire(latest + 1.0)
    assert tracker.contacts == ()


def test_tracker_keeps_a_tap_whose_frames_come_together() -> None:
    """For 60 ms from its down, once, and only where taps are kept; another finger there is new."""
    tracker = ContactTracker(PLATE)
    for keeps_taps, left in ((False, []), (True, [1])):
        tracker.update(frame(1.0, (1, 0.5, 0.5)))
        change = tracker.update(frame(1.001), keeps_taps=keeps_taps)
        assert (ids(tracker), len(change.up)) == (left, 1 - len(left))
    key = ContactKey("a", 1)
    assert tracker.next_expiry == tracker.expiry_of(key) == pytest.approx(1.060)
    assert not tracker.update(frame(1.030), keeps_taps=True)
    assert not tracker.expire(1.059)
    assert [each.key for each in tracker.expire(1.0601).up] == [key]
    assert tracker.next_expiry == math.inf

    tracker.update(frame(2.0, (1, 0.5, 0.5)))
    tracker.update(frame(2.0), keeps_taps=True)
    change = tracker.update(frame(2.01, (1, 0.1, 0.5)), keeps_taps=True)
    assert ([each.x for each in change.up], [each.since for each in change.down]) == (
        [0.15],
        [2.01],
    )
    assert tracker.update(frame(2.02), keeps_taps=True).up  # 10 ms are no glimpse


def test_tracker_keeps_no_tap_that_is_rejected_evicted_or_out_of_time() -> None:
    """A touch off the plate, one too many, and a source that times out lift at once."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(1.0, (1, 0.5, 0.5)))
    assert tracker.update(frame(1.0, (1, 1.5, 0.5)), keeps_taps=True).up
    tracker.update(frame(2.0, (1, 0.5, 0.5)))
    tracker.update(frame(2.0, timeout=0.02), keeps_taps=True)
    assert tracker.expire(2.021).up
    tracker.update(frame(3.0, *((number, 0.5, 0.5) for number in range(MAX_CONTACTS))))
    tracker.update(frame(3.0), keeps_taps=True)
    assert len(tracker.update(frame(3.0, (1, 0.5, 0.5), source="b"), keeps_taps=True).up) == 1
