"""Modbus ADUs in a stream of bytes, TCP and RTU, from docs/reference/modbus.md."""

import struct
from abc import ABC, abstractmethod
from typing import NamedTuple

from drivers.codec.modbus.crc import crc16
from sim.witness.capture import Direction

_MIN_LENGTH, _MAX_LENGTH = 4, 256
_PAUSE = 0.04  # s; a longer pause ends a partial frame
_SIZES: dict[Direction, dict[int, int]] = {
    "amplifier": {3: 8, 4: 8, 6: 8},
    "host": {6: 8, 16: 8},
}
# Of the others: offset of the byte count, and bytes around the data, CRC included.
_COUNTS: dict[Direction, dict[int, tuple[int, int]]] = {
    "amplifier": {16: (6, 9), 23: (10, 13)},
    "host": {3: (2, 5), 4: (2, 5), 23: (2, 5)},
}


class Adu(NamedTuple):
    """An ADU; number: the TCP transaction, 0 over RTU; pdu: None where it is damaged."""

    raw: bytes
    unit: int
    number: int
    pdu: bytes | None


class Splitter(ABC):
    """Splits the stream of one direction into ADUs."""

    def __init__(self) -> None:
        self._buffer = b""

    @property
    def has_partial_frame(self) -> bool:
        """Whether the last bytes begin a frame."""
        return bool(self._buffer)

    @abstractmethod
    def feed(self, time: float, data: bytes) -> list[Adu]:
        """Decode bytes; returns the complete frames."""


class TcpSplitter(Splitter):
    """Splits TCP ADUs by their header: transaction, 0, length, unit."""

    def feed(self, time: float, data: bytes) -> list[Adu]:
        """Decode bytes; returns the complete frames."""
        self._buffer += data
        found = []
        while len(self._buffer) >= 7:
            number, protocol, length, unit = struct.unpack_from(">HHHB", self._buffer)
            if protocol or not 2 <= length <= 254:
                found.append(Adu(self._buffer, unit, number, None))
                self._buffer = b""
                break
            if len(self._buffer) < 6 + length:
                break
            raw, self._buffer = self._buffer[: 6 + length], self._buffer[6 + length :]
            found.append(Adu(raw, unit, number, raw[7:]))
        return found


class RtuSplitter(Splitter):
    """Splits RTU ADUs, whose function determines the length; CRC-16, low byte first."""

    def __init__(self, direction: Direction) -> None:
        super().__init__()
        self._direction: Direction = direction
        self._last = 0.0

    def feed(self, time: float, data: bytes) -> list[Adu]:
        """Decode bytes; returns the complete frames."""
        found = []
        if self._buffer and time - self._last > _PAUSE:
            found.append(Adu(self._buffer, self._buffer[0], 0, None))
            self._buffer = b""
        self._last = time
        self._buffer += data
        while len(self._buffer) >= _MIN_LENGTH:
            begin, size = self._first_valid()
            if not size:
                break
            if begin:
                found.append(self._damaged(begin))
            raw, self._buffer = self._buffer[:size], self._buffer[size:]
            found.append(Adu(raw, raw[0], 0, raw[1:-2]))
        if len(self._buffer) >= _MIN_LENGTH and not self._may_be_partial():
            found.append(self._damaged(len(self._buffer)))
        return found

    def _first_valid(self) -> tuple[int, int]:
        """Offset and size of the first valid ADU; size 0 for none."""
        for begin in range(len(self._buffer) - _MIN_LENGTH + 1):
            size = self._size(self._buffer[begin:])
            end = begin + size
            if size and end <= len(self._buffer):
                raw = self._buffer[begin:end]
                if crc16(raw[:-2]) == raw[-2:]:
                    return begin, size
        return 0, 0

    def _may_be_partial(self) -> bool:
        """Whether the buffer may begin an ADU."""
        return len(self._buffer) < self._size(self._buffer)

    def _damaged(self, size: int) -> Adu:
        raw, self._buffer = self._buffer[:size], self._buffer[size:]
        return Adu(raw, raw[0], 0, None)

    def _size(self, data: bytes) -> int:
        """Size of the ADU that begins with these bytes; 0 where it is invalid."""
        function = data[1]
        if self._direction == "host" and function & 0x80:
            return 5
        if function in _SIZES[self._direction]:
            return _SIZES[self._direction][function]
        if function not in _COUNTS[self._direction]:
            return 0
        at, around = _COUNTS[self._direction][function]
        size = around + data[at] if len(data) > at else around
        return size if size <= _MAX_LENGTH else 0
