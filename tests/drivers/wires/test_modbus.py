"""Modbus RTU and TCP as a host speaks it: frames, registers, silences, several masters.

Bytes were worked out by hand from the standard and the page of the Modbus wire.
"""

import asyncio
import logging
import random
from itertools import pairwise
from unittest.mock import Mock

import pytest
from pymodbus.logging import Log

from cases import in_turn, shortly
from drivers.host.amplifier import Amplifier
from drivers.host.line import Line
from drivers.protocol.records import Values
from drivers.wires import modbus_frames
from drivers.wires.modbus import ModbusWire, SilentPort
from drivers.wires.modbus_frames import (
    Adu,
    AduReader,
    Read,
    Response,
    Write,
    exception_to,
    parse_request,
    response_to,
)
from drivers.wires.wire import BrokenReply, Continuation, Nak, Reply
from kit.clock import MemoryLine, in_virtual_time, unaltered
from registry import threads
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers

rtu_and_tcp = pytest.mark.parametrize("is_rtu", [True, False], ids=["rtu", "tcp"])
COMMIT: Values = {"session": 9, "token": 7, "at": 0}


# Frames

WHOLE = bytes.fromhex("0310050000070E1FEFA085D0790003000000140000DD00")
"""A write to unit 3. Its CRC DD 00 is minimalmodbus's; 00 DD fits the bytes before it, too."""
RESPONSE = bytes.fromhex("01 10 06 00 00 03 80 80")
"""The response to a write, from the page of the Modbus wire."""


def test_reader_takes_a_frame_only_when_it_is_complete() -> None:
    """The CRC of the first 22 bytes is valid, but the length in the frame is 23."""
    reader = AduReader(is_rtu=True, of_requests=True, waits=True)

    assert reader.feed(WHOLE[:-1]) == []
    (adu,) = reader.feed(WHOLE[-1:])

    assert adu.unit == 3
    assert adu.pdu == WHOLE[1:-2]
    assert adu.raw == WHOLE
    assert reader.rest == b""


@pytest.mark.parametrize("waits", shortly([True, False], [True]))
@pytest.mark.parametrize(
    ("noise", "part"), in_turn([b"\x03\xfa", b"\x01\x63", b"\x17", b"\x18\x00\xf0"], [250, 1 << 16])
)
def test_reader_searches_endless_noise_in_bounded_time_and_memory(
    noise: bytes, waits: bool, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every byte of it is reported once, and the frame that follows is found."""
    check = Mock(side_effect=modbus_frames.checked_adu)
    monkeypatch.setattr(modbus_frames, "checked_adu", check)
    reader = AduReader(is_rtu=True, of_requests=waits, waits=waits)
    data = (noise * (1 << 16))[: 1 << 16]
    frame = WHOLE if waits else RESPONSE

    frames: list[Adu] = []
    for start in range(0, len(data), part):
        check.reset_mock()
        frames += reader.feed(data[start : start + part])
        assert len(reader.rest) <= 256
        assert check.call_count <= 1024
    frames += reader.end() + reader.feed(frame)

    assert b"".join(adu.raw for adu in frames) == data + frame
    assert [adu.raw for adu in frames if adu.pdu] == [frame]


@pytest.mark.parametrize(
    ("pdu", "expected"),
    [
        ("04 0980 007D", (0x980, 125, [])),
        ("03 0980 0001", (0x980, 1, [])),
        ("04 0980 0000", None),
        ("04 0980 007E", None),
        ("04 0980 0001 00", None),
        ("04 0980 00", None),
        ("04", None),
        ("10 0300 0002 04 0007 FFFF", (0x300, 2, [7, 0xFFFF])),
        ("10 0300 0000 00", None),
        ("10 0300 007C F8" + "0000" * 124, None),
        ("10 0300 0002 06 0007 FFFF", None),
        ("10 0300 0002 05 0007 FFFF 00", None),
        ("10 0300 0002 04 0007 FF", None),
        ("10 0300 0002 04", None),
        ("10 0300 0002 04 0007 FFFF 00", None),
        ("10 0300 FFFF 04 0007 FFFF", None),
        ("06 0300 0002", None),
        ("17 0980 0001 0C00 0001 02 0001", None),
        ("84 01", None),
    ],
)
def test_parse_request_accepts_the_requests_of_the_standard(
    pdu: str, expected: tuple[int, int, list[int]] | None
) -> None:
    """Reading 1 to 125 or writing 1 to 123 registers, with as many bytes as are counted."""
    request = parse_request(Adu(1, bytes.fromhex(pdu)))

    if request is None:
        assert expected is None
        return
    assert expected is not None
    address, count, registers = expected
    assert request.address == address
    assert request.count == count
    if registers:
        assert [*request.registers] == registers


READING = Read(dev_id=1, address=9, count=2)
WRITING = Write(dev_id=1, address=9, registers=[5, 6])


@pytest.mark.parametrize(
    ("request_sent", "pdu", "expected"),
    [
        (READING, "04 04 0001 FFFF", Response([1, 0xFFFF])),
        (READING, "04 02 0001", None),
        (READING, "04 05 0001 FFFF", None),
        (READING, "04 03 0001 FFFF", None),
        (READING, "04 04 0001 FFFF 00", None),
        (READING, "03 04 0001 FFFF", None),
        (READING, "04", None),
        (READING, "84 02", Response(exception=2)),
        (READING, "84 00", None),
        (READING, "84 02 00", None),
        (READING, "84", None),
        (READING, "90 02", None),
        (WRITING, "10 0009 0002", Response()),
        (WRITING, "10 0008 0002", None),
        (WRITING, "10 0009 0003", None),
        (WRITING, "10 0009 0002 00", None),
        (WRITING, "10 0009", None),
        (None, "04 04 0001 FFFF", None),
    ],
)
def test_response_matches_its_request(
    request_sent: Read | Write | None, pdu: str, expected: Response | None
) -> None:
    """In unit, transaction and function, and in the registers or in their address and count."""
    data = bytes.fromhex(pdu)

    response = response_to(request_sent, Adu(1, data))

    if expected is None:
        assert response is None
    else:
        assert response is not None
        assert [*response.registers] == [*expected.registers]
        assert response.exception == expected.exception
    assert response_to(request_sent, Adu(2, data)) is None
    assert response_to(request_sent, Adu(1, data, transaction=1)) is None


def test_damaged_bytes_neither_raise_nor_log(caplog: pytest.LogCaptureFixture) -> None:
    """Bytes of every function, as requests, responses and frames."""
    caplog.set_level(logging.DEBUG)
    rng = random.Random(5)
    readers = [
        AduReader(is_rtu=True, of_requests=of_requests, waits=waits)
        for of_requests in (True, False)
        for waits in (True, False)
    ]

    for number in range(256 * 40):
        data = bytes([1, number % 256]) + rng.randbytes(rng.randrange(12))
        parse_request(Adu(1, data[1:]))
        response_to(READING, Adu(1, data[1:]))
        response_to(WRITING, Adu(1, data[1:]))
        for reader in readers:
            reader.feed(data)
            reader.end()

    assert exception_to(16, 3) == b"\x90\x03"
    Log.error("of a library")
    assert caplog.records == []


# Requests and replies


class FarEnd:
    """An amplifier of four channels at unit 1."""

    def __init__(self, *, is_rtu: bool) -> None:
        self.sent: list[bytes] = []
        amplifier = SimulatedAmplifier("a", channels=4)
        self.unit = ModbusAmplifiers({1: amplifier}, self.sent.append, is_rtu=is_rtu)

    def reply(self, request: bytes) -> bytes:
        """Return the bytes with which it responds."""
        self.sent.clear()
        self.unit.receive(request, 0.0)
        return b"".join(self.sent)


def write(wire: ModbusWire, far_end: FarEnd, name: str, values: Values) -> bytes:
    """Send the write of a request; return the read that follows it."""
    response = far_end.reply(wire.request(1, name, values))
    (continuation,) = wire.received(response)
    assert isinstance(continuation, Continuation)
    return continuation.data


def exchange(wire: ModbusWire, far_end: FarEnd, name: str, values: Values) -> object:
    """Send both transactions of a request; return what the host makes of the reply."""
    read = write(wire, far_end, name, values)
    (arrival,) = wire.received(far_end.reply(read))
    return arrival


@rtu_and_tcp
def test_late_response_belongs_to_no_request(is_rtu: bool) -> None:
    """Of an earlier read, of an earlier write, repeated, and of another unit."""
    wire = ModbusWire(0, is_rtu=is_rtu, number=0)
    far_end = FarEnd(is_rtu=is_rtu)
    late = far_end.reply(write(wire, far_end, "GetStatus", {}))
    wire.withdraw()

    echo = far_end.reply(wire.request(1, "GetStatus", {}))
    assert wire.received(late) == []
    (continuation,) = wire.received(echo + echo)
    assert isinstance(continuation, Continuation)
    assert wire.received(late + echo) == []
    assert wire.counters.unexpected_frames == 4

    other_wire = ModbusWire(0, is_rtu=is_rtu, number=2)
    other_wire.request(2, "GetStatus", {})
    assert other_wire.received(echo) == []

    response = far_end.reply(continuation.data)
    (reply,) = wire.received(late + response + response)
    assert isinstance(reply, Reply)
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
def test_exception_is_a_refusal_unless_it_is_of_a_gateway(
    exception: int, expected: list[object]
) -> None:
    """An exception of a gateway, or without a code, is no response: the request is repeated."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    wire.request(1, "GetStatus", {})

    assert wire.received(bytes([0, 1, 0, 0, 0, 3, 1, 0x90, exception])) == expected


@rtu_and_tcp
def test_reply_to_another_master_belongs_to_no_request(is_rtu: bool) -> None:
    """Another master wrote the same message before the reply was read."""
    wire = ModbusWire(0, is_rtu=is_rtu, number=0)
    other_master = ModbusWire(0, is_rtu=is_rtu, number=500)
    far_end = FarEnd(is_rtu=is_rtu)
    read = write(wire, far_end, "GetStatus", {})

    far_end.reply(other_master.request(1, "GetStatus", {}))

    assert wire.received(far_end.reply(read)) == []
    assert wire.counters.unexpected_frames == 1
    assert isinstance(exchange(wire, far_end, "GetStatus", {}), Reply)


def test_echo_without_a_response_is_reported() -> None:
    """An RS-485 adapter may hear itself, both the write and the read that follows it."""
    wire = ModbusWire(115_200, is_rtu=True, number=0)
    far_end = FarEnd(is_rtu=True)
    request = wire.request(1, "GetStatus", {})
    (continuation,) = wire.received(request + far_end.reply(request))
    assert isinstance(continuation, Continuation)

    assert wire.received(continuation.data) == []
    wire.withdraw()

    assert "request itself came back" in wire.counters.remark


@in_virtual_time
async def test_damaged_length_costs_one_attempt() -> None:
    """A write that seems to have 255 bytes ends in the pause before it is repeated."""
    line = MemoryLine("rtu", "a")
    is_first = True

    def lengthen(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal is_first
        if is_first:
            data = data[:6] + b"\xff" + data[7:]
        is_first = False
        return unaltered(name, data)

    await line.hosts["a"].open()
    line.inward = lengthen
    await line.hosts["a"].read_status()

    assert line.retries == 1


# Broadcasts


def test_broadcast_on_a_line_is_one_write_to_unit_0() -> None:
    """Four registers at 0600: tag 1, session, token and moment, and the CRC."""
    wire = ModbusWire(0, is_rtu=True, number=0)

    request = wire.request(0, "Commit", COMMIT)

    assert request[:-2].hex() == "001006000004080001000900070000"


def test_broadcast_over_tcp_is_a_write_to_each_known_unit() -> None:
    """The responses of the units are expected and are no reply."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    wire.request(1, "GetStatus", {})
    wire.request(2, "GetStatus", {})

    request = wire.request(0, "Commit", COMMIT)

    assert len(request) == 42
    assert request[6] == 1
    assert request[13:15].hex() == "0003"
    assert request[27] == 2
    assert wire.received(bytes.fromhex("0003 0000 0006 01 10 0600 0003")) == []
    assert wire.received(bytes.fromhex("0004 0000 0006 02 10 0600 0003")) == []
    assert wire.counters.unexpected_frames == 0


def test_broadcast_without_a_response_frees_its_transaction_number() -> None:
    """Numbers wrap after 65 535; then another unit's request has this one."""
    wire = ModbusWire(0, is_rtu=False, number=0)
    far_end = FarEnd(is_rtu=False)
    wire.request(1, "GetStatus", {})
    wire.request(0, "Commit", COMMIT)  # transaction 2, without a response

    wire.number = 1

    assert isinstance(exchange(wire, far_end, "GetStatus", {}), Reply)


# Times


def test_exchange_time_on_a_line_is_that_of_its_characters_and_silences() -> None:
    """A set of 22 words has 55 + 8 + 8 + 5 + 2 x 5 characters of 11 bits and four silences."""
    wire = ModbusWire(115_200, is_rtu=True, number=0)

    assert wire.exchange_time(22, 3) == pytest.approx(86 * 11 / 115_200 + 4 * 1.75e-3)


def test_broadcast_through_a_gateway_includes_the_time_of_every_write() -> None:
    """To three units at 9600 baud: 3 x 17 characters, two echoes of 8 characters, five silences.

    Each echo may begin 10 ms late.
    """
    wire = ModbusWire(9600, is_rtu=False, number=0)
    for unit in (1, 2, 3):
        wire.request(unit, "GetStatus", {})

    wire.request(0, "Commit", COMMIT)

    characters = 3 * 17 + 2 * 8 + 5 * 3.5
    assert wire.takes == pytest.approx(characters * 11 / 9600 + 2 * 0.01)


# Silences between frames

CHARACTER = 11 / 19_200
"""Duration of a character at 19 200 baud [s]."""


class QuietLine:
    """A port at 19 200 baud that keeps the silences, and the frames that it sends."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.times: list[float] = []
        self.port = SilentPort(3.5 * CHARACTER, CHARACTER, lambda data: None)
        self.port.below = Mock(is_blocked=False, write=self._note)

    def _note(self, data: bytes) -> None:
        self.sent.append(data.decode())
        self.times.append(threads.now())

    def write(self, *frames: str) -> None:
        """Write frames at once."""
        for frame in frames:
            self.port.write(frame.encode())

    @property
    def gaps(self) -> list[float]:
        """From the start of a frame to that of the next [characters]."""
        return [(end - start) / CHARACTER for start, end in pairwise(self.times)]


@in_virtual_time
async def test_silent_port_waits_until_the_line_is_silent() -> None:
    """Frames of 6 and 8 bytes take 9.5 and 11.5 characters; received bytes delay by 3.5."""
    line = QuietLine()
    await asyncio.sleep(1.0)

    line.write("\x01first", "\x00second ", "\x01third")
    await asyncio.sleep(0.1)

    assert line.sent == ["\x01first", "\x00second ", "\x01third"]
    assert line.gaps == pytest.approx([9.5, 11.5])
    heard = threads.now()
    line.port.received(b"reply")
    line.write("\x01fourth")
    await asyncio.sleep(0.1)
    assert line.times[-1] - heard == pytest.approx(3.5 * CHARACTER)


@in_virtual_time
async def test_silent_port_replaces_a_waiting_request_but_no_broadcast() -> None:
    """A stop does not wait behind the request that it preempts."""
    line = QuietLine()
    await asyncio.sleep(1.0)

    line.write("\x01first", "\x00commit", "\x01read", "\x01stop")
    await asyncio.sleep(0.1)

    assert line.sent == ["\x01first", "\x00commit", "\x01stop"]


@in_virtual_time
async def test_silent_port_sends_a_stop_despite_endless_noise() -> None:
    """After the longest frame, of 256 characters, and the silence that follows it."""
    line = QuietLine()
    await asyncio.sleep(1.0)

    began = threads.now()
    line.port.received(b"?")
    line.write("\x00stops", "\x01stop")
    for _ in range(300):
        await asyncio.sleep(CHARACTER)
        line.port.received(b"?")

    assert (line.times[0] - began) / CHARACTER == pytest.approx(259.5, abs=1)
    assert line.gaps == pytest.approx([9.5], abs=0.001)


@in_virtual_time
@pytest.mark.parametrize("baud", [19_200, 38_400, 57_600, 115_200])
async def test_stop_is_sent_despite_endless_noise_whenever_it_is_repeated(baud: int) -> None:
    """By hand: 256 characters of 11 bits and a silence after it is requested, at any baud rate.

    Its repetitions, every 30 to 60 ms without a reply, do not postpone it.
    """
    wire = ModbusWire(baud, is_rtu=True, number=7)
    line = Line(wire, "noisy line")
    port = SilentPort(wire.silence, 11 / baud, line.received)
    times: list[float] = []
    port.below = Mock(is_blocked=False, write=lambda data: times.append(threads.now()))
    line.open(port)
    amplifier = Amplifier(line, 1, GuardLimits(10, 500, 1.0), name="a")
    await asyncio.sleep(0.01)

    began = threads.now()
    stopping = asyncio.ensure_future(amplifier.stop())
    while not stopping.done():
        port.received(b"??")
        await asyncio.sleep(0.0008)

    assert times[0] - began <= 256 * 11 / baud + wire.silence + 0.001
