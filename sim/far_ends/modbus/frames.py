"""Modbus ADUs at the amplifier's end: RTU with CRC, TCP with MBAP header. No I/O.

Written without code of the host's side. A long pause ends a frame.
"""

import math
import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass

FRAME_TIMEOUT = 0.02
"""Longest pause [s] within an RTU frame: less than the 30 ms after which a host repeats it."""

TCP_TIMEOUT = 1.0
"""Longest pause [s] within a TCP frame, whose segments may be delayed."""

_MBAP = struct.Struct(">HHHB")  # transaction, protocol, length, unit
_LENGTH_MAX = 254
_MIN_LENGTH = 4  # unit, function, CRC
_MAX_LENGTH = 256
_SIZES = {3: 8, 4: 8, 6: 8}  # of RTU requests, by function
_COUNTS = {16: 6, 23: 10}  # where the others say how many bytes of registers follow


@dataclass(frozen=True)
class RequestAdu:
    """A request PDU for a unit; transaction: of TCP, repeated in the reply."""

    unit: int
    pdu: bytes
    transaction: int = 0


def crc(data: bytes) -> int:
    """CRC-16 of Modbus: polynomial 8005 reflected, initial FFFF; low byte first."""
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
    """A reply ADU on a serial line."""
    body = bytes([unit]) + pdu
    return body + struct.pack("<H", crc(body))


def tcp_frame(request: RequestAdu, pdu: bytes) -> bytes:
    """A reply ADU over TCP."""
    return _MBAP.pack(request.transaction, 0, len(pdu) + 1, request.unit) + pdu


class Reader(ABC):
    """Splits a stream of bytes into requests; timeout [s]: the longest pause within one."""

    timeout: float

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._last = 0.0

    @property
    def gives_up_at(self) -> float:
        """Time after which `pause` discards a partial frame [s]; infinite without one."""
        return self._last + self.timeout if self._buffer else math.inf

    def feed(self, data: bytes, now: float) -> list[RequestAdu]:
        """The requests that these bytes complete, in order."""
        found = self.pause(now)
        self._last = now
        self._buffer += data
        while (request := self._next()) is not None:
            found.append(request)
        return found

    def pause(self, now: float) -> list[RequestAdu]:
        """Discard a partial frame after a timeout; requests that it ends are returned."""
        if not self._buffer or now - self._last <= self.timeout:
            return []
        found = self._ended()
        self._buffer.clear()
        return found

    @abstractmethod
    def _next(self) -> RequestAdu | None:
        """Take the next complete request."""

    def _ended(self) -> list[RequestAdu]:
        """The requests in what is buffered, if nothing follows."""
        return []


class TcpReader(Reader):
    """Requests over TCP, whose header holds the length."""

    timeout = TCP_TIMEOUT

    def _next(self) -> RequestAdu | None:
        if len(self._buffer) < _MBAP.size:
            return None
        transaction, protocol, length, unit = _MBAP.unpack_from(self._buffer)
        if protocol != 0 or not 2 <= length <= _LENGTH_MAX:
            self._buffer.clear()  # the next frame cannot be found
            return None
        end = _MBAP.size - 1 + length
        if len(self._buffer) < end:
            return None
        pdu = bytes(self._buffer[_MBAP.size : end])
        del self._buffer[:end]
        return RequestAdu(unit, pdu, transaction)


class RtuReader(Reader):
    """Requests on a serial line: the function determines the length, the CRC confirms it.

    Behind a damaged frame the next valid one is searched at every byte; a frame of an unknown
    function ends with the pause after it.
    """

    timeout = FRAME_TIMEOUT

    def _next(self) -> RequestAdu | None:
        size = _rtu_size(self._buffer, 0)
        is_whole = size is not None and size <= len(self._buffer)
        return self._search() if is_whole or len(self._buffer) > _MAX_LENGTH else None

    def _search(self) -> RequestAdu | None:
        """Take the first valid request, with what is before it."""
        for start in range(len(self._buffer) - _MIN_LENGTH + 1):
            size = _rtu_size(self._buffer, start)
            request = size and _checked(bytes(self._buffer[start : start + size]))
            if request:
                del self._buffer[: start + (size or 0)]
                return request
        del self._buffer[:-_MAX_LENGTH]
        return None

    def _ended(self) -> list[RequestAdu]:
        whole = _checked(bytes(self._buffer))
        found = []
        while whole is None and (request := self._search()) is not None:
            found.append(request)
        return found if whole is None else [whole]


def _rtu_size(data: bytearray, start: int) -> int | None:
    """Length of the request that begins here; None where it is not known, or not yet."""
    if len(data) < start + _MIN_LENGTH:
        return None
    function = data[start + 1]
    if function in _SIZES:
        return _SIZES[function]
    if function in _COUNTS and len(data) > start + _COUNTS[function]:
        return min(_COUNTS[function] + 3 + data[start + _COUNTS[function]], _MAX_LENGTH)
    return None


def _checked(frame: bytes) -> RequestAdu | None:
    """The request in a frame with a valid CRC, else None."""
    if len(frame) < _MIN_LENGTH or crc(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
        return None
    return RequestAdu(frame[0], frame[1:-2])
