"""Messages of protocol 4 in CAN frames: bytes worked out by hand from the decision, and losses."""

import pytest

from drivers.errors import WireCounters
from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers
from drivers.wires.can_frames import (
    Assembler,
    Message,
    frames_of,
    segments,
)

SET = ("1300050a34120700", "1301020081000100", "130200002000d007", "13038813d8dc0000")
"""Session 1234, token 7, part 0 of 1; layer 1 along 1 ms: channel 2, 100 Hz, 0.5, -90 degrees."""
REQUESTS: dict[str, tuple[int, Values, tuple[str, ...]]] = {
    "GetStatus": (0x11, {}, ("1100090000000000",)),
    "Arm": (
        0x12,
        {"session": 0x1234, "watchdog": 250, "shift": 0},
        ("120003033412fa00", "1201000000000000"),
    ),
    "Set": (
        0x13,
        {
            **{"session": 0x1234, "token": 7, "index": 0, "parts": 1, "now": 0},
            "stream": pack_layers(
                [LayerSet(1, ramp=1, valid_for=0, commands=(Command(2, 2000, 5000, -9000),))]
            ),
        },
        SET,
    ),
    "Commit": (
        0,
        {"session": 0x1234, "token": 7, "at": 0x0102},
        ("0000060334120700", "0001020100000000"),
    ),  # a broadcast
}


@pytest.mark.parametrize("name", REQUESTS)
def test_requests_have_the_bytes_of_the_decision(name: str) -> None:
    """Number, index, type, count and two words, then three words each, low byte first."""
    number, values, expected = REQUESTS[name]
    message = MESSAGES[name]
    made = segments(number, message.number, message.request.pack(values))
    assert [data.hex() for data in made] == [*expected]


@pytest.mark.parametrize("words", [0, 1, 2, 3, 5, 6, 119, 120])
def test_frames_of_every_length_hold_all_words(words: int) -> None:
    """Two words in the first frame and three in each other; 120 words are 41 frames."""
    made = segments(9, 5, range(words))
    assert len(made) == frames_of(words) == 1 + max(0, -(-(words - 2) // 3))
    whole = Assembler(WireCounters())
    *_, last = (whole.add(data, 0.0) for data in reversed(made))
    assert last == Message(9, 5, tuple(range(words)))


@pytest.mark.parametrize(
    ("last", "number", "is_taken"),
    [(1, 2, True), (255, 1, True), (1, 128, True), (1, 129, False), (2, 1, False), (1, 255, False)],
)
def test_numbers_wrap_from_255_to_1(last: int, number: int, is_taken: bool) -> None:
    """Newer is one that follows by at most 127; after 0.1 s without a frame any is."""
    whole = Assembler(WireCounters())
    (before,), (data,) = segments(last, 9, []), segments(number, 9, [])
    assert whole.add(before, 0.0) is not None
    assert (whole.add(data, 0.05) is not None) is is_taken
    assert whole.add(data, 0.2) is not None


def test_incomplete_message_is_forgotten() -> None:
    """A frame 0.11 s later is no part of it, though its number is the same."""
    whole = Assembler(WireCounters())
    first, second = segments(5, 5, range(5))
    assert whole.add(first, 0.0) is None
    assert whole.add(second, 0.11) is None


def test_frames_of_two_senders_make_no_message() -> None:
    """Two that differ under one number and index are believed neither way."""
    counters = WireCounters()
    whole = Assembler(counters)
    mine, other = segments(5, 5, range(8)), segments(5, 5, range(1, 9))
    for data in (mine[0], other[0], *mine[1:], *other[1:]):
        assert whole.add(data, 0.0) is None
    assert counters.invalid_frames == 1


def test_frames_of_number_0_begin_anew_with_each_first() -> None:
    """An event that lost its end is followed by a whole one."""
    whole = Assembler(WireCounters(), is_numbered=False)
    first, second = segments(0, 30, [4, 0, 255, 1])
    lost, _ = segments(0, 30, [5, 0, 255, 1])
    assert [whole.add(data, 0.0) for data in (second, lost, first)] == [None] * 3
    assert whole.add(second, 0.0) == Message(0, 30, (4, 0, 255, 1))
