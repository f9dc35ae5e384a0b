"""Contacts that are tracked from touch frames, and the speed of a finger on a panel with errors.

What a source rejects is counted.
"""

import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import (
    CONTACT_TIMEOUT,
    OVER,
    Contact,
    ContactKey,
    RejectCounter,
    Touch,
    TouchFrame,
    Track,
    track_with,
)
from controller.sources.touch_calibration import turned
from model.structure.material import Material
from model.structure.plate import Plate
from registry.limits import HAND_LOAD, MAX_CONTACTS

PLATE = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))


def frame(
    time: float,
    *touches: tuple[Any, ...],
    source: str = "a",
    timeout: float | None = None,
    origin: str | None = None,
) -> TouchFrame:
    """A frame of a source."""
    return TouchFrame(source, time, tuple(Touch(*touch) for touch in touches), timeout, origin)


@pytest.mark.parametrize(
    ("degrees", "mirror", "top_left", "top_right"),
    [
        (0, None, (0, 0), (1, 0)),
        (90, None, (1, 0), (1, 1)),
        (180, None, (1, 1), (0, 1)),
        (270, None, (0, 1), (0, 0)),
        (0, "x", (1, 0), (0, 0)),
        (0, "y", (0, 1), (1, 1)),
        (90, "y", (1, 1), (1, 0)),
    ],
)
def test_turned_maps_corners(
    degrees: int, mirror: str | None, top_left: tuple[int, int], top_right: tuple[int, int]
) -> None:
    """The sensor's upper corners lie on the plate where those of a turned sheet of paper lie."""
    calibration = turned(degrees, mirror=mirror)
    for corner, apply in (((0, 0), top_left), ((1, 0), top_right)):
        placed = calibration.apply(Touch(1, *corner))
        assert (placed.x, placed.y) == pytest.approx(apply)


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
    (contact,) = ContactTracker(PLATE).update(frame(0.0, (1, *touch))).down
    assert (contact.x, contact.y) == pytest.approx(place)


def fingers(count: int, *, first: int = 0) -> list[tuple[int, float, float]]:
    """So many touches."""
    return [(id, 0.5, 0.5) for id in range(first, first + count)]


@dataclass(frozen=True)
class Then:
    """A frame, or a time [s] at which is looked for what is over, and what is so thereafter.

    What is None is not looked at. contacts: in order of arrival, as source and id; down, moved, up,
    rejected: of the change; shares: number of contacts by source; expiry [s]: when the next ends;
    surplus: ids of contacts beyond ten fingers; pressed: of those that change in load, or in that.
    """

    event: TouchFrame | float
    contacts: Sequence[tuple[str, int]] | None = None
    down: Sequence[tuple[str, int]] | None = None
    moved: Sequence[tuple[float, float]] | None = None
    up: Sequence[tuple[str, int]] | None = None
    rejected: tuple[str, ...] | None = None
    shares: Mapping[str, int] | None = None
    expiry: float | None = None
    surplus: Sequence[int] | None = None
    pressed: Sequence[int] | None = None
    keeps_taps: bool = False


def invalid(x: float, y: float, reason: str) -> list[Then]:
    """An invalid position makes no contact, lifts its previous one, and is reported."""
    touches = (1, x, y), (2, 0.5, 0.5), (3, x, y)
    return [
        Then(frame(0.0, *fingers(2, first=1))),
        Then(frame(0.01, *touches), [("a", 2)], up=[("a", 1)], rejected=(reason,) * 2),
    ]


def waiting(stated: float | None, timeout: float) -> list[Then]:
    """A timeout of up to a minute counts; the next frame of the source may state another."""
    return [
        Then(frame(10.0, (1, 0.5, 0.5), timeout=stated), expiry=10.0 + timeout),
        Then(10.0 + timeout - 0.001, [("a", 1)]),
        Then(10.0 + timeout + 0.001, []),
        Then(frame(20.0, (1, 0.5, 0.5), timeout=stated), [("a", 1)]),
        Then(frame(20.1, (1, 0.5, 0.5), timeout=1.0), expiry=21.1),
    ]


def many(origin: str | None, others: Mapping[str, int]) -> list[Then]:
    """Twenty names of one origin, or origins of one input, do not keep a panel out."""
    return [
        *(Then(frame(0.0, *fingers(1), source=f"tuio:{n}", origin=origin)) for n in range(20)),
        Then(frame(0.0, *fingers(10), source="panel:evdev"), shares={"panel:evdev": 10}),
        Then(frame(0.0, *fingers(19), source="tuio:other"), shares={"panel:evdev": 10, **others}),
    ]


def no_time(time: float) -> list[Then]:
    """Touches that could not time out make no contact."""
    return [
        Then(frame(0.0, (1, 0.5, 0.5))),
        Then(frame(time, (1, 0.5, 0.5)), [], rejected=("no_time",)),
    ]


TAP = ("a", 1)
GREEDY = frame(0.0, *fingers(22), source="tuio:a", origin="x")
HALVES = {"tuio:a": 10, "tuio:b": 10}

SCENARIOS: Mapping[str, Sequence[Then]] = {
    # Each change is reported once; a contact keeps the time since when it is down.
    "down, moved and up": [
        Then(frame(1.0, (7, 0.5, 0.5)), down=[("a", 7)], moved=[], up=[], rejected=()),
        Then(frame(1.01, (7, 0.5, 0.5)), down=[], moved=[], up=[]),
        Then(frame(1.02, (7, 0.6, 0.5)), moved=[(pytest.approx(0.18), 1.0)], down=[]),
        Then(frame(1.03), [], up=[("a", 7)]),
    ],
    # The newest contact is the last, in whatever order frames list them.
    "order of arrival": [
        Then(frame(0.0, (5, 0.1, 0.1))),
        Then(frame(0.0, (1, 0.5, 0.5), source="b")),
        Then(frame(0.1, (9, 0.2, 0.1), (5, 0.2, 0.2)), [("a", 5), ("b", 1), ("a", 9)]),
        Then(frame(0.2, (9, 0.2, 0.1))),
        Then(frame(0.3, (9, 0.2, 0.1), (5, 0.2, 0.2)), [("b", 1), ("a", 9), ("a", 5)]),
    ],
    "not a number": invalid(math.nan, 0.5, "not_finite"),
    "infinite": invalid(0.5, math.inf, "not_finite"),
    "west of the plate": invalid(-0.025, 0.5, "off_plate"),
    "south of the plate": invalid(0.5, 1.033, "off_plate"),
    "beyond a corner": invalid(1.02, -0.025, "off_plate"),
    # On a plate of 300 mm by 200 mm: 6.3 mm beyond an edge a finger is at it, 6.6 mm is off.
    "a finger along the rim": [
        Then(frame(0.0, (1, 1.021, 0.5)), down=[TAP], rejected=()),
        Then(frame(0.1, (1, 0.99, 0.5)), up=[]),
        Then(frame(0.2, (1, 1.0005, 0.5)), moved=[(pytest.approx(0.3), 0.0)], up=[]),
        Then(frame(0.3, (1, -0.021, -0.001)), moved=[(0.0, 0.0)], up=[], rejected=()),
        Then(frame(0.4, (1, 1.022, 0.5)), [], up=[TAP], rejected=("off_plate",)),
    ],
    # Of two touches with one id in a frame the last counts; it is reported.
    "one id twice": [
        Then(
            frame(0.0, (1, 0.1, 0.5), (1, 0.9, 0.5)),
            [("a", 1)],
            down=[("a", 1)],
            rejected=("twice",),
        ),
        Then(frame(0.1, (1, 0.9, 0.5)), moved=[]),
    ],
    # The 21st contact is refused, the twenty that came first stay, and it gets a place later.
    "twenty contacts": [
        Then(frame(0.0, *fingers(21)), rejected=("too_many",)),
        Then(frame(0.01, *reversed(fingers(21))), [("a", id) for id in range(20)]),
        Then(frame(0.02, *fingers(20, first=1)), [("a", id) for id in range(1, 21)]),
    ],
    # Ten are fingers, in order of arrival and whatever moves; a hand takes no finger's place.
    "more fingers than those of one person": [
        Then(frame(0.0, *fingers(12)), surplus=[10, 11], pressed=[]),
        Then(frame(0.0, *fingers(2), source="b"), surplus=[10, 11, 0, 1]),
        Then(frame(0.01, *fingers(10), (10, 0.6, 0.5), (11, 0.5, 0.5)), pressed=[], down=[]),
        Then(
            frame(0.02, *fingers(9, first=1), (10, 0.6, 0.5), (11, 0.5, 0.5)),
            surplus=[11, 0, 1],
            pressed=[10],
        ),
        Then(
            frame(0.03, *fingers(10, first=1), (11, 0.5, 0.5, HAND_LOAD)),
            surplus=[0, 1],
            pressed=[11],
        ),
        Then(
            frame(0.04, (1, 0.5, 0.5, HAND_LOAD), *fingers(10, first=2)),
            surplus=[1],
            pressed=[1, 0],
        ),
        Then(0.1501, surplus=[], up=[("b", 0), ("b", 1)]),
        Then(0.1951, [], up=[*(("a", id) for id in range(1, 12))]),
    ],
    # Of those of a source that times out others become fingers.
    "fingers again": [
        Then(frame(0.0, *fingers(10))),
        Then(frame(0.1, *fingers(1), source="b"), surplus=[0]),
        Then(0.16, [("b", 0)], surplus=[], pressed=[0], expiry=0.25),
    ],
    # The newest contacts of one that has all are lifted, one for each of the other's, until both
    # have ten. No frame of either takes any back; what one lifts the other may have.
    "an origin that has all contacts gives way to another": [
        Then(GREEDY),
        Then(frame(0.0, *fingers(1), source="tuio:b"), up=[("tuio:a", 19)]),
        *(
            Then(frame(0.0, *fingers(19), source="tuio:b")),
            Then(GREEDY, shares=HALVES),
        )
        * 3,
        Then(frame(0.0, *fingers(2), source="tuio:b")),
        Then(GREEDY, shares={"tuio:a": 18, "tuio:b": 2}),
    ],
    # Two browsers behind one gateway: the one with twenty fingers leaves ten to the other.
    "sources of one origin have equal shares": [
        Then(frame(0.0, *fingers(20), source="tuio:a", origin="api:1")),
        Then(frame(0.0, *fingers(19), source="tuio:b", origin="api:1"), shares=HALVES),
    ],
    "many sources of one origin": many("one", {"tuio:other": 5}),
    # All origins of the input have one contact each.
    "many origins": many(None, {"tuio:other": 0}),
    # A source without news for 150 ms has all its contacts lifted, others keep theirs.
    "contact timeout": [
        Then(frame(10.0, *fingers(2, first=1))),
        Then(frame(10.1, (1, 0.5, 0.5), source="b"), expiry=10.15),
        Then(10.149, up=[]),
        Then(10.151, [("b", 1)], up=[("a", 1), ("a", 2)]),
        Then(frame(10.2, (1, 0.5, 0.5), source="b")),
        Then(10.3, [("b", 1)]),
        Then(10.36, [], expiry=math.inf),
    ],
    "no timeout stated": waiting(None, 0.15),
    "3 s stated": waiting(3.0, 3.0),
    "no number stated": waiting(math.nan, 0.15),
    "endless stated": waiting(math.inf, 0.15),
    "less than nothing stated": waiting(-1.0, 0.15),
    "more than a minute stated": waiting(61.0, 0.15),
    "a time that is no number": no_time(math.nan),
    "a time that never comes": no_time(math.inf),
    # It counts from when it is first processed.
    "a frame from the future": [
        Then(frame(1e6, (1, 0.5, 0.5))),
        Then(10.0, [TAP]),
        Then(10.0 + CONTACT_TIMEOUT, []),
    ],
    # For 60 ms from its down, once, and only where taps are kept; another finger there is new.
    "a tap whose frames come together": [
        Then(frame(1.0, (1, 0.5, 0.5))),
        Then(frame(1.001), [], up=[TAP]),
        Then(frame(1.0, (1, 0.5, 0.5))),
        Then(frame(1.001), [TAP], up=[], expiry=1.060, keeps_taps=True),
        Then(frame(1.030), down=[], moved=[], up=[], keeps_taps=True),
        Then(1.059, [TAP]),
        Then(1.0601, [], up=[TAP], expiry=math.inf),
        Then(frame(2.0, (1, 0.5, 0.5))),
        Then(frame(2.0), [TAP], keeps_taps=True),
        Then(frame(2.01, (1, 0.1, 0.5)), down=[TAP], up=[TAP], keeps_taps=True),
        Then(frame(2.02), [], up=[TAP], keeps_taps=True),  # 10 ms are no glimpse
    ],
    "a tap whose source then sends no time": [
        Then(frame(1.0, (1, 0.5, 0.5))),
        Then(frame(1.001), [TAP], keeps_taps=True),
        Then(frame(math.nan), [TAP], keeps_taps=True),
        Then(1.0601, [], up=[TAP], expiry=math.inf),
    ],
    # A touch off the plate, one too many, and a source that times out lift at once.
    "no tap": [
        Then(frame(1.0, (1, 0.5, 0.5))),
        Then(frame(1.0, (1, 1.5, 0.5)), [], keeps_taps=True),
        Then(frame(2.0, (1, 0.5, 0.5))),
        Then(frame(2.0, timeout=0.02), keeps_taps=True),
        Then(2.021, []),
        Then(frame(3.0, *fingers(MAX_CONTACTS))),
        Then(frame(3.0), shares={"a": MAX_CONTACTS}, keeps_taps=True),
        Then(
            frame(3.0, (1, 0.5, 0.5), source="b"),
            shares={"a": MAX_CONTACTS - 1, "b": 1},
            keeps_taps=True,
        ),
    ],
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_frames_become_contacts(name: str) -> None:
    """After every frame of a scenario, and at every time at which something may be over."""
    tracker = ContactTracker(PLATE)
    for then in SCENARIOS[name]:
        if isinstance(then.event, TouchFrame):
            change = tracker.update(then.event, keeps_taps=then.keeps_taps)
        else:
            change = tracker.expire(then.event)
        shares = Counter(contact.key.source for contact in tracker.contacts)
        found = {
            "contacts": [each.key for each in tracker.contacts],
            "down": [each.key for each in change.down],
            "moved": [(each.x, each.since) for each in change.moved],
            "up": [each.key for each in change.up],
            "rejected": change.rejected,
            "shares": {source: shares[source] for source in then.shares or ()},
            "expiry": pytest.approx(tracker.next_expiry),
            "surplus": [each.key.id for each in tracker.contacts if each.is_surplus],
            "pressed": [each.key.id for each in change.pressed],
        }
        wanted = {what: getattr(then, what) for what in found}
        wanted = {what: each for what, each in wanted.items() if each is not None}
        assert {what: found[what] for what in wanted} == wanted, then


@pytest.mark.parametrize("time", [math.nan, math.inf])
def test_lifts_are_dated_by_the_newest_frame_when_their_own_has_no_time(time: float) -> None:
    """The latency of a lift counts from the last known time, so it is a number."""
    tracker = ContactTracker(PLATE)
    tracker.update(frame(1.0, (1, 0.5, 0.5)))
    tracker.update(frame(1.02, (1, 0.5, 0.5), source="b"))
    tracker.take_changes()
    tracker.update(frame(time))
    assert tracker.changed == {None: 1.02}


def test_tracker_follows_loads_in_steps_once_a_finger_has_landed() -> None:
    """None in the first 100 ms; then only what differs by half, within 0.4 and 2.5.

    Times [s], reported loads, and the contact's; each change is one of pressure only.
    """
    tracker = ContactTracker(PLATE)
    for time, reported, load in [
        *((10.0, 0.2, 1.0), (10.05, 2.0, 1.0), (10.1, 1.45, 1.0), (10.11, 1.55, 1.55)),
        *((10.12, 1.04, 1.55), (10.13, 2.3, 1.55), (10.14, 2.4, 2.4), (10.15, 10.0, 2.4)),
        *((10.16, None, 2.4), (10.17, math.nan, 2.4), (10.18, -1.0, 2.4), (10.19, 1e-9, 0.4)),
        *((10.2, 9.0, 2.5), (10.21, 0.0, 2.5)),
    ]:
        before = tracker.contacts
        change = tracker.update(TouchFrame("a", time, (Touch(1, 0.5, 0.5, load=reported),)))
        (contact,) = tracker.contacts
        assert contact.load == load
        is_other = bool(before) and before[0].load != load
        assert change.pressed == ((contact,) if is_other else ())
        assert bool(change) == (is_other or not before)


NUMBERS = st.floats(allow_nan=True, allow_infinity=True) | st.floats(0, 1)
FRAMES = st.builds(
    TouchFrame,
    st.sampled_from("ab"),
    st.floats(allow_nan=True, allow_infinity=True) | st.floats(0, 1),
    st.lists(st.builds(Touch, st.integers(0, 14), NUMBERS, NUMBERS), max_size=14).map(tuple),
    st.none() | st.floats(0, 1),
    st.none() | st.sampled_from("xy"),
)


def test_a_change_is_known_since_it_came_first_until_it_is_answered() -> None:
    """A finger that moves on changes nothing of that; of those that have lifted the first is."""
    tracker, key = ContactTracker(PLATE), ContactKey("a", 1)
    tracker.update(frame(1.0, (1, 0.5, 0.5)))
    tracker.update(frame(1.1, (1, 0.6, 0.5)))
    assert tracker.changed == {key: 1.0}
    tracker.take_changes()
    tracker.update(frame(1.2, (1, 0.6, 0.5)))
    assert tracker.changed == {}
    tracker.update(frame(1.3, (1, 0.7, 0.5), (2, 0.1, 0.1)))
    tracker.update(frame(1.4, (2, 0.1, 0.1)))
    assert tracker.changed == {ContactKey("a", 2): 1.3, None: 1.3}
    tracker.expire(1.6)
    assert tracker.changed == {None: 1.3}


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


FRAME = 0.010  # s


def moved(places: np.ndarray) -> Contact:
    """A finger reported every 10 ms at these places (n, 2) [m]; the last at time 0."""
    track: Track = ()
    count = len(places)
    for number, (x, y) in enumerate(places.tolist(), start=1):
        track = track_with(track, (number - count) * FRAME, x, y)
    return Contact(ContactKey("a", 1), x, y, since=0.0, track=track)


def test_velocity_is_that_of_a_steady_way() -> None:
    """0.2 m/s to the right and 0.1 down, exactly, whatever its course before the last 60 ms.

    A source that reports changes alone says nothing of one that stops: 60 ms later it rests.
    """
    times = np.arange(12) * FRAME
    places = np.column_stack([0.05 + 0.2 * times, 0.1 - 0.1 * times])
    places[:4] = 0.3
    for time in (0.0, 0.02):
        assert moved(places).velocity(time) == pytest.approx((0.2, -0.1))
    assert moved(places).velocity(OVER) == (0.0, 0.0)


def test_jitter_of_a_resting_finger_is_no_motion() -> None:
    """Errors of 0.3 mm rms in 200 courses, and a single place: zero, not nearly."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        assert moved(0.1 + rng.normal(0, 0.3e-3, (10, 2))).velocity(0.0) == (0.0, 0.0)
    assert moved(np.array([[0.1, 0.1]])).velocity(0.0) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("size", "degrees", "load"),
    [
        ((0.04, 0.03), 0, (12 / 9.4) ** 2),  # 12 mm by 6 mm
        ((0.01, 0.01), 0, 0.4),
        pytest.param((0.084, 0.01), 0, HAND_LOAD, id="25.2 mm by 2 mm"),
        pytest.param((0.25, 0.2), 0, HAND_LOAD * 1.5**2, id="75 mm by 40 mm"),
        ((0.9, 0.9), 0, 40.0),
        ((0.01, 0.124), 0, 2.5),  # 24.8 mm
        ((0.01, 0.126), 0, HAND_LOAD),
        ((0.1, 0.01), 90, 2.5),  # along the plate's 200 mm
        ((0.1, 0.01), 0, HAND_LOAD),
        ((math.nan, 0.05), 0, 1.0),
        ((0.0, 0.0), 0, 1.0),
    ],
)
def test_a_size_tells_a_hand_from_a_finger(
    size: tuple[float, float], degrees: int, load: float
) -> None:
    """By its longer axis on a plate of 300 mm by 200 mm, as the sensor is mounted: above 25 mm."""
    tracker, touch = ContactTracker(PLATE), Touch(1, 0.5, 0.5, size=size)
    for time in (0.0, 0.1):
        tracker.update(TouchFrame("a", time, (turned(degrees).apply(touch),)))
    assert tracker.contacts[0].load == pytest.approx(load)


def test_a_hand_is_one_until_it_is_lifted() -> None:
    """A finger that becomes one has its load at once, and more as it grows by half.

    What is left of it as it lifts is no finger. It never moves by itself: its place counts as it is
    reported.
    """
    tracker, seen = ContactTracker(PLATE), []
    for time, load in (
        (0.0, None),
        (0.01, 12.0),
        (0.2, 17.0),
        (0.3, 0.5),
        (0.4, 19.0),
        (0.5, None),
    ):
        tracker.update(TouchFrame("a", time, (Touch(1, 0.5 + time / 10, 0.5, load),)))
        (contact,) = tracker.contacts
        seen.append((contact.is_hand, contact.load, contact.is_under_way))
    assert seen == [(load > 1, load, False) for load in (1.0, *[12.0] * 3, *[19.0] * 2)]


def test_reject_counter_logs_once_per_interval(caplog: pytest.LogCaptureFixture) -> None:
    """A thousand bad datagrams within a second are all counted and make one line, as do later.

    The first of another reason makes one at once.
    """
    now = 0.0
    rejects = RejectCounter(logging.getLogger("bad input"), clock=lambda: now)
    for _ in range(1000):
        rejects.count("malformed", "ends too early")
    assert rejects.counts == {"malformed": 1000}
    assert len(caplog.records) == 1
    rejects.count("late", "frame\x1b[2J 3")
    assert len(caplog.records) == 2
    assert "new=1000" in caplog.records[1].getMessage()
    assert "late 1, malformed 1000" in caplog.records[1].getMessage()
    assert "\x1b" not in rejects.examples["late"]
    now = 1.0
    rejects.count("late", "frame 4")
    assert len(caplog.records) == 3
