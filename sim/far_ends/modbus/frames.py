"""Modbus frames at the amplifier's end: RTU with its CRC, TCP with its header. No I/O.

Written apart from the host's side. A reader takes any bytes, in any pieces, and a clock [s]; bytes
that pause inside a frame for longer than `PAUSE` are none of it any more.
"""

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass

# s; a host asks again after 50 ms at the earliest, so what was cut off before is gone by then, and
# no system keeps the pieces of a frame apart for as long.
PAUSE = 0.04

_MBAP = struct.Struct(">HHHB")  # transaction, protocol, length, unit
_LENGTH_MAX = 254
_SHORTEST = 4  # unit, function, CRC
_LONGEST = 256
_SIZES = {3: 8, 4: 8, 6: 8, 43: 7}  # of RTU requests, by function
_COUNTS = {16: 6, 23: 10}  # where the others say how many bytes of registers follow


@dataclass(frozen=True)
class Request:
    """A request PDU for a unit; transaction: of TCP, repeated in the answer."""

    unit: int
    pdu: bytes
    transaction: int = 0


@dataclass
class Counters:
    """Frames by their fate; bad: damaged, cut off or impossible."""

    good: int = 0
    bad: int = 0


def crc(data: bytes) -> int:
    """CRC-16 of Modbus: polynomial 8005 reflected, from FFFF; its low byte goes first."""
    remainder = 0xFFFF
    for byte in data:
        remainder = remainder >> 8 ^ _CRC_OF_BYTE[(remainder ^ byte) & 0xFF]
    return remainder


def _crc_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


_CRC_OF_BYTE = [_crc_of_byte(byte) for byte in range(256)]


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """An answer on a serial line."""
    body = bytes([unit]) + pdu
    return body + struct.pack("<H", crc(body))


def tcp_frame(request: Request, pdu: bytes) -> bytes:
    """An answer over TCP."""
    return _MBAP.pack(request.transaction, 0, len(pdu) + 1, request.unit) + pdu


class Reader(ABC):
    """Takes requests out of a stream of bytes."""

    def __init__(self) -> None:
        self.counters = Counters()
        self._buffer = bytearray()
        self._last = 0.0

    @property
    def is_amid(self) -> bool:
        """Whether part of a frame waits for the rest."""
        return bool(self._buffer)

    def feed(self, data: bytes, now: float) -> list[Request]:
        """The requests that these bytes complete, in order."""
        found = self.pause(now)
        self._last = now
        self._buffer += data
        return found + self._take()

    def pause(self, now: float) -> list[Request]:
        """Give up what pauses for too long; a frame may come to light behind it."""
        found: list[Request] = []
        if self._buffer and now - self._last > PAUSE:
            found = self._give_up()
        return found

    @abstractmethod
    def _take(self) -> list[Request]:
        """The requests that are whole by now, in order."""

    def _give_up(self) -> list[Request]:
        self.counters.bad += 1
        self._buffer.clear()
        return []


class TcpReader(Reader):
    """Requests over TCP: the header says how long they are."""

    def _take(self) -> list[Request]:
        found = []
        while len(self._buffer) >= _MBAP.size:
            transaction, protocol, length, unit = _MBAP.unpack_from(self._buffer)
            if protocol != 0 or not 2 <= length <= _LENGTH_MAX:
                self._give_up()  # nothing says where the next frame begins
                break
            end = _MBAP.size - 1 + length
            if len(self._buffer) < end:
                break
            found.append(Request(unit, bytes(self._buffer[_MBAP.size : end]), transaction))
            del self._buffer[:end]
            self.counters.good += 1
        return found


class RtuReader(Reader):
    """Requests on a serial line: the function says how long they are, and the CRC whether it is so.

    After a damaged frame the next good one is looked for at every byte. A function that is not
    known says nothing of the length: such a frame ends with the pause after it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_lost = False

    def _take(self) -> list[Request]:
        found = []
        while len(self._buffer) >= _SHORTEST:
            start = self._hunt() if self._is_lost else 0
            size = _rtu_size(self._buffer, start)
            if size is None or start + size > len(self._buffer):
                break
            request = _checked(bytes(self._buffer[start : start + size]))
            if request is None:
                self.counters.bad += 1
                self._is_lost = True
                continue
            self.counters.good += 1
            self._is_lost = False
            found.append(request)
            del self._buffer[: start + size]
        if len(self._buffer) > _LONGEST:
            self._is_lost = True
            del self._buffer[:-_LONGEST]
        return found

    def _hunt(self) -> int:
        """Where the next good frame begins, or the end."""
        for start in range(len(self._buffer) - _SHORTEST + 1):
            size = _rtu_size(self._buffer, start)
            if size and _checked(bytes(self._buffer[start : start + size])):
                return start
        return len(self._buffer)

    def _give_up(self) -> list[Request]:
        whole = None if self._is_lost else _checked(bytes(self._buffer))
        if whole is not None:
            self.counters.good += 1
            found = [whole]
        else:
            self.counters.bad += 1
            self._is_lost = True
            found = self._take()
        self._buffer.clear()
        self._is_lost = False
        return found


def _rtu_size(data: bytearray, start: int) -> int | None:
    """How long the request is that begins here; None where its bytes do not say it, or not yet."""
    if len(data) < start + _SHORTEST:
        return None
    function = data[start + 1]
    if function in _SIZES:
        return _SIZES[function]
    if function in _COUNTS and len(data) > start + _COUNTS[function]:
        return min(_COUNTS[function] + 3 + data[start + _COUNTS[function]], _LONGEST)
    return None


def _checked(frame: bytes) -> Request | None:
    """The request in a frame with a good CRC."""
    if len(frame) < _SHORTEST or crc(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
        return None
    return Request(frame[0], frame[1:-2])
