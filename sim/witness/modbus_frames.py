"""Modbus telegrams out of a stream of bytes, TCP and RTU, from docs/reference/wire-modbus.md."""

import struct
from typing import NamedTuple, Protocol

from sim.witness.decoded import Direction

_SHORTEST, _LONGEST = 4, 256
_PAUSE = 0.04  # s; what pauses longer inside a frame is none any more
_SIZES: dict[Direction, dict[int, int]] = {
    "amplifier": {3: 8, 4: 8, 6: 8, 43: 7},
    "host": {6: 8, 16: 8},
}
# Where the others say how many bytes follow, and how many frame them, CRC included.
_COUNTS: dict[Direction, dict[int, tuple[int, int]]] = {
    "amplifier": {16: (6, 9), 23: (10, 13)},
    "host": {3: (2, 5), 4: (2, 5), 23: (2, 5)},
}


class Adu(NamedTuple):
    """A frame; number: the transaction of TCP, 0 over RTU. pdu is None for what was damaged."""

    raw: bytes
    unit: int
    number: int
    pdu: bytes | None


class Splitter(Protocol):
    """Takes telegrams that go one way out of a stream."""

    @property
    def has_partial_frame(self) -> bool:
        """Whether the last bytes have begun what others may complete."""

    def feed(self, time: float, data: bytes) -> list[Adu]:
        """What these bytes complete."""


class TcpSplitter:
    """Telegrams with their header: transaction, 0, length, unit."""

    def __init__(self) -> None:
        self._buffer = b""

    @property
    def has_partial_frame(self) -> bool:
        """Whether the last bytes have begun what others may complete."""
        return bool(self._buffer)

    def feed(self, time: float, data: bytes) -> list[Adu]:
        """What these bytes complete."""
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


class RtuSplitter:
    """Telegrams whose length their function tells; CRC-16, low byte first."""

    def __init__(self, direction: Direction) -> None:
        self._toward: Direction = direction
        self._buffer = b""
        self._last = 0.0

    @property
    def has_partial_frame(self) -> bool:
        """Whether the last bytes have begun what others may complete."""
        return bool(self._buffer)

    def feed(self, time: float, data: bytes) -> list[Adu]:
        """What these bytes complete."""
        found = []
        if self._buffer and time - self._last > _PAUSE:
            found.append(Adu(self._buffer, self._buffer[0], 0, None))
            self._buffer = b""
        self._last = time
        self._buffer += data
        while len(self._buffer) >= _SHORTEST:
            begin, size = self._good()
            if not size:
                break
            if begin:
                found.append(self._damaged(begin))
            raw, self._buffer = self._buffer[:size], self._buffer[size:]
            found.append(Adu(raw, raw[0], 0, raw[1:-2]))
        if len(self._buffer) >= _SHORTEST and not self._may_become_whole():
            found.append(self._damaged(len(self._buffer)))
        return found

    def _good(self) -> tuple[int, int]:
        """Where the first good telegram begins, maybe behind a damaged one, and its size or 0."""
        for begin in range(len(self._buffer) - _SHORTEST + 1):
            size = self._size(self._buffer[begin:])
            end = begin + size
            if size and end <= len(self._buffer):
                raw = self._buffer[begin:end]
                if crc16(raw[:-2]) == raw[-2:]:
                    return begin, size
        return 0, 0

    def _may_become_whole(self) -> bool:
        """Whether what has come may be the beginning of a telegram."""
        return len(self._buffer) < self._size(self._buffer)

    def _damaged(self, size: int) -> Adu:
        raw, self._buffer = self._buffer[:size], self._buffer[size:]
        return Adu(raw, raw[0], 0, None)

    def _size(self, data: bytes) -> int:
        """How long the telegram is that begins so; 0 where none can."""
        function = data[1]
        if self._toward == "host" and function & 0x80:
            return 5
        if function in _SIZES[self._toward]:
            return _SIZES[self._toward][function]
        if self._toward == "host" and function == 43:
            return _identification_size(data)
        if function not in _COUNTS[self._toward]:
            return 0
        at, around = _COUNTS[self._toward][function]
        size = around + data[at] if len(data) > at else around
        return size if size <= _LONGEST else 0


def _identification_size(data: bytes) -> int:
    """Of an answer to function 43: eight bytes, then each object with its length."""
    at = 8
    for _ in range(data[7] if len(data) > 7 else 0):
        at += 2 + (data[at + 1] if len(data) > at + 1 else 0)
    return at + 2


def crc16(data: bytes) -> bytes:
    """CRC-16 of Modbus (polynomial 8005 reflected, from FFFF) as it goes on the line."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")
