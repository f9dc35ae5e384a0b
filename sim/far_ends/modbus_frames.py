"""Modbus ADUs at the amplifier's end: RTU with CRC, TCP with MBAP header. No I/O.

A long pause ends a frame.
"""

import math
import struct
from typing import NamedTuple

from drivers.codec.modbus.crc import crc16

READS, WRITE = (3, 4), 16
"""Functions."""
FRAME_TIMEOUT = 0.02
"""Longest pause [s] within an RTU frame: less than the 30 ms after which a host repeats it."""
TCP_TIMEOUT = 1.0
"""Longest pause [s] within a TCP frame, whose segments may be delayed."""

_MBAP = struct.Struct(">HHHB")  # transaction, protocol, length, unit
_LENGTH_MAX = 254
_MIN_LENGTH = 4  # unit, function, CRC
_MAX_LENGTH = 256
_WITH_TWO_WORDS, _SIZE = 6, 8  # the last of these functions, and the size of their RTU requests
_WRITE_SIZE, _COUNT_AT = 9, 6  # without the registers that the byte there counts


class RequestAdu(NamedTuple):
    """A request PDU for a unit; transaction: of TCP, repeated in the reply."""

    unit: int
    pdu: bytes
    transaction: int = 0


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """A reply ADU on a serial line."""
    body = bytes([unit]) + pdu
    return body + crc16(body)


def tcp_frame(request: RequestAdu, pdu: bytes) -> bytes:
    """A reply ADU over TCP."""
    return _MBAP.pack(request.transaction, 0, len(pdu) + 1, request.unit) + pdu


class RequestReader:
    """Splits a stream of bytes into requests; timeout [s]: the longest pause within one."""

    def __init__(self, *, is_rtu: bool) -> None:
        self.timeout = FRAME_TIMEOUT if is_rtu else TCP_TIMEOUT
        self._split = _split_rtu if is_rtu else _split_tcp
        self._buffer = b""
        self._last = 0.0

    @property
    def gives_up_at(self) -> float:
        """Time after which `pause` discards a partial frame [s]; infinite without one."""
        return self._last + self.timeout if self._buffer else math.inf

    def feed(self, data: bytes, now: float) -> list[RequestAdu]:
        """The requests that these bytes complete, in order."""
        before = self.pause(now)
        self._last = now
        found, self._buffer = self._split(self._buffer + data, is_ended=False)
        return before + found

    def pause(self, now: float) -> list[RequestAdu]:
        """Discard a partial frame after a timeout; requests that it ends are returned."""
        if not self._buffer or now - self._last <= self.timeout:
            return []
        found, _ = self._split(self._buffer, is_ended=True)
        self._buffer = b""
        return found


def _split_tcp(data: bytes, *, is_ended: bool) -> tuple[list[RequestAdu], bytes]:
    """Split bytes by the lengths in headers; returns what is left, too."""
    found: list[RequestAdu] = []
    while len(data) >= _MBAP.size:
        transaction, protocol, length, unit = _MBAP.unpack_from(data)
        if protocol != 0 or not 2 <= length <= _LENGTH_MAX:
            return found, b""  # the next frame cannot be found
        end = _MBAP.size - 1 + length
        if len(data) < end:
            break
        found.append(RequestAdu(unit, data[_MBAP.size : end], transaction))
        data = data[end:]
    return found, data


def _split_rtu(data: bytes, *, is_ended: bool) -> tuple[list[RequestAdu], bytes]:
    """Split bytes by functions, which determine lengths, and CRCs; returns what is left, too.

    Behind a damaged frame the next valid one is searched at every byte; a frame of an unknown
    function ends with the pause after it.
    """
    whole = _checked(data) if is_ended else None
    if whole is not None:
        return [whole], b""
    found: list[RequestAdu] = []
    while is_ended or 0 < _rtu_size(data) <= len(data) or len(data) > _MAX_LENGTH:
        request, data = _first_request(data)
        if request is None:
            break
        found.append(request)
    return found, data


def _first_request(data: bytes) -> tuple[RequestAdu | None, bytes]:
    """Take the first valid request, with what is before it; returns what is left, too."""
    for start in range(len(data) - _MIN_LENGTH + 1):
        end = start + _rtu_size(data[start:])
        request = _checked(data[start:end])
        if request is not None:
            return request, data[end:]
    return None, data[-_MAX_LENGTH:]


def _rtu_size(data: bytes) -> int:
    """Length of the request that begins here; 0 where it is not known, or not yet."""
    function = data[1] if len(data) >= _MIN_LENGTH else 0
    if 1 <= function <= _WITH_TWO_WORDS:
        return _SIZE
    if function == WRITE and len(data) > _COUNT_AT:
        return min(_WRITE_SIZE + data[_COUNT_AT], _MAX_LENGTH)
    return 0


def _checked(frame: bytes) -> RequestAdu | None:
    """The request in a frame with a valid CRC, else None."""
    if len(frame) < _MIN_LENGTH or crc16(frame[:-2]) != frame[-2:]:
        return None
    return RequestAdu(frame[0], frame[1:-2])
