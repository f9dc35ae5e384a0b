"""Requests and replies on each wire, as bytes worked out by hand from docs/reference.

Checksums are by other programs: zlib and `cobs`, and the loop over bits of Modbus. Both ends with
damaged bytes in between; the host's side of a CAN bus with other hosts; and how much the host reads
of Modbus, with responses that belong to no request.
"""

import os
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import Mock

import pytest
from scipy.stats import poisson

from drivers.protocol.definition import IDENTITY, MESSAGES, STATUS
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.modbus_frames import HEAD
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import (
    Arrival,
    BrokenReply,
    Continuation,
    Nak,
    Reply,
    Wire,
)
from kit.clock import KINDS, MemoryLine, in_virtual_time, unaltered
from kit.courses import Taken, courses, follow
from kit.wires import damage
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers

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
    ("GetAchieved", {"layer": 0}),
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


@dataclass(kw_only=True)
class OnAWire(Taken):
    """A wire of the host; sent: its last request, arrived: what came of the last bytes."""

    kind: str
    wire: Wire
    sent: bytes = b""
    arrived: list[Arrival] = field(default_factory=list)

    @property
    def frames(self) -> list[str]:
        """The frames of the last request on CAN, by identifier and data."""
        return [f"{each.id:03x} {each.data.hex()}" for each in unpack_frames(self.sent)]

    @property
    def came(self) -> list[str]:
        """What came of the last bytes, as text."""
        return [*map(str, self.arrived)]

    def requests(self, unit: int, name: str, **values: int) -> None:
        """Make a request."""
        self.sent = self.wire.request(unit, name, values)

    def receives(self, text: str) -> None:
        """Take bytes in hexadecimal digits, on CAN with identifiers."""
        self.arrived = self.wire.received(as_bytes(self.kind, text))


@asynccontextmanager
async def on_a_wire(*, kind: str, rate: int = 500_000, number: int = 0) -> AsyncIterator[OnAWire]:
    """A wire of a kind and a rate [bit/s], whose last request had a number."""
    if kind == "can":
        yield OnAWire(kind=kind, wire=CanWire(rate, sequence=number))
    else:
        yield OnAWire(kind=kind, wire=ModbusWire(rate, is_rtu=kind == "rtu", number=number))


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_wire_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], on_a_wire)


def test_random_frames_raise_nothing_and_are_no_reply() -> None:
    """20 000 of any length; the reply that comes after them is understood."""
    wire, draw = CanWire(500_000, sequence=254), random.Random(5)
    wire.request(5, "GetFaults", {})
    for _ in range(20_000):
        can_id = draw.choice((0x185, 0x205, draw.randrange(0x800)))
        data = draw.randbytes(draw.choice((8, 8, 8, draw.randrange(9))))
        if data[:1] != b"\xff" or can_id != 0x185:
            assert wire.received(pack_frames([CanFrame(can_id, data)])) == []
    assert wire.counters.unexpected_frames > 0
    reply = as_bytes("can", "185 FF00 0A01 0000 0000")
    assert wire.received(reply) == [Reply({"count": 0, "faults": []})]


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


def test_echo_without_a_response_is_named() -> None:
    """Of the write and of the read that follows it; an adapter of RS-485 may hear itself."""
    wire, peer = ModbusWire(115_200, is_rtu=True, number=0), Peer(is_rtu=True)
    frame = wire.request(1, "GetStatus", {})
    (more,) = wire.received(frame + peer.reply(frame))
    assert isinstance(more, Continuation)
    assert wire.received(more.data) == []
    wire.withdraw()
    assert "request itself came back" in wire.counters.remark


def test_number_of_an_unanswered_broadcast_can_be_used_again() -> None:
    """Transactions come again after 65 535: then one is a healthy unit's."""
    wire, peer = ModbusWire(0, is_rtu=False, number=0), Peer(is_rtu=False)
    wire.request(1, "GetStatus", {})
    wire.request(
        0, "Commit", {"session": 9, "token": 7, "at": 0}
    )  # transaction 2, without a response
    wire.number = 1
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
