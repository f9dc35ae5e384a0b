"""Contacts that are tracked from touch frames, and the speed of a finger on a panel with errors.

What a source rejects is counted.
"""

import math
from collections import Counter
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.contact_tracker import ContactTracker
from controller.sources.touch import (
    CONTACT_TIMEOUT,
    OVER,
    Change,
    Contact,
    ContactKey,
    Touch,
    TouchFrame,
    Track,
    track_with,
)
from controller.sources.touch_calibration import turned
from model.structure.material import Material
from model.structure.plate import Plate
from registry.limits import HAND_LOAD, MAX_CONTACTS, MAX_HAND_LOAD

PLATE = Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))
FINGER = Touch(1, 0.5, 0.5)
KEY = ("a", 1)
"""The contact of this finger of source a."""

Key = tuple[str, int]


class TouchedTracker(ContactTracker):
    """A tracker on a plate of 300 mm by 200 mm, and frames of touches."""

    def __init__(self) -> None:
        super().__init__(PLATE)

    def touch(
        self,
        time: float,
        *touches: Touch,
        source: str = "a",
        timeout: float | None = None,
        origin: str | None = None,
        keeps_taps: bool = False,
    ) -> Change:
        """Deliver a frame of a source."""
        frame = TouchFrame(source, time, touches, timeout, origin)
        return self.update(frame, keeps_taps=keeps_taps)


def fingers(count: int, *, first: int = 0) -> list[Touch]:
    """So many touches in the middle of the sensor."""
    return [Touch(id, 0.5, 0.5) for id in range(first, first + count)]


def keys(contacts: Iterable[Contact]) -> list[Key]:
    """The source and id of each contact."""
    return [contact.key for contact in contacts]


def surplus(tracker: ContactTracker) -> list[int]:
    """The ids of contacts beyond ten fingers."""
    return [contact.key.id for contact in tracker.contacts if contact.is_surplus]


def shares(tracker: ContactTracker) -> dict[str, int]:
    """The number of contacts of each source."""
    return dict(Counter(contact.key.source for contact in tracker.contacts))


@pytest.fixture
def tracker() -> TouchedTracker:
    """A tracker without contacts."""
    return TouchedTracker()


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
def test_turned_sensor_maps_its_upper_corners(
    degrees: int, mirror: str | None, top_left: tuple[int, int], top_right: tuple[int, int]
) -> None:
    """They lie on the plate where those of a turned sheet of paper lie."""
    calibration = turned(degrees, mirror=mirror)
    left = calibration.apply(Touch(1, 0, 0))
    right = calibration.apply(Touch(1, 1, 0))
    assert (left.x, left.y) == pytest.approx(top_left)
    assert (right.x, right.y) == pytest.approx(top_right)


def test_contact_is_reported_once_down_once_moved_and_once_up(tracker: TouchedTracker) -> None:
    """It keeps the time of its first frame."""
    landed = tracker.touch(1.0, FINGER)
    assert keys(landed.down) == [KEY]
    resting = tracker.touch(1.01, FINGER)
    assert resting == Change()
    moved = tracker.touch(1.02, Touch(1, 0.6, 0.5))
    (contact,) = moved.moved
    assert (contact.x, contact.since) == (pytest.approx(0.18), 1.0)
    lifted = tracker.touch(1.03)
    assert keys(lifted.up) == [KEY]
    assert tracker.contacts == ()


@pytest.mark.parametrize(
    ("x", "y", "reason"),
    [
        (math.nan, 0.5, "not_finite"),
        (0.5, math.inf, "not_finite"),
        (-0.025, 0.5, "off_plate"),
        (0.5, 1.033, "off_plate"),
        (1.02, -0.025, "off_plate"),
    ],
)
def test_invalid_position_lifts_its_contact_and_is_reported(
    tracker: TouchedTracker, x: float, y: float, reason: str
) -> None:
    """It makes no contact; other fingers of the frame stay."""
    tracker.touch(0.0, *fingers(2, first=1))
    change = tracker.touch(0.01, Touch(1, x, y), Touch(2, 0.5, 0.5), Touch(3, x, y))
    assert keys(tracker.contacts) == [("a", 2)]
    assert keys(change.up) == [KEY]
    assert change.rejected == (reason, reason)


def test_finger_along_the_rim_is_at_the_edge_of_the_plate(tracker: TouchedTracker) -> None:
    """On a plate of 300 mm by 200 mm: 6.3 mm beyond an edge is at it, 6.6 mm is off."""
    landed = tracker.touch(0.0, Touch(1, 1.021, 0.5))
    assert (keys(landed.down), landed.rejected) == ([KEY], ())
    (contact,) = tracker.touch(0.1, Touch(1, -0.021, -0.001)).moved
    assert (contact.x, contact.y) == pytest.approx((0.0, 0.2))
    off = tracker.touch(0.2, Touch(1, 1.022, 0.5))
    assert (keys(off.up), off.rejected) == ([KEY], ("off_plate",))


def test_contact_beyond_twenty_waits_for_a_lift(tracker: TouchedTracker) -> None:
    """The twenty that came first stay, whatever their order in frames."""
    change = tracker.touch(0.0, *fingers(21))
    assert change.rejected == ("too_many",)
    tracker.touch(0.01, *reversed(fingers(21)))
    assert keys(tracker.contacts) == [("a", id) for id in range(20)]
    tracker.touch(0.02, *fingers(20, first=1))
    assert keys(tracker.contacts) == [("a", id) for id in range(1, 21)]


def test_origin_that_has_all_contacts_gives_way_to_another(tracker: TouchedTracker) -> None:
    """Its newest contacts are lifted, one for each of the other's, until both have ten.

    No frame of either takes any back; the other can have the places of lifted fingers.
    """

    def touch_greedily() -> None:
        tracker.touch(0.0, *fingers(22), source="tuio:a", origin="x")

    touch_greedily()
    change = tracker.touch(0.0, *fingers(1), source="tuio:b")
    assert keys(change.up) == [("tuio:a", 19)]
    for _ in range(3):
        tracker.touch(0.0, *fingers(19), source="tuio:b")
        touch_greedily()
        assert shares(tracker) == {"tuio:a": 10, "tuio:b": 10}
    tracker.touch(0.0, *fingers(2), source="tuio:b")
    touch_greedily()
    assert shares(tracker) == {"tuio:a": 18, "tuio:b": 2}


@pytest.mark.parametrize(("origin", "share"), [("one", 5), (None, 0)])
def test_many_names_do_not_keep_a_panel_out(
    tracker: TouchedTracker, origin: str | None, share: int
) -> None:
    """Twenty sources of one origin share with another; twenty origins have a contact each."""
    for number in range(20):
        tracker.touch(0.0, *fingers(1), source=f"tuio:{number}", origin=origin)
    tracker.touch(0.0, *fingers(10), source="panel")
    tracker.touch(0.0, *fingers(19), source="tuio:other")
    assert shares(tracker)["panel"] == 10
    assert shares(tracker).get("tuio:other", 0) == share


@pytest.mark.parametrize(
    ("stated", "timeout"),
    [(None, 0.15), (3.0, 3.0), (math.nan, 0.15), (math.inf, 0.15), (-1.0, 0.15), (61.0, 0.15)],
)
def test_stated_timeout_counts_up_to_a_minute(
    tracker: TouchedTracker, stated: float | None, timeout: float
) -> None:
    """The next frame of the source can state another."""
    tracker.touch(10.0, FINGER, timeout=stated)
    assert tracker.next_expiry == pytest.approx(10.0 + timeout)
    tracker.touch(10.1, FINGER, timeout=1.0)
    assert tracker.next_expiry == pytest.approx(11.1)


@pytest.mark.parametrize("time", [math.nan, math.inf])
def test_touch_that_could_not_time_out_makes_no_contact(
    tracker: TouchedTracker, time: float
) -> None:
    """Its source's lift is dated by the newest frame, so the latency of the lift is a number."""
    tracker.touch(1.0, FINGER)
    tracker.touch(1.02, FINGER, source="b")
    tracker.take_changes()
    change = tracker.touch(time, FINGER)
    assert change.rejected == ("no_time",)
    assert keys(tracker.contacts) == [("b", 1)]
    assert tracker.changed == {None: 1.02}


def test_frame_from_the_future_counts_from_when_it_is_processed(tracker: TouchedTracker) -> None:
    """Otherwise its contact would stay for days."""
    tracker.touch(1e6, FINGER)
    tracker.expire(10.0)
    assert keys(tracker.contacts) == [KEY]
    tracker.expire(10.0 + CONTACT_TIMEOUT)
    assert tracker.contacts == ()


def test_tap_whose_frames_come_together_lasts_60_ms(tracker: TouchedTracker) -> None:
    """It counts from its down, once, and only if taps are kept."""
    tracker.touch(1.0, FINGER)
    assert keys(tracker.touch(1.001).up) == [KEY]

    tracker.touch(1.0, FINGER)
    assert tracker.touch(1.001, keeps_taps=True).up == ()
    assert tracker.next_expiry == pytest.approx(1.060)
    assert not tracker.touch(1.030, keeps_taps=True)
    assert tracker.expire(1.059).up == ()
    assert keys(tracker.expire(1.0601).up) == [KEY]


def test_finger_after_a_tap_is_a_new_contact(tracker: TouchedTracker) -> None:
    """It comes elsewhere during the 60 ms, and lifts 10 ms later, which is no tap."""
    tracker.touch(2.0, FINGER)
    tracker.touch(2.0, keeps_taps=True)
    change = tracker.touch(2.01, Touch(1, 0.1, 0.5), keeps_taps=True)
    assert (keys(change.down), keys(change.up)) == ([KEY], [KEY])
    tracker.touch(2.02, keeps_taps=True)
    assert tracker.contacts == ()


@pytest.mark.parametrize(
    ("time", "reported", "load"),
    [
        (10.05, 2.0, 1.0),  # within the first 100 ms
        (10.11, 1.45, 1.0),
        (10.11, 1.55, 1.55),
        (10.11, 0.1, 0.4),
        (10.11, 9.0, 2.5),
        (10.11, None, 1.0),
        (10.11, math.nan, 1.0),
        (10.11, -1.0, 1.0),
        (10.11, 0.0, 1.0),
    ],
)
def test_tracker_follows_a_load_that_changes_by_half_once_a_finger_has_landed(
    tracker: TouchedTracker, time: float, reported: float | None, load: float
) -> None:
    """The load is between 0.4 and 2.5; a change is one of pressure only."""
    tracker.touch(10.0, FINGER)
    change = tracker.touch(time, Touch(1, 0.5, 0.5, load=reported))
    (contact,) = tracker.contacts
    assert contact.load == load
    expected = Change(pressed=(contact,)) if load != 1.0 else Change()
    assert change == expected


def test_change_is_dated_by_its_first_frame_until_it_is_answered(tracker: TouchedTracker) -> None:
    """A finger that moves on does not change the date; of lifted fingers the first counts."""
    key = ContactKey("a", 1)
    tracker.touch(1.0, FINGER)
    tracker.touch(1.1, Touch(1, 0.6, 0.5))
    assert tracker.changed == {key: 1.0}
    tracker.take_changes()
    tracker.touch(1.2, Touch(1, 0.6, 0.5))
    assert tracker.changed == {}
    tracker.touch(1.3, Touch(1, 0.7, 0.5), Touch(2, 0.1, 0.1))
    tracker.touch(1.4, Touch(2, 0.1, 0.1))
    assert tracker.changed == {ContactKey("a", 2): 1.3, None: 1.3}
    tracker.expire(1.6)
    assert tracker.changed == {None: 1.3}


NUMBERS = st.floats(allow_nan=True, allow_infinity=True) | st.floats(0, 1)
TOUCHES = st.builds(Touch, st.integers(0, 14), NUMBERS, NUMBERS)
FRAMES = st.builds(
    TouchFrame,
    st.sampled_from("ab"),
    NUMBERS,
    st.lists(TOUCHES, max_size=14).map(tuple),
    st.none() | st.floats(0, 1),
    st.none() | st.sampled_from("xy"),
)


@given(st.lists(FRAMES | st.floats(0, 2)))
def test_tracker_invariants_for_any_sequence(events: list[TouchFrame | float]) -> None:
    """Contacts are on the plate, bounded and unique; changes add up to them."""
    tracker = ContactTracker(PLATE)
    reported: dict[ContactKey, tuple[float, float]] = {}
    for event in events:
        is_frame = isinstance(event, TouchFrame)
        change = tracker.update(event) if is_frame else tracker.expire(event)
        for contact in change.up:
            del reported[contact.key]
        for contact in change.down:
            assert contact.key not in reported
            reported[contact.key] = (contact.x, contact.y)
        for contact in change.moved:
            assert reported[contact.key] != (contact.x, contact.y)
            reported[contact.key] = (contact.x, contact.y)

        contacts = tracker.contacts
        assert reported == {contact.key: (contact.x, contact.y) for contact in contacts}
        assert len(reported) == len(contacts) <= MAX_CONTACTS
        for contact in contacts:
            assert PLATE.contains(contact.x, contact.y), contact
            assert math.isfinite(contact.since), contact
        assert (tracker.next_expiry == math.inf) == (not contacts)
    tracker.expire(2.0)
    tracker.expire(3.0)
    assert tracker.contacts == ()


FRAME_INTERVAL = 0.010  # s


def moving_contact(positions: np.ndarray) -> Contact:
    """A finger reported every 10 ms at these positions (n, 2) [m]; the last at time 0."""
    track: Track = ()
    for number, (x, y) in enumerate(positions.tolist(), start=1):
        time = (number - len(positions)) * FRAME_INTERVAL
        track = track_with(track, time, x, y)
    return Contact(ContactKey("a", 1), x, y, since=0.0, track=track)


def test_touch_of_any_finite_size_is_tracked(tracker: TouchedTracker) -> None:
    """A touch 1e300 times as wide as the plate is a hand, and its frame lifts the other contact."""
    tracker.touch(0.0, FINGER)
    change = tracker.touch(0.01, Touch(2, 0.2, 0.2, size=(1e300, 0.1)))
    assert keys(change.up) == [KEY]
    assert [contact.load for contact in change.down] == [MAX_HAND_LOAD]


def test_frame_that_cannot_be_tracked_changes_nothing(
    tracker: TouchedTracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After an exception, the contact of the previous frame is lifted at that frame's timeout."""
    tracker.touch(0.0, FINGER)
    with monkeypatch.context() as patch:
        patch.setattr("controller.sources.contact_tracker.track_with", None)
        with pytest.raises(TypeError):
            tracker.touch(0.01, Touch(2, 0.2, 0.2), keeps_taps=True)
    assert keys(tracker.contacts) == [KEY]
    assert keys(tracker.expire(CONTACT_TIMEOUT).up) == [KEY]


def test_velocity_of_a_steady_way_is_exact() -> None:
    """0.2 m/s to the right and 0.1 down, whatever its course before the last 60 ms.

    A source that reports only changes does not report a stop: 60 ms later the finger rests.
    """
    times = np.arange(12) * FRAME_INTERVAL
    positions = np.column_stack([0.05 + 0.2 * times, 0.1 - 0.1 * times])
    positions[:4] = 0.3
    contact = moving_contact(positions)
    assert contact.velocity(0.0) == pytest.approx((0.2, -0.1))
    assert contact.velocity(0.02) == pytest.approx((0.2, -0.1))
    assert contact.velocity(OVER) == (0.0, 0.0)


def test_jitter_of_a_resting_finger_is_no_motion() -> None:
    """Errors of 0.3 mm rms in 200 courses, and a single position: exactly zero."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        resting = moving_contact(0.1 + rng.normal(0, 0.3e-3, (10, 2)))
        assert resting.velocity(0.0) == (0.0, 0.0)
    assert moving_contact(np.array([[0.1, 0.1]])).velocity(0.0) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("size", "degrees", "load"),
    [
        ((0.04, 0.03), 0, (12 / 9.4) ** 2),  # 12 mm by 6 mm
        ((0.01, 0.01), 0, 0.4),
        pytest.param((0.084, 0.01), 0, HAND_LOAD, id="25.2 mm by 2 mm"),
        pytest.param((0.25, 0.2), 0, HAND_LOAD * 1.5**2, id="75 mm by 40 mm"),
        ((0.9, 0.9), 0, 40.0),
        ((0.01, 0.124), 0, 2.5),  # 24.8 mm
        ((0.1, 0.01), 90, 2.5),  # along the plate's 200 mm
        ((math.nan, 0.05), 0, 1.0),
        ((0.0, 0.0), 0, 1.0),
    ],
)
def test_size_above_25_mm_is_a_hand(
    tracker: TouchedTracker, size: tuple[float, float], degrees: int, load: float
) -> None:
    """By the longer axis on a plate of 300 mm by 200 mm, as the sensor is mounted."""
    touch = turned(degrees).apply(Touch(1, 0.5, 0.5, size=size))
    tracker.touch(0.0, touch)
    tracker.touch(0.1, touch)
    assert tracker.contacts[0].load == pytest.approx(load)


@pytest.mark.parametrize(
    ("loads", "load"),
    [
        ([None, 12.0], 12.0),
        ([None, 12.0, 17.0], 12.0),  # less than half more
        ([None, 12.0, 19.0], 19.0),
        ([None, 12.0, 0.5], 12.0),  # as it lifts
        ([None, 12.0, None], 12.0),
    ],
)
def test_hand_stays_a_hand_until_it_is_lifted(
    tracker: TouchedTracker, loads: list[float | None], load: float
) -> None:
    """A finger that becomes one has its load immediately; its reported motion is ignored."""
    for number, reported in enumerate(loads):
        tracker.touch(0.1 * number, Touch(1, 0.5 + 0.01 * number, 0.5, reported))
    (contact,) = tracker.contacts
    assert contact.is_hand
    assert contact.load == load
    assert not contact.is_under_way
