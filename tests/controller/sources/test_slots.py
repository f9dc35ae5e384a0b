"""Events of touch panels, worked out by hand from the kernel's multi-touch protocol, type B."""

from collections.abc import Iterable
from typing import TypeAlias

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.evdev import PanelReport, SlotReader
from model.errors import InputError

Shown: TypeAlias = list[tuple[float, dict[int, tuple[float, float]]]]

ABS, SYN = 3, 0
CODES = {
    "slot": (ABS, 0x2F),
    "id": (ABS, 0x39),
    "x": (ABS, 0x35),
    "y": (ABS, 0x36),
    "tool": (ABS, 0x37),
    "pressure": (ABS, 0x3A),
    "major": (ABS, 0x30),
    "distance": (ABS, 0x3B),
    "dropped": (SYN, 3),
}
RANGES = {0x35: (0, 1000), 0x36: (-100, 100), 0x3A: (0, 255), 0x30: (0, 255)}


def report(reader: SlotReader, words: str) -> PanelReport:
    """The report of events such as `slot 0 id 7 x 100 y 50`."""
    pairs = words.split()
    for code, value in zip(pairs[::2], pairs[1::2], strict=True):
        assert reader.feed(*CODES[code], int(value)) is None
    found = reader.feed(SYN, 0, 0)
    assert found is not None
    return found


def shown(reports: Iterable[tuple[float, str]]) -> Shown:
    """States of a panel with their times, touches by id."""
    reader = SlotReader(RANGES)
    return [
        (time, {touch.id: (touch.x, touch.y) for touch in touches})
        for time, words in reports
        for touches in report(reader, words).states
    ]


SEQUENCES: dict[str, tuple[list[tuple[float, str]], Shown]] = {
    "two fingers, unchanged values omitted": (
        [
            (0.0, "id 7 x 100 y 0"),
            (0.25, "slot 1 id 8 x 900 y 50"),
            (0.5, "x 800 slot 0 y -50"),
            (0.75, "id -1"),
            (1.0, "slot 1 id -1"),
        ],
        [
            (0.0, {7: (0.1, 0.5)}),
            (0.25, {7: (0.1, 0.5), 8: (0.9, 0.75)}),
            (0.5, {7: (0.1, 0.25), 8: (0.8, 0.75)}),
            (0.75, {8: (0.8, 0.75)}),
            (1.0, {}),
        ],
    ),
    "a new contact keeps the coordinates of its slot": (
        [(0, "id 1 x 100 y 0"), (1, "id -1"), (2, "id 2 y 50")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (2.0, {2: (0.1, 0.75)})],
    ),
    "a position after the lift": (
        [(0, "id 1 x 100 y 0"), (1, "id -1"), (2, "x 200")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (2.0, {})],
    ),
    "taps within one report": (
        [(0, "id 1 x 100 y 0 id -1"), (1, "id 2 x 300 y 0 id -1 id 3 x 400")],
        [
            (0.0, {1: (0.1, 0.5)}),
            (0.0, {}),
            (1.0, {2: (0.3, 0.5)}),
            (1.0, {}),
            (1.0, {3: (0.4, 0.5)}),
        ],
    ),
    "a lift within one report, the same id again": (
        [(0, "id 1 x 100 y 0"), (1, "id -1 id 1")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (1.0, {1: (0.1, 0.5)})],
    ),
    "a palm, a finger that becomes one, a hovering finger that lands": (
        [
            (0, "id 1 tool 2 x 100 y 0"),
            (1, "tool 0"),
            (2, "tool 2 slot 1 id 2 distance 5 x 200 y 0"),
            (3, "distance 0"),
        ],
        [(0.0, {}), (1.0, {1: (0.1, 0.5)}), (2.0, {}), (3.0, {2: (0.2, 0.5)})],
    ),
    "two slots with one tracking id, and a negative slot": (
        [
            (0, "id 1 x 100 y 0 slot 1 id 1 x 300 y 0"),
            (1, "slot -1 id 4 x 500 slot 0 x 200"),
            (2, "slot 0 id -1"),
        ],
        [
            (0.0, {1: (0.1, 0.5), -2: (0.3, 0.5)}),
            (1.0, {1: (0.2, 0.5), -2: (0.3, 0.5)}),
            (2.0, {1: (0.3, 0.5)}),
        ],
    ),
    "another id without -1 before it": (
        [(0, "id 1 x 100 y 0"), (1, "id 2 x 200")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {2: (0.2, 0.5)})],
    ),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_states_follow_slots(name: str) -> None:
    """States are those worked out by hand."""
    reports, expected = SEQUENCES[name]
    assert shown(reports) == expected


@given(
    st.lists(
        st.lists(
            st.one_of(
                st.tuples(st.just("slot"), st.integers(0, 2)),
                st.tuples(st.just("id"), st.integers(-1, 3)),
                st.tuples(st.sampled_from(["x", "y"]), st.integers(0, 100)),
                st.tuples(st.just("dropped"), st.just(0)),
            ),
            max_size=6,
        ),
        min_size=1,
        max_size=8,
    )
)
def test_at_most_as_many_touches_as_slots(reports: list[list[tuple[str, int]]]) -> None:
    """Whatever a panel sends."""
    words = [" ".join(f"{code} {value}" for code, value in each) for each in reports]
    slots = {value for each in reports for code, value in each if code == "slot"} | {0}
    assert all(len(touches) <= len(slots) for _, touches in shown(enumerate(words)))


def test_events_of_type_a_are_refused() -> None:
    """SYN_MT_REPORT, with a reason that names the type."""
    with pytest.raises(InputError, match="type A"):
        SlotReader(RANGES).feed(SYN, 2, 0)
