"""Messages in CAN frames as a host sends and receives them, among other nodes and hosts.

All bytes were worked out by hand from the protocol page and the page of the CAN wire.
"""

import random

import pytest

from drivers.errors import WireCounters
from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import (
    Assembler,
    CanFrame,
    CanMessage,
    frames_of,
    pack_frames,
    segments,
    unpack_frames,
)
from drivers.wires.wire import (
    Arrival,
    BrokenReply,
    DuplicateAddress,
    Event,
    Nak,
    OtherHost,
    Reply,
)

NO_FAULTS = Reply({"count": 0, "faults": []})
REPLY_OF_NODE_5 = "185 FF00 0A01 0000 0000"
"""No faults, in reply to request 255 to node 5."""


def received(wire: CanWire, *frames: str) -> list[Arrival]:
    """Return what a host makes of frames, each an identifier and its data in hexadecimal."""
    can_frames = []
    for frame in frames:
        identifier, data = frame.split(maxsplit=1)
        can_frames.append(CanFrame(int(identifier, 16), bytes.fromhex(data)))
    return [*wire.received(pack_frames(can_frames))]


def sent_frames(request: bytes) -> list[str]:
    """Return the frames of a request as identifiers and data in hexadecimal."""
    return [f"{frame.id:03x} {frame.data.hex()}" for frame in unpack_frames(request)]


@pytest.fixture
def wire() -> CanWire:
    """A host's wire whose last request was number 254."""
    return CanWire(500_000, sequence=254)


# Requests

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
    "Commit": (  # a broadcast
        0,
        {"session": 0x1234, "token": 7, "at": 0x0102},
        ("0000060334120700", "0001020100000000"),
    ),
}
"""The number, the values and the frames of requests."""


@pytest.mark.parametrize("name", REQUESTS)
def test_request_has_the_bytes_of_the_protocol_page(name: str) -> None:
    """Number, index, type, count and two words, then three words each, low byte first."""
    number, values, expected = REQUESTS[name]
    message = MESSAGES[name]

    frames = segments(number, message.number, message.request.pack(values))

    assert [data.hex() for data in frames] == [*expected]


def test_broadcast_has_number_0_and_expects_no_reply(wire: CanWire) -> None:
    """The next request to a node continues the numbers, from 255 to 1."""
    wire.request(5, "GetFaults", {})

    broadcast = wire.request(0, "Commit", {"session": 0x1234, "token": 7, "at": 0x0102})
    next_request = wire.request(5, "GetFaults", {})

    assert sent_frames(broadcast) == ["200 0000060334120700", "200 0001020100000000"]
    assert sent_frames(next_request) == ["205 01000a0000000000"]


def test_exchange_time_counts_stuffed_bits() -> None:
    """A frame has 47 + 64 bits and at most 24 stuffed ones; the longest reply has 41 frames."""
    wire = CanWire(125_000, sequence=0)

    assert wire.exchange_time(0, 120) == pytest.approx((1 + 41) * 135 / 125_000)


# Replies


def test_reply_has_the_number_and_the_node_of_its_request(wire: CanWire) -> None:
    """The same frame once more is not a second reply."""
    wire.request(5, "GetFaults", {})

    assert received(wire, REPLY_OF_NODE_5) == [NO_FAULTS]
    assert wire.counters.unexpected_frames == 0
    assert received(wire, REPLY_OF_NODE_5) == []


@pytest.mark.parametrize(
    ("frames", "refusal"),
    [
        (("185 FF00 1F03 0A00 0500", "185 FF01 FF00 0000 0000"), Nak("WRONG_STATE", None)),
        (("185 FF00 1F03 0A00 0400", "185 FF01 0300 0000 0000"), Nak("BAD_CHANNEL", 3)),
    ],
    ids=["state", "channel"],
)
def test_reply_that_differs_from_the_first_one_reveals_a_second_amplifier(
    wire: CanWire, frames: tuple[str, str], refusal: Nak
) -> None:
    """Two amplifiers at one address: the first refuses, the second replies."""
    wire.request(5, "GetFaults", {})

    assert received(wire, *frames) == [refusal]
    assert wire.counters.unexpected_frames == 0
    assert received(wire, REPLY_OF_NODE_5) == [DuplicateAddress(5)]


@pytest.mark.parametrize(
    "frame",
    ["185 FE00 0A01 0000 0000", "186 FF00 0A01 0000 0000"],
    ids=["older number", "other node"],
)
def test_unexpected_frame_leaves_the_request_waiting(wire: CanWire, frame: str) -> None:
    """The frame is counted, and the reply still arrives."""
    wire.request(5, "GetFaults", {})

    assert received(wire, frame) == []
    assert wire.counters.unexpected_frames == 1
    assert received(wire, REPLY_OF_NODE_5) == [NO_FAULTS]


def test_event_leaves_the_request_waiting(wire: CanWire) -> None:
    """An event has number 0: state FAULT, fault 1, no channel, latch 3."""
    wire.request(5, "GetFaults", {})

    arrivals = received(wire, "185 0000 1E04 0700 0100", "185 0001 FF00 0300 0000")

    assert arrivals == [Event(5, {"state": 7, "fault": 1, "channel": 255, "latch": 3})]
    assert wire.counters.unexpected_frames == 0
    assert received(wire, REPLY_OF_NODE_5) == [NO_FAULTS]


@pytest.mark.parametrize(
    ("name", "frame"),
    [("GetFaults", "185 FF00 0901 0000 0000"), ("GetStatus", "185 FF00 0901 0000 0000")],
    ids=["other type", "too short"],
)
def test_reply_is_broken_if_it_does_not_fit_its_request(
    wire: CanWire, name: str, frame: str
) -> None:
    """A Status of one word is not a list of faults, and is too short for a Status."""
    wire.request(5, name, {})

    (arrival,) = received(wire, frame)

    assert isinstance(arrival, BrokenReply)


def test_hello_is_answered_by_an_object_with_the_versions() -> None:
    """An amplifier of protocol 3 has the object 2005 and sets bit 3; it ignores the message."""
    wire = CanWire(500_000, sequence=0)
    wire.request(5, "Hello", {})

    assert received(wire, "585 4B00200518000000") == []  # versions 3 and 4
    assert received(wire, "586 4B00200508000000") == []  # another node
    assert received(wire, "585 8000200500000206") == []  # no such object
    assert received(wire, "585 4B00200508000000") == [Reply({"versions": 8})]
    wire.request(5, "GetStatus", {})
    assert received(wire, "585 4B00200508000000") == []


def test_random_frames_are_no_reply_and_raise_nothing(wire: CanWire) -> None:
    """20 000 frames of any length; the reply that follows them is understood."""
    rng = random.Random(5)
    wire.request(5, "GetFaults", {})

    for _ in range(20_000):
        identifier = rng.choice((0x185, 0x205, rng.randrange(0x800)))
        data = rng.randbytes(rng.choice((8, 8, 8, rng.randrange(9))))
        if data[:1] != b"\xff" or identifier != 0x185:
            assert wire.received(pack_frames([CanFrame(identifier, data)])) == []

    assert wire.counters.unexpected_frames > 0
    assert received(wire, REPLY_OF_NODE_5) == [NO_FAULTS]


# Other hosts


@pytest.mark.parametrize(
    ("message", "arrivals"),
    [
        ("0C", [OtherHost(5)]),
        ("03", [OtherHost(5)]),
        ("09", []),
        ("08", []),
        ("63", []),
    ],
    ids=["Ping", "Arm", "GetStatus", "Stop", "unknown"],
)
def test_request_of_another_host_is_reported_if_it_needs_a_session(
    wire: CanWire, message: str, arrivals: list[Arrival]
) -> None:
    """Anyone may read and stop. The next number follows the other host's, 4D."""
    wire.request(5, "GetFaults", {})

    assert received(wire, f"205 4D00 {message}02 0500 FA00") == arrivals
    next_request = wire.request(5, "GetStatus", {})
    assert sent_frames(next_request) == ["205 4e00090000000000"]


# Messages of several frames


@pytest.mark.parametrize("words", [0, 1, 2, 3, 5, 6, 119, 120])
def test_message_of_any_length_is_assembled_from_its_frames_in_any_order(words: int) -> None:
    """Two words in the first frame and three in each other; 120 words are 41 frames."""
    frames = segments(9, 5, range(words))

    assembler = Assembler(WireCounters())
    *_, message = (assembler.add(data, 0.0) for data in reversed(frames))

    assert len(frames) == frames_of(words) == 1 + max(0, -(-(words - 2) // 3))
    assert message == CanMessage(9, 5, tuple(range(words)))


@pytest.mark.parametrize(
    ("last", "number", "is_newer"),
    [
        (1, 2, True),
        (255, 1, True),
        (1, 128, True),
        (1, 129, False),
        (2, 1, False),
        (1, 255, False),
    ],
)
def test_message_is_newer_if_its_number_follows_by_at_most_127(
    last: int, number: int, is_newer: bool
) -> None:
    """Numbers wrap from 255 to 1; after 0.1 s without a frame any number is newer."""
    assembler = Assembler(WireCounters())
    (last_frame,) = segments(last, 9, [])
    (frame,) = segments(number, 9, [])
    message = CanMessage(number, 9, ())

    assert assembler.add(last_frame, 0.0) == CanMessage(last, 9, ())
    assert assembler.add(frame, 0.05) == (message if is_newer else None)
    assert assembler.add(frame, 0.2) == message


def test_message_is_invalid_if_two_senders_differ() -> None:
    """Frames that differ under one number and index make neither message."""
    counters = WireCounters()
    assembler = Assembler(counters)
    first = segments(6, 5, range(8))
    second = segments(6, 5, range(1, 9))

    for data in (first[0], second[0], *first[1:], *second[1:]):
        assert assembler.add(data, 0.0) is None

    assert counters.invalid_frames == 1
