"""Requests and replies on each wire, as bytes worked out by hand from docs/reference.

Checksums are by other programs: zlib and `cobs`, and the loop over bits of Modbus. Both ends with
damaged bytes in between; the host's side of a CAN bus with other hosts; and how much the host reads
of Modbus, with responses that belong to no request.
"""

import os
import random
from unittest.mock import Mock

import pytest
from scipy.stats import poisson

from drivers.protocol.definition import IDENTITY, MESSAGES, STATUS
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames, segments, unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.modbus_frames import HEAD
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import (
    Arrival,
    BrokenReply,
    Continuation,
    DuplicateAddress,
    Event,
    Nak,
    OtherHost,
    Reply,
    Wire,
)
from real_wires import damage
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from virtual_lines import KINDS, MemoryLine, in_virtual_time, unaltered

PART: Values = {
    **{"session": 0x2A17, "token": 0x0102, "index": 0, "parts": 1, "now": 1},
    "stream": [0x01A0, 0, 800],
}
"""A Set that is played at once: layer 3 is renewed for 800 ms."""
TAKEN: Values = {"token": 0x0102, "exact": 1, "staged": 0, "played": 1, "missing": 0}
TALKS: dict[str, tuple[Wire, tuple[str, ...]]] = {
    "serial": (
        SerialWire(921_600, sequence=7),
        (
            "00 05 05 04 01 08 06 17 2A 02 01 03 03 A0 01 01 07 20 03 93 C9 91 CA 00",
            "00 05 85 04 01 08 04 02 01 05 01 01 05 34 FF 32 E7 00",
        ),
    ),
    "tcp": (
        ModbusWire(0, is_rtu=False, number=0),
        (
            "0001 0000 0015 01 10 0500 0007 0E 0001 2A17 0102 0003 01A0 0000 0320"
            "0002 0000 0006 01 04 0580 0005",
            "0001 0000 0006 01 10 0500 0007",
            "0002 0000 000D 01 04 0A 0001 0000 0102 0005 0000",
        ),
    ),
    "rtu": (
        ModbusWire(115_200, is_rtu=True, number=0),
        (
            "01 10 0500 0007 0E 0001 2A17 0102 0003 01A0 0000 0320 E774",
            "01 10 0500 0007 8107",
            "01 04 0580 0005 312D",
            "01 04 0A 0001 0000 0102 0005 0000 B4FD",
        ),
    ),
    "can": (
        CanWire(500_000, sequence=7),
        (
            "201 0800 0506 172A 0201 · 201 0801 0300 A001 0000 · 201 0802 2003 0000 0000",
            "181 0800 0503 0201 0500 · 181 0801 0000 0000 0000",
        ),
    ),
}


def as_bytes(kind: str, text: str) -> bytes:
    """Bytes in hexadecimal; of a frame on CAN its identifier comes first."""
    if kind != "can":
        return bytes.fromhex(text)
    return pack_frames(
        CanFrame(int(each[:3], 16), bytes.fromhex(each[4:])) for each in text.split(" · ")
    )


@pytest.mark.parametrize("kind", TALKS)
def test_part_of_a_set_and_its_reply_are_the_bytes_of_the_specification(kind: str) -> None:
    """The wire sends these bytes and reads that reply.

    On Modbus twice: over TCP together, on RTU once the first have their response.
    """
    wire, pieces = TALKS[kind]
    sent, *between, reply = [as_bytes(kind, each) for each in pieces]
    assert wire.request(1, "Set", PART) == sent
    if between:
        echo, *read = between
        assert wire.received(echo) == [*map(Continuation, read)]
    assert wire.received(reply) == [Reply(TAKEN)]


DEFAULT_COUNT = 4000
COUNT = int(os.environ.get("FRAMES", DEFAULT_COUNT))  # `make fuzz` has a million
_DAMAGED = 0.25  # of all frames
SHAPE = Envelope(50, tuple((100 * knot, 10 * knot) for knot in range(20)))
LAYERS = [
    LayerSet(0, 20, 500, (Command(0, 2200, 2000, 0), Command(1, 5010, 9000, -9000, onset=SHAPE))),
    LayerSet(3, 0, 800, renew=True),
]
CUT = list(parts(pack_layers(LAYERS) + [0x0100, 10, 0] * 30, session=9, token=8, now=False))
REQUESTS: list[tuple[str, Values]] = [
    *(("Hello", {}), ("GetCaps", {}), ("GetStatus", {}), ("GetFaults", {}), ("GetMeasured", {})),
    *(("Arm", {"session": 9, "watchdog": 2000, "shift": 0}), ("Ping", {"session": 9, "rate": 0})),
    *(("Stop", {"ramp": 5}), ("Clear", {"latch": 1}), ("Disarm", {"ramp": 5})),
    *(("Commit", {"session": 9, "token": 7, "at": 0}), ("Silence", {"session": 9, "ramp": 5})),
    *(("GetAchieved", {"layer": 0}), ("GetReading", {"first": 0})),
    ("Set", parts(pack_layers(LAYERS), session=9, token=7, now=True)[0]),
    *(("Set", part) for part in CUT),
]


@pytest.mark.parametrize("kind", ["serial", "rtu", "tcp"])
def test_damaged_frames_are_counted_and_change_nothing(kind: str) -> None:
    """Requests and replies damaged at random: no exception, and good ones are understood again.

    With a CRC of 16 bits nothing is carried out but what was sent, except by a chance of 1 in
    65 536, which the frames of the suite do not meet; over TCP nothing out of range.
    """
    chance = random.Random(7)
    wire, sent = KINDS[kind].wire(), list[bytes]()
    amplifier = SimulatedAmplifier("a", channels=2)
    amplifier.handle = handled = Mock(side_effect=amplifier.handle)  # type: ignore[method-assign]
    far_end = KINDS[kind].far_end({1: amplifier}, sent.append)
    now, replies, strange = 0.0, 0, 0

    def ask(name: str, values: Values, *, damaged: float) -> list[Arrival]:
        """What comes of a request whose frames are damaged with a probability."""
        data, arrivals = wire.request(1, name, values), list[Arrival]()
        while data:
            sent.clear()
            far_end.receive(damage(data, chance) if chance.random() < damaged else data, now)
            back = b"".join(sent)
            if back and chance.random() < damaged:
                back = damage(back, chance)
            came = wire.received(back)
            data = next((each.data for each in came if isinstance(each, Continuation)), b"")
            arrivals += came
        wire.withdraw()
        return arrivals

    for _ in range(COUNT):
        name, values = chance.choice(REQUESTS)
        handled.reset_mock()
        arrivals = ask(name, values, damaged=_DAMAGED)
        record = IDENTITY if name == "Hello" else MESSAGES[name].reply
        replied = [each for each in arrivals if isinstance(each, Reply)]
        assert all(record.pack(each.values) for each in replied)  # in range
        assert sum(isinstance(each, Reply | Nak | BrokenReply) for each in arrivals) <= 1
        replies += bool(replied)
        for (asked, numbers, *_), _ in handled.call_args_list:
            assert MESSAGES[asked].request.pack(numbers) is not None
            strange += (asked, numbers) not in REQUESTS
        now += chance.choice((0.0, 0.0, 0.001, 0.02, 2.0))
    if kind != "tcp":
        assert strange == 0 or COUNT > DEFAULT_COUNT
        assert strange <= poisson.ppf(1 - 1e-6, _DAMAGED * COUNT / 65_536)
    assert replies > COUNT // 20
    assert wire.counters.invalid_frames + wire.counters.unexpected_frames > COUNT // 20
    now += 2.0
    ask("GetStatus", {}, damaged=0.0)
    assert isinstance(ask("GetStatus", {}, damaged=0.0)[-1], Reply)


NODE = 5
PING, GET_STATUS, STOP = 12, 9, 8


def frames(can_id: int, number: int, kind: int, *words: int) -> bytes:
    """Packed frames of a message."""
    return pack_frames(CanFrame(can_id, data) for data in segments(number, kind, words))


@pytest.fixture
def wire() -> CanWire:
    """A bus at 500 kbit/s on which node 5 was asked for its faults under number 255."""
    wire = CanWire(500_000, sequence=254)
    wire.request(NODE, "GetFaults", {})
    return wire


def test_versions_of_another_protocol_end_hello() -> None:
    """Bit 3 for version 3: such an amplifier has the object, and does not reply to the message."""
    wire = CanWire(500_000, sequence=0)
    wire.request(NODE, "Hello", {})
    versions = [
        pack_frames([CanFrame(can_id, bytes.fromhex(data))])
        for can_id, data in (
            (0x585, "4B00200518000000"),  # 3 and 4
            (0x586, "4B00200508000000"),  # of another node
            (0x585, "8000200500000206"),  # no such object
            (0x585, "4B00200508000000"),
        )
    ]
    assert [wire.received(each) for each in versions] == [[], [], [], [Reply({"versions": 8})]]
    wire.request(NODE, "GetStatus", {})
    assert not wire.received(versions[-1])


def test_broadcast_has_number_0_and_no_reply(wire: CanWire) -> None:
    """On identifier 200; the next request to node 5 goes on from 255 with 1."""
    values = {"session": 0x1234, "token": 7, "at": 0x0102}
    sent, more = unpack_frames(wire.request(0, "Commit", values))
    assert (sent.id, sent.data.hex()) == (0x200, "0000060334120700")
    assert (more.id, more.data.hex()) == (0x200, "0001020100000000")
    (sent,) = unpack_frames(wire.request(NODE, "GetFaults", {}))
    assert sent.data.hex() == "01000a0000000000"


ANSWERS: dict[str, tuple[bytes, list[Arrival]]] = {
    "reply": (frames(0x185, 255, 10, 0), [Reply({"count": 0, "faults": []})]),
    "refusal": (frames(0x185, 255, 31, 10, 5, 255), [Nak("WRONG_STATE", None)]),
    "refusal of a channel": (frames(0x185, 255, 31, 10, 4, 3), [Nak("BAD_CHANNEL", 3)]),
    "older number": (frames(0x185, 254, 10, 0), []),
    "another node": (frames(0x186, 255, 10, 0), []),
    "event": (
        frames(0x185, 0, 30, 7, 1, 255, 3),
        [Event(NODE, {"state": 7, "fault": 1, "channel": 255, "latch": 3})],
    ),
}


@pytest.mark.parametrize("answer", ANSWERS)
def test_reply_has_number_and_node_of_its_request(wire: CanWire, answer: str) -> None:
    """What is neither that nor an event is unexpected, and leaves the request on the wire.

    After a reply another one that differs is of a second amplifier.
    """
    data, expected = ANSWERS[answer]
    assert wire.received(data) == expected
    assert wire.counters.unexpected_frames == (not expected)
    rest = wire.received(ANSWERS["reply"][0])
    if expected in ([], ANSWERS["event"][1]):
        assert len(rest) == 1
    else:
        assert rest == ([DuplicateAddress(NODE)] if isinstance(expected[0], Nak) else [])


def test_reply_of_another_type_is_broken(wire: CanWire) -> None:
    """As is one that is too short for its type."""
    (arrival,) = wire.received(frames(0x185, 255, GET_STATUS, 0))
    assert isinstance(arrival, BrokenReply)
    wire.request(NODE, "GetStatus", {})
    (arrival,) = wire.received(frames(0x185, 1, GET_STATUS, 0))
    assert isinstance(arrival, BrokenReply)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [(PING, [OtherHost(NODE)]), (3, [OtherHost(NODE)]), (GET_STATUS, []), (STOP, []), (99, [])],
)
def test_request_that_needs_a_session_is_another_hosts(
    wire: CanWire, kind: int, expected: list[Arrival]
) -> None:
    """Reading and stopping are anyone's; the next number follows the one that was heard."""
    assert wire.received(frames(0x205, 77, kind, 5, 250)) == expected
    assert unpack_frames(wire.request(NODE, "GetStatus", {}))[0].data[0] == 78


def test_echo_of_own_frames_is_none(wire: CanWire) -> None:
    """An adapter may hand over what it sent."""
    echo = wire.request(NODE, "Ping", {"session": 9, "rate": 0})
    assert wire.received(echo) == []
    assert wire.counters.unexpected_frames == 0


def test_exchange_time_counts_the_stuffed_bits() -> None:
    """A frame has 47 + 64 bits and at most 24 stuffed ones; one, and 41 of the longest reply."""
    wire = CanWire(125_000, sequence=0)
    assert wire.exchange_time(0, 120) == pytest.approx(42 * 135 / 125_000)


def test_random_frames_raise_nothing_and_are_no_reply(wire: CanWire) -> None:
    """20 000 of any length; the reply that comes after them is understood."""
    draw = random.Random(5)
    for _ in range(20_000):
        can_id = draw.choice((0x185, 0x205, draw.randrange(0x800)))
        data = draw.randbytes(draw.choice((8, 8, 8, draw.randrange(9))))
        if data[:1] != b"\xff" or can_id != 0x185:
            assert wire.received(pack_frames([CanFrame(can_id, data)])) == []
    assert wire.counters.unexpected_frames > 0
    assert wire.received(ANSWERS["reply"][0]) == ANSWERS["reply"][1]


class Peer:
    """An amplifier of four channels at unit 1, its bytes kept."""

    def __init__(self, *, is_rtu: bool) -> None:
        self.sent: list[bytes] = []
        self.amplifier = SimulatedAmplifier("a", channels=4)
        self.end = ModbusAmplifiers({1: self.amplifier}, self.sent.append, is_rtu=is_rtu)

    def reply(self, data: bytes, now: float = 0.0) -> bytes:
        """The bytes with which it responds."""
        self.sent.clear()
        self.end.receive(data, now)
        return b"".join(self.sent)


def reply_to(wire: ModbusWire, peer: Peer, name: str, values: Values) -> Reply | Nak | BrokenReply:
    """What becomes of a request to a peer, in its two transactions."""
    (more,) = wire.received(peer.reply(wire.request(1, name, values)))
    assert isinstance(more, Continuation)
    (arrival,) = wire.received(peer.reply(more.data))
    assert isinstance(arrival, Reply | Nak | BrokenReply)
    return arrival


def test_as_many_registers_are_read_as_the_reply_can_have() -> None:
    """Of 4 channels and 8 layers, at first of the most: levels, tokens, limits, tones of each."""
    wire, peer = ModbusWire(0, is_rtu=True, number=0), Peer(is_rtu=True)
    status = HEAD + STATUS.words + sum(each.words for each in STATUS.added)
    capabilities = HEAD + MESSAGES["GetCaps"].reply.words + 3 * 16
    achieved = HEAD + MESSAGES["GetAchieved"].reply.words
    both = {"GetCaps": capabilities, "GetFaults": 122}
    counts = {"GetStatus": status + 16 + 16, "GetAchieved": achieved + 4 * 16, **both}
    after = {"GetStatus": status + 4 + 8, "GetAchieved": achieved + 4 * 4, **both}
    for expected in (counts, after):
        for name, count in expected.items():
            values = {"layer": 0} if name == "GetAchieved" else {}
            (more,) = wire.received(peer.reply(wire.request(1, name, values)))
            assert isinstance(more, Continuation)
            assert more.data[4:6] == count.to_bytes(2)
        assert isinstance(reply_to(wire, peer, "GetCaps", {}), Reply)


@pytest.mark.parametrize("is_rtu", [True, False])
def test_late_responses_are_credited_to_nothing(is_rtu: bool) -> None:
    """Of an earlier read, of an earlier write, doubled, of another unit; the reply still counts."""
    wire, peer = ModbusWire(0, is_rtu=is_rtu, number=0), Peer(is_rtu=is_rtu)
    (more,) = wire.received(peer.reply(wire.request(1, "GetStatus", {})))
    assert isinstance(more, Continuation)
    late = peer.reply(more.data)
    wire.withdraw()
    echo = peer.reply(wire.request(1, "GetStatus", {}))
    assert wire.received(late) == []
    (more,) = wire.received(echo + echo)
    assert isinstance(more, Continuation)
    assert wire.received(late + echo) == []
    assert wire.counters.unexpected_frames == 4
    response = peer.reply(more.data)
    of_unit_2 = ModbusWire(0, is_rtu=is_rtu, number=2)
    assert of_unit_2.request(2, "GetStatus", {})
    assert of_unit_2.received(echo) == []
    assert [type(each) for each in wire.received(late + response + response)] == [Reply]
    assert wire.counters.unexpected_frames == 6


@pytest.mark.parametrize(
    ("exception", "expected"),
    [
        (0, []),
        (1, [Nak("UNKNOWN_TYPE", None)]),
        (2, [Nak("UNKNOWN_TYPE", None)]),
        (3, [Nak("BAD_LENGTH", None)]),
        (4, [BrokenReply("Modbus exception 4")]),
        (6, [Nak("BUSY", None)]),
        (10, []),
        (11, []),
    ],
)
def test_exceptions_are_refusals_or_no_response(exception: int, expected: list[object]) -> None:
    """Those of a gateway, and one without a code, are none: the request is repeated."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    wire.request(1, "GetStatus", {})
    assert wire.received(bytes([0, 1, 0, 0, 0, 3, 1, 0x90, exception])) == expected


@pytest.mark.parametrize("exception", [1, 2, 3, 4])
def test_device_without_an_identity_is_no_amplifier(exception: int) -> None:
    """As another Modbus device at this address, which has no such registers."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    wire.request(7, "Hello", {})
    (arrival,) = wire.received(bytes([0, 1, 0, 0, 0, 3, 7, 0x84, exception]))
    assert isinstance(arrival, BrokenReply)
    assert "unit 7 is no amplifier" in arrival.reason


@pytest.mark.parametrize("is_rtu", [True, False])
def test_reply_to_another_master_is_credited_to_nothing(is_rtu: bool) -> None:
    """It wrote the same message before the reply was read; the next attempt has it."""
    wire, peer = ModbusWire(0, is_rtu=is_rtu, number=0), Peer(is_rtu=is_rtu)
    other = ModbusWire(0, is_rtu=is_rtu, number=500)
    (more,) = wire.received(peer.reply(wire.request(1, "GetStatus", {})))
    assert isinstance(more, Continuation)
    peer.reply(other.request(1, "GetStatus", {}))
    assert wire.received(peer.reply(more.data)) == []
    assert wire.counters.unexpected_frames == 1
    assert isinstance(reply_to(wire, peer, "GetStatus", {}), Reply)


def test_request_of_all_units_has_no_reply() -> None:
    """Unit 0 on a line; over TCP a write to each unit that is known, whose responses pass."""
    commit = ("Commit", {"session": 9, "token": 7, "at": 0})
    wire = ModbusWire(0, is_rtu=True, number=0)
    frame = wire.request(0, *commit)
    assert frame[:-2] == bytes.fromhex("00 10 0600 0004 08 0001 0009 0007 0000")

    wire = ModbusWire(0, is_rtu=False, number=0)
    for unit in (1, 2):
        wire.request(unit, "GetStatus", {})
    frames = wire.request(0, *commit)
    assert [frames[6], frames[13:15], frames[27], len(frames)] == [1, b"\0\x03", 2, 42]
    for number in (3, 4):
        echo = bytes([0, number, 0, 0, 0, 6, number - 2, 16, 6, 0, 0, 3])
        assert wire.received(echo) == []
    assert wire.counters.unexpected_frames == 0


def test_echo_without_a_response_is_named() -> None:
    """Of the write and of the read that follows it; an adapter of RS-485 may hear itself."""
    wire, peer = ModbusWire(115_200, is_rtu=True, number=0), Peer(is_rtu=True)
    frame = wire.request(1, "GetStatus", {})
    (more,) = wire.received(frame + peer.reply(frame))
    assert isinstance(more, Continuation)
    assert wire.received(more.data) == []
    wire.withdraw()
    assert "request itself came back" in wire.counters.remark


@pytest.mark.parametrize("is_rtu", [True, False])
def test_noise_is_counted_and_not_kept(is_rtu: bool) -> None:
    """All of its bytes, over as many parts as it has."""
    wire = ModbusWire(115_200, is_rtu=is_rtu, number=0)
    wire.request(1, "GetStatus", {})
    for _ in range(100):
        assert wire.received(b"\xff" * 4096) == []
    assert wire.counters.invalid_frames == 1
    assert len(wire._damaged) < 512
    wire.withdraw()
    assert f"{100 * 4096} bytes that are no valid frame" in wire.counters.remark


def test_number_of_an_unanswered_broadcast_can_be_used_again() -> None:
    """Transactions come again after 65 535: then one is a healthy unit's."""
    wire, peer = ModbusWire(0, is_rtu=False, number=0), Peer(is_rtu=False)
    wire.request(1, "GetStatus", {})
    wire.request(
        0, "Commit", {"session": 9, "token": 7, "at": 0}
    )  # transaction 2, without a response
    wire._number = 1
    assert isinstance(reply_to(wire, peer, "GetStatus", {}), Reply)


@in_virtual_time
async def test_damaged_length_costs_one_attempt() -> None:
    """A write that seems to go on for 255 bytes ends with the pause before its repetition."""
    end = MemoryLine("rtu", "a")
    damaged = iter([True])

    def lengthened(name: str, data: bytes) -> list[tuple[float, bytes]]:
        if next(damaged, False):
            data = data[:6] + b"\xff" + data[7:]
        return unaltered(name, data)

    await end.hosts["a"].open()
    end.inward = lengthened
    await end.hosts["a"].read_status()
    assert end.retries == 1


def test_times_on_a_line_are_those_of_its_characters() -> None:
    """A set of 22 words: 55 + 8 + 8 + 5 + 2 · 5 characters of 11 bits, four silences."""
    wire = ModbusWire(115_200, is_rtu=True, number=0)
    assert wire.exchange_time(22, 3) == pytest.approx(86 * 11 / 115_200 + 4 * 0.00175)
    slow = ModbusWire(9600, is_rtu=True, number=0)
    assert slow.silence == pytest.approx(3.5 * 11 / 9600)
    assert ModbusWire(0, is_rtu=False, number=0).exchange_time(22, 3) == 0


def test_broadcast_over_a_gateway_arrives_after_the_writes_before() -> None:
    """By hand: to three units 3 · 17 characters at 9600 baud, two echoes of 8, five silences.

    Each echo may begin 10 ms late. A network has no time of its own.
    """
    commit = ("Commit", {"session": 9, "token": 7, "at": 0})
    wire = ModbusWire(9600, is_rtu=False, number=0)
    for unit in (1, 2, 3):
        wire.request(unit, "GetStatus", {})
    wire.request(0, *commit)
    characters = 3 * 17 + 2 * 8 + 5 * 3.5
    assert wire.takes == pytest.approx(characters * 11 / 9600 + 2 * 0.01)
    network = ModbusWire(0, is_rtu=False, number=0)
    network.request(1, "GetStatus", {})
    network.request(0, *commit)
    assert network.takes == 0
