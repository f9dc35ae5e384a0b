"""Framing of wires by their specifications: serial lines, Modbus RTU and TCP, interfaces of CAN.

Readers find frames in any pieces and after any noise, in bounded memory; Modbus RTU is silent
before each frame; what a library must not do; a device that hangs delays nothing else.
"""

import asyncio
import itertools
import logging
import os
import random
import struct
import threading
import zlib
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import can
import pytest
from can.interfaces import BACKENDS
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.logging import Log

from cases import in_turn, shortly
from drivers import ports
from drivers.errors import CommandError, LinkError
from drivers.ports import Port
from drivers.urls import Endpoint
from drivers.wires import can_interfaces, modbus_frames
from drivers.wires.can_frames import SLCAN, SOCKETCAND, CanFrame, TextReader
from drivers.wires.can_interfaces import PythonCanAddress
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
from drivers.wires.serial_frames import PAYLOAD_MAX, Frame, FrameReader, encode_frame, frame_length
from drivers.wires.wire import address_of
from kit.courses import Taken, courses, follow
from registry import threads

BYTE = 11 / 19_200  # s
SILENCE = 3.5 * BYTE  # Modbus over serial line V1.02, 2.5.1.1


@dataclass(kw_only=True)
class OnALine(Taken):
    """A port that keeps silences; sent: what was written below it, with its times [s].

    heard: when bytes came last [s]; byte: the time of a character [s].
    """

    port: SilentPort
    sent: list[tuple[float, bytes]]
    heard: float = 0.0
    byte: float = BYTE

    @property
    def gaps(self) -> list[float]:
        """Between the frames, from start to start, in characters."""
        return [(after - before) / BYTE for (before, _), (after, _) in pairwise(self.sent)]

    def writes(self, *texts: str) -> None:
        """Write frames at once."""
        for each in texts:
            self.port.write(each.encode())

    def hears(self, text: str) -> None:
        """Let bytes come."""
        self.heard = threads.now()
        self.port.received(text.encode())


@asynccontextmanager
async def on_a_line() -> AsyncIterator[OnALine]:
    """A line at 19 200 baud that has been silent for a second."""
    assert ModbusWire(19_200, is_rtu=True, number=0).silence == pytest.approx(SILENCE)
    sent: list[tuple[float, bytes]] = []
    port = SilentPort(SILENCE, BYTE, lambda data: None)
    port.below = Mock(is_blocked=False, write=lambda data: sent.append((threads.now(), data)))
    await asyncio.sleep(1.0)
    yield OnALine(port=port, sent=sent)


COURSES = courses(Path(__file__).with_name("silence.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_silent_port_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], on_a_line)


@dataclass(frozen=True)
class Stream:
    """A kind of stream.

    feed: makes a reader, its method; sent: a frame as the far end writes it; frame, frames: one
    frame, and any; end: ends what noise may have begun.
    """

    feed: Callable[[], Callable[[bytes], Iterable[object]]]
    sent: Callable[[Any], bytes]
    frame: object
    frames: st.SearchStrategy[Any]
    end: bytes


CAN_FRAMES = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8))
FRAMES = st.builds(
    Frame,
    kind=st.sampled_from([1, 7, 12, 31, 0x81, 0x9F]),
    address=st.integers(0, 255),
    sequence=st.integers(0, 65535),
    payload=st.binary(max_size=PAYLOAD_MAX),
    version=st.integers(0, 255),
)
CAN_FRAME = CanFrame(0x181, bytes(range(8)))
STREAMS = {
    "serial": Stream(
        *(lambda: FrameReader().feed, encode_frame, Frame(12, 1, 1, b"x", 3), FRAMES, b"\0")
    ),
    "slcan": Stream(
        lambda: TextReader(SLCAN).feed,
        lambda frame: f"t{frame.id:03X}{len(frame.data):X}{frame.data.hex()}\r".encode(),
        *(CAN_FRAME, CAN_FRAMES, b"\r"),
    ),
    "socketcand": Stream(
        lambda: TextReader(SOCKETCAND).feed,
        lambda frame: (
            f"< frame {frame.id:03X} 1700000000.123456 {frame.data.hex().upper()} >".encode()
        ),
        *(CAN_FRAME, CAN_FRAMES, b">"),
    ),
}
of_every_kind = pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS)


@of_every_kind
@given(data=st.data())
def test_any_split_of_the_stream_gives_the_same_frames(stream: Stream, data: st.DataObject) -> None:
    """However it is cut."""
    frames = data.draw(st.lists(stream.frames, max_size=5))
    text = b"".join(map(stream.sent, frames))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(text)), max_size=8)))
    pieces = itertools.starmap(slice, itertools.pairwise([0, *cuts, len(text)]))
    feed = stream.feed()
    assert [one for piece in pieces for one in feed(text[piece])] == frames


@of_every_kind
def test_stream_without_an_end_takes_no_memory(stream: Stream) -> None:
    """A megabyte is one frame that is damaged, or none."""
    feed = stream.feed()
    assert [one for _ in range(256) for one in feed(b"t1818" * 820)] == []
    reader = feed.__self__  # type: ignore[attr-defined]
    assert len(reader.rest) <= 512


def frame_by_hand(kind: int, version: int, address: int, sequence: int, payload: bytes) -> bytes:
    """A frame from the specification, without the code under test; COBS of short blocks."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    blocks = (body + struct.pack("<I", zlib.crc32(body))).split(b"\0")
    return b"\0" + b"".join(bytes([len(block) + 1]) + block for block in blocks) + b"\0"


@given(FRAMES)
def test_frame_equals_its_specification(frame: Frame) -> None:
    """Bytes and length; it is decoded again."""
    wire = encode_frame(frame)
    head = (frame.kind, frame.version, frame.address, frame.sequence)
    assert wire == frame_by_hand(*head, frame.payload)
    assert len(wire) == frame_length(len(frame.payload))
    assert FrameReader().feed(wire) == [frame]


def test_damaged_frames_are_counted() -> None:
    """By CRC, length and truncation; the next good frame is understood."""
    good = frame_by_hand(12, 2, 1, 7, b"")
    bad_crc = bytearray(frame_by_hand(12, 2, 1, 7, b"abc"))
    bad_crc[-2] ^= 0x40
    too_long, truncated = b"\0" + b"\x01" * 1000 + b"\0", good[:5] + b"\0"
    damaged = (bytes(bad_crc), too_long, truncated)
    invalid: list[bytes] = []
    reader = FrameReader(on_invalid=invalid.append)
    for count, data in enumerate(damaged, start=1):
        assert reader.feed(data) == []
        assert len(invalid) == count
    assert len(reader.feed(good)) == 1


# A write to unit 3; minimalmodbus makes its CRC DD 00, and 00 DD fits what is before them, too.
WHOLE = bytes.fromhex("0310050000070E1FEFA085D0790003000000140000DD00")


def test_frame_is_not_taken_before_it_is_whole() -> None:
    """The CRC of its first 22 bytes is valid; the length that is in it is 23."""
    reader = AduReader(is_rtu=True, of_requests=True, waits=True)
    assert reader.feed(WHOLE[:-1]) == []
    (adu,) = reader.feed(WHOLE[-1:])
    assert (adu.unit, adu.pdu, adu.raw, reader.rest) == (3, WHOLE[1:-2], WHOLE, b"")


@pytest.mark.parametrize("is_host", [True, False])
@pytest.mark.parametrize("unit", [1, 2])
def test_frame_behind_damaged_bytes_is_found(unit: int, is_host: bool) -> None:
    """That of docs/reference/modbus.md; a host takes none there that is not its response."""
    noise, response = b"\x01\x03", bytes.fromhex("01 10 06 00 00 03 80 80")
    reader = AduReader(is_rtu=True, of_requests=False, is_host=is_host)
    request = Write(dev_id=unit, address=0x600, registers=[3, 9, 7])
    found = reader.feed(noise + response, request) + reader.end()
    is_taken = unit == 1 or not is_host
    assert [each.raw for each in found if each.pdu] == [response] * is_taken
    assert b"".join(each.raw for each in found) == noise + response


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
def test_requests_are_those_of_the_standard(
    pdu: str, expected: tuple[int, int, list[int]] | None
) -> None:
    """Read 1 to 125 registers or write 1 to 123, the bytes as many as are counted."""
    request = parse_request(Adu(1, bytes.fromhex(pdu)))
    if expected is None or request is None:
        assert expected is request
        return
    assert (request.address, request.count) == expected[:2]
    if expected[2]:
        assert [*request.registers] == expected[2]


READING, WRITING = Read(dev_id=1, address=9, count=2), Write(dev_id=1, address=9, registers=[5, 6])


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
def test_response_is_that_of_its_request(
    request_sent: Read | Write | None, pdu: str, expected: Response | None
) -> None:
    """By unit, transaction, function, and registers or their address and count."""
    found = response_to(request_sent, Adu(1, bytes.fromhex(pdu)))
    assert (found and ([*found.registers], found.exception)) == (
        expected and ([*expected.registers], expected.exception)
    )
    assert response_to(request_sent, Adu(2, bytes.fromhex(pdu))) is None
    assert response_to(request_sent, Adu(1, bytes.fromhex(pdu), transaction=1)) is None


def test_damaged_bytes_raise_and_log_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """Bytes of every function, as requests, responses and frames; exceptions are no errors."""
    caplog.set_level(logging.DEBUG)
    chance = random.Random(5)
    readers = [
        AduReader(is_rtu=True, of_requests=of_requests, waits=waits)
        for of_requests in (True, False)
        for waits in (True, False)
    ]
    for number in range(256 * 40):
        data = bytes([1, number % 256]) + chance.randbytes(chance.randrange(12))
        parse_request(Adu(1, data[1:]))
        for request in (READING, WRITING):
            response_to(request, Adu(1, data[1:]))
        for reader in readers:
            reader.feed(data)
            reader.end()
    assert exception_to(16, 3) == b"\x90\x03"
    Log.error("of a library")
    assert caplog.records == []


@pytest.mark.parametrize("waits", shortly([True, False], [True]))
@pytest.mark.parametrize(
    ("noise", "part"), in_turn([b"\x03\xfa", b"\x01\x63", b"\x17", b"\x18\x00\xf0"], [250, 1 << 16])
)
def test_noise_without_end_is_neither_kept_nor_searched_without_bound(
    noise: bytes, waits: bool, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of its bytes is there once, and the frame behind it is found."""
    tried = 0

    def counted(frame: bytes) -> Adu | None:
        nonlocal tried
        tried += 1
        return checked(frame)

    checked = modbus_frames.checked_adu
    monkeypatch.setattr(modbus_frames, "checked_adu", counted)
    reader = AduReader(is_rtu=True, of_requests=waits, waits=waits)
    data = (noise * (1 << 16))[: 1 << 16]
    found: list[Adu] = []
    for at in range(0, len(data), part):
        tried = 0
        found += reader.feed(data[at : at + part])
        assert len(reader.rest) <= 256
        assert tried <= 1024
    response = bytes.fromhex("01 10 06 00 00 03 80 80")
    found += reader.end() + reader.feed(WHOLE if waits else response)
    assert b"".join(each.raw for each in found) == data + found[-1].raw
    assert [each.raw for each in found if each.pdu] == [WHOLE if waits else response]


CHANNELS = {
    "etas": "ETAS://ETH/ES910:abcd/CAN:1",
    "nixnet": "CAN1",
    "pcan": "PCAN_USBBUS1",
    **dict.fromkeys(("robotell", "seeedstudio", "serial"), "/dev/no-such-port"),
    "udp_multicast": "239.74.163.2",
    "usb2can": "ED000200",
}
OPTIONS = {
    "canalystii": {"device": 1},
    "ixxat": {"unique_hardware_id": "HW107711"},
    "neousys": {"device": 1},
    "neovi": {"serial": 4711},
    "pcan": {"device_id": 5},
    "systec": {"device_number": 2},
    "udp_multicast": {"port": 43114},
    "vector": {"app_name": "plate", "serial": 4711},
}
INTERFACES = sorted(set(BACKENDS) - {"slcan", "socketcan", "socketcand"})


def address(interface: str, query: str = "") -> PythonCanAddress:
    """Node 3 on a channel as the interface names it."""
    found = address_of(f"can+python-can://{interface}/{CHANNELS.get(interface, '0')}{query}#3")
    assert isinstance(found, PythonCanAddress)
    return found


@pytest.mark.parametrize("interface", INTERFACES)
async def test_interface_is_opened_by_its_name(
    interface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its channel, a number as one, the bit rate and the options that tell adapters apart."""
    opened: dict[str, Any] = {}

    def open_bus(**how: object) -> None:
        opened.update(how)
        raise OSError("no adapter")

    monkeypatch.setattr(can, "Bus", open_bus)
    options = OPTIONS.get(interface, {})
    more = "".join(f"&{name}={value}" for name, value in options.items())
    found = address(interface, f"?bitrate=250000{more}")
    with pytest.raises(LinkError, match="no adapter"):
        await found.open_port(lambda data: None, lambda cause: None)
    assert found.number == 3
    assert (opened["interface"], opened["channel"]) == (interface, CHANNELS.get(interface, 0))
    assert (opened["bitrate"], opened["receive_own_messages"]) == (250_000, False)
    assert options.items() <= opened.items()


@pytest.mark.parametrize("interface", sorted(set(INTERFACES) - {"virtual", "udp_multicast"}))
async def test_missing_adapter_is_a_link_error(interface: str) -> None:
    """Whatever the driver of a vendor raises where it is missing."""
    with pytest.raises(LinkError, match="cannot be opened"):
        await address(interface).open_port(lambda data: None, lambda cause: None)


def test_frames_are_those_of_classic_can() -> None:
    """Version 3 has no CAN FD, and a node from 1 to 127."""
    for query in ("?fd=2000000#1", "#128", "?bitrate=3#1"):
        with pytest.raises(CommandError):
            address_of(f"can+socketcan://can0{query}")


@pytest.mark.parametrize("timeout", [None, 20.0], ids=["as it is given", "20 s"])
@pytest.mark.parametrize("kind", ["port", "adapter"])
async def test_close_does_not_wait_for_a_device_that_hangs(
    kind: str,
    timeout: float | None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It continues in its thread, with a log line; frames read then are discarded.

    timeout [s]: of reading a device, which blocks as closing does until it is allowed.
    """
    heard, ends = list[bytes](), os.pipe()
    may_read, may_close, is_closed = (threading.Event() for _ in range(3))

    def recv(given: float) -> can.Message | None:
        if not may_read.wait(timeout or given):
            return None
        return can.Message(arbitration_id=0x701, is_extended_id=False, data=[5])

    def close() -> None:
        may_close.wait(60)
        for each in ends:
            os.close(each)
        is_closed.set()

    device = Mock(port="/dev/ttyUSB9", recv=recv, close=close, shutdown=close)
    device.fileno.return_value = ends[0]
    monkeypatch.setattr(ports, "open_device", lambda *_: device)
    monkeypatch.setattr(can, "Bus", lambda **how: device)
    monkeypatch.setattr(threads, "CLOSE_TIMEOUT", 0.05)
    if kind == "port":
        place = Endpoint("/dev/ttyUSB9", baud=9600)
        opened: Port = await ports.open_port(place, heard.append, lambda what: None)
    else:
        how = {"interface": "pcan"}
        opened = await can_interfaces.open_bus(
            "can+python-can://pcan/usb", how, heard.append, print
        )
    opened.close()
    with caplog.at_level(logging.WARNING, "drivers"):
        await asyncio.wait_for(opened.wait_closed(), 30)
    assert not is_closed.is_set()
    assert "era-close" in caplog.text
    may_read.set()
    may_close.set()
    assert await asyncio.to_thread(is_closed.wait, 60)
    assert heard == []
