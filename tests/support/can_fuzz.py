"""Both ends of CAN for damaged frames and text; see `mutation`.

A telegram is the frames of a request: identifier (bit 15: CAN FD), length, data, any of which may
be damaged. The far end and the host's readers take the frames, and both kinds of adapters the text.
"""

import struct
from collections.abc import Sequence

from can_session import INCOMPLETE_LIFE, Timers
from drivers.codec.can_bus.adapter_text import (
    SlcanReader,
    SocketcandReader,
    slcan_line,
    socketcand_element,
)
from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.objects import pack_envelope, unpack_achieved, unpack_faults
from drivers.codec.can_bus.replies import CanReplyReader, decode_emergency
from drivers.codec.can_bus.requests import encode_request
from drivers.errors import DriverError
from drivers.protocol.messages import (
    AmplifierEvent,
    Arm,
    Clear,
    GetCaps,
    GetFaults,
    Hello,
    LoadEnvelope,
    Request,
)
from fake_device import FakeDevice
from sim.far_ends.can_bus.bus import CanBus
from sim.far_ends.can_bus.node import CanNode
from sim.far_ends.can_bus.slcan_adapter import SlcanAdapter
from sim.far_ends.can_bus.socketcand_server import SocketcandEnd, _Client

_FD = 0x8000
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)
_REVIVAL = 10  # telegrams until it is operational and armed again
_ENVELOPE_SLOT = 5


class CanEnds:
    """A node and the host's readers; telegrams: frames of good requests and answers."""

    def __init__(self, requests: Sequence[Request]) -> None:
        self._device = FakeDevice()
        self._said: list[CanFrame] = []
        self._node = CanNode(self._device, 1, send=self._said.append)  # type: ignore[arg-type]
        self._timers = Timers()
        self._node.start(self._timers.call_later)
        self._revive()
        self._answers = CanReplyReader(1)
        self._taken = 0
        self.events: list[AmplifierEvent] = []
        self.telegrams = [self._telegram(request) for request in requests]
        self.telegrams += [_pack(self._answer_to(telegram)) for telegram in self.telegrams]

    def take(self, data: bytes) -> list[object]:
        """Feed the frames of a telegram to both ends; the far end's requests."""
        self._taken += 1
        if self._taken % _REVIVAL == 0:
            self._revive()
        self._device.asked.clear()
        self._said.clear()
        for frame in _unpack(data):
            self._node.receive(frame)
            self._hear(frame)
        for frame in self._said:
            self._hear(frame)
        self._device.pass_time(0.01)
        self._timers.ring(INCOMPLETE_LIFE)
        return list(self._device.asked)

    def mend(self, data: bytes) -> bytes:
        """Leave it as it is: the last frame of a set makes it take effect."""
        return data

    def _hear(self, frame: CanFrame) -> None:
        """Feed the frame to every reader of the host."""
        try:
            if frame.id in self._answers.ids:
                self._answers.feed(frame)
            self.events.append(decode_emergency(frame.data))
        except DriverError:
            pass
        self.events.clear()
        for read in (unpack_faults, unpack_achieved):
            try:
                read(frame.data)
            except DriverError:
                continue

    def _revive(self) -> None:
        self._node.receive(CanFrame(0x000, b"\x01\x01"))
        for order in (Clear(self._device.amplifier.latch), Arm(2.0)):
            for frame in encode_request(order, node=1, sequence=9):
                self._node.receive(frame)

    def _telegram(self, request: Request) -> bytes:
        match request:
            case Hello():
                return _pack([_read_object(0x2000, 1), _segment(0x60), _segment(0x70)])
            case GetCaps() | GetFaults():
                return _pack([_read_object(0x2008, 0), _segment(0x60)])
            case LoadEnvelope() as load:
                return _pack(_write_object(0x2100, _ENVELOPE_SLOT, pack_envelope(load)))
            case _:
                return _pack(list(encode_request(request, node=1, sequence=7)))

    def _answer_to(self, telegram: bytes) -> list[CanFrame]:
        self._said.clear()
        for frame in _unpack(telegram):
            self._node.receive(frame)
        return self._said or [CanFrame(0x701, b"\x05")]


class CanTexts:
    """Readers of adapters' text in both directions; telegrams: good text."""

    def __init__(self) -> None:
        self._bus = CanBus()
        self.asked: list[object] = []
        self._slcan = SlcanAdapter(self._bus, lambda text: None)
        self._slcan.receive(b"O\r")
        self._client = _Client(self._bus, SocketcandEnd(self._bus), is_open=True, is_raw=True)
        self._client.transport = _Deaf()  # type: ignore[assignment]
        self._readers = (SlcanReader(), SocketcandReader())
        self._bus.join(self.asked.append)
        frames = [CanFrame(0x481, bytes(range(8))), CanFrame(0x77F, b"\x05")]
        fd = CanFrame(0x481, bytes(48), fd=True)
        self.telegrams = [
            *(write(one) for one in (*frames, fd) for write in (slcan_line, socketcand_element)),
            b"< frame 181 1700000000.123456 0102030405060708 >",
            b"< fdframe 181 00 1.5 0102030405060708 >",
            b"C\rS6\rO\rV\rN\rF\rZ0\r",
            b"< open can0 >< rawmode >< echo >",
        ]

    def take(self, data: bytes) -> list[object]:
        """Feed text to every reader; the frames that were understood."""
        self.asked.clear()
        self._slcan.receive(data)
        self._slcan.receive(b"\rO\r")
        self._client.is_open = self._client.is_raw = True
        self._client.data_received(data)
        for reader in self._readers:
            self.asked.extend(reader.feed(data))
        for frame in self.asked:
            assert isinstance(frame, CanFrame)
            assert 0 <= frame.id <= 0x7FF
            assert len(frame.data) <= (64 if frame.fd else 8)
        return list(self.asked)

    def mend(self, data: bytes) -> bytes:
        """Precede it with both kinds of terminators."""
        return b"\r>" + data


class _Deaf:
    """A connection that discards everything."""

    def write(self, data: bytes) -> None: ...

    def get_write_buffer_size(self) -> int:
        return 0

    def close(self) -> None: ...

    def abort(self) -> None: ...


def _pack(frames: Sequence[CanFrame]) -> bytes:
    return b"".join(
        struct.pack("<HB", frame.id | (_FD if frame.fd else 0), len(frame.data)) + frame.data
        for frame in frames
    )


def _unpack(data: bytes) -> list[CanFrame]:
    frames, at = [], 0
    while at + 3 <= len(data):
        head, length = struct.unpack_from("<HB", data, at)
        is_fd = bool(head & _FD)
        length = _FD_LENGTHS[length % 8] if is_fd else length % 9
        frames.append(CanFrame(head & 0x7FF, data[at + 3 : at + 3 + length], fd=is_fd))
        at += 3 + length
    return frames


def _read_object(index: int, subindex: int) -> CanFrame:
    return CanFrame(0x601, struct.pack("<BHB4x", 0x40, index, subindex))


def _segment(command: int) -> CanFrame:
    return CanFrame(0x601, bytes([command]) + bytes(7))


def _write_object(index: int, subindex: int, data: bytes) -> list[CanFrame]:
    frames = [CanFrame(0x601, struct.pack("<BHBL", 0x21, index, subindex, len(data)))]
    for number, begin in enumerate(range(0, len(data), 7)):
        piece = data[begin : begin + 7]
        is_last = begin + 7 >= len(data)
        command = (number & 1) << 4 | (7 - len(piece)) << 1 | is_last
        frames.append(CanFrame(0x601, bytes([command]) + piece.ljust(7, b"\0")))
    return frames
