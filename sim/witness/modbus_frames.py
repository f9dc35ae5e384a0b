"""Modbus ADUs in a stream of bytes, TCP and RTU, from docs/reference/modbus.md."""

import struct
from typing import NamedTuple

from drivers.codec.modbus.crc import crc16
from sim.witness.capture import Direction

READS, WRITE = (3, 4), 16
_HEADER, _RTU_MIN, _RTU_MAX = 7, 4, 256  # bytes
_PAUSE = 0.04  # s; a longer pause ends a partial frame on RTU
# Of RTU, by function: where a count of bytes stands, if one does, and bytes around those counted.
_SIZES: dict[Direction, dict[int, tuple[int | None, int]]] = {
    "amplifier": {**dict.fromkeys(READS, (None, 8)), WRITE: (6, 9)},
    "host": {
        **dict.fromkeys(READS, (2, 5)),
        WRITE: (None, 8),
        **dict.fromkeys(range(0x80, 0x100), (None, 5)),
    },
}


class Adu(NamedTuple):
    """An ADU; number: the TCP transaction, 0 over RTU; function 0: it is damaged."""

    raw: bytes
    unit: int = 0
    number: int = 0
    function: int = 0
    body: bytes = b""

    @property
    def is_good(self) -> bool:
        """Whether it has length and checksum of an ADU."""
        return self.function != 0


class AduReader:
    """Splits the stream of one direction into ADUs.

    TCP has a header: transaction, 0, length, unit. On RTU the function determines the length, and
    a CRC-16 confirms it.
    """

    def __init__(self, direction: Direction, *, over_tcp: bool) -> None:
        self._sizes = _SIZES[direction]
        self._next = self._next_tcp if over_tcp else self._next_rtu
        self._pause = float("inf") if over_tcp else _PAUSE
        self._buffer = b""
        self._last = 0.0

    @property
    def has_partial_frame(self) -> bool:
        """Whether the last bytes begin a frame."""
        return bool(self._buffer)

    def feed(self, time: float, data: bytes) -> list[Adu]:
        """Decode bytes; returns the complete frames, and damaged ones."""
        found: list[Adu] = []
        if self._buffer and time - self._last > self._pause:
            found.append(Adu(self._taken(len(self._buffer))))
        self._last = time
        self._buffer += data
        while (adu := self._next()) is not None:
            found.append(adu)
        return found

    def _taken(self, size: int) -> bytes:
        raw, self._buffer = self._buffer[:size], self._buffer[size:]
        return raw

    def _next_tcp(self) -> Adu | None:
        if len(self._buffer) < _HEADER:
            return None
        number, protocol, length, unit = struct.unpack_from(">HHHB", self._buffer)
        if protocol or not 2 <= length <= 254:
            return Adu(self._taken(len(self._buffer)))
        if len(self._buffer) < 6 + length:
            return None
        raw = self._taken(6 + length)
        return Adu(raw, unit, number, raw[7], raw[8:])

    def _next_rtu(self) -> Adu | None:
        """Return the first valid ADU, or the damaged bytes before it."""
        for begin in range(len(self._buffer) - _RTU_MIN + 1):
            size = self._size(begin)
            raw = self._buffer[begin : begin + size]
            if size and len(raw) == size and crc16(raw[:-2]) == raw[-2:]:
                if begin:
                    return Adu(self._taken(begin))
                return Adu(self._taken(size), raw[0], 0, raw[1], raw[2:-2])
        # What cannot become an ADU is damaged.
        is_whole = len(self._buffer) >= max(_RTU_MIN, self._size(0))
        return Adu(self._taken(len(self._buffer))) if is_whole else None

    def _size(self, begin: int) -> int:
        """Size of the ADU that begins here; 0 where it is invalid."""
        if len(self._buffer) < begin + 2:
            return 0
        at, around = self._sizes.get(self._buffer[begin + 1], (None, 0))
        counted = 0 if at is None else sum(self._buffer[begin + at : begin + at + 1])
        size = around + counted
        return size if size <= _RTU_MAX else 0
