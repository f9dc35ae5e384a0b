"""Modbus telegrams out of a stream of bytes, from docs/wire-modbus.md: over TCP and RTU."""

import struct
from typing import NamedTuple, Protocol

from sim.witness.seen import Toward

_LONGEST = 256
_PAUSE = 0.04  # s; what pauses longer inside a frame is none any more
_SIZES: dict[Toward, dict[int, int]] = {
    "amplifier": {3: 8, 4: 8, 6: 8, 43: 7},
    "host": {6: 8, 16: 8},
}
# Where the others say how many bytes follow, and how many frame them, CRC included.
_COUNTS: dict[Toward, dict[int, tuple[int, int]]] = {
    "amplifier": {16: (6, 9), 23: (10, 13)},
    "host": {3: (2, 5), 4: (2, 5), 23: (2, 5)},
}


class Telegram(NamedTuple):
    """A frame; number: the transaction of TCP, 0 over RTU. pdu is None for what was damaged."""

    raw: bytes
    unit: int
    number: int
    pdu: bytes | None


class Splitter(Protocol):
    """Takes telegrams that go one way out of a stream."""

    def feed(self, time: float, data: bytes) -> list[Telegram]:
        """What these bytes complete."""


class TcpSplitter:
    """Telegrams with their header: transaction, 0, length, unit."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, time: float, data: bytes) -> list[Telegram]:
        """What these bytes complete."""
        self._buffer += data
        found = []
        while len(self._buffer) >= 7:
            number, protocol, length, unit = struct.unpack_from(">HHHB", self._buffer)
            if protocol or not 2 <= length <= 254:
                found.append(Telegram(self._buffer, unit, number, None))
                self._buffer = b""
                break
            if len(self._buffer) < 6 + length:
                break
            raw, self._buffer = self._buffer[: 6 + length], self._buffer[6 + length :]
            found.append(Telegram(raw, unit, number, raw[7:]))
        return found


class RtuSplitter:
    """Telegrams whose length their function tells; CRC-16, low byte first."""

    def __init__(self, toward: Toward) -> None:
        self._toward: Toward = toward
        self._buffer = b""
        self._last = 0.0

    def feed(self, time: float, data: bytes) -> list[Telegram]:
        """What these bytes complete."""
        found = []
        if self._buffer and time - self._last > _PAUSE:
            found.append(Telegram(self._buffer, self._buffer[0], 0, None))
            self._buffer = b""
        self._last = time
        self._buffer += data
        while len(self._buffer) >= 4:
            size = self._size()
            if size is not None and len(self._buffer) < size:
                break
            raw = self._buffer[:size]
            if size is None or size > _LONGEST or crc16(raw[:-2]) != raw[-2:]:
                # Nothing says where the next one begins.
                found.append(Telegram(self._buffer, raw[0], 0, None))
                self._buffer = b""
                break
            self._buffer = self._buffer[size:]
            found.append(Telegram(raw, raw[0], 0, raw[1:-2]))
        return found

    def _size(self) -> int | None:
        """How long the frame is that begins here; None where none can."""
        function = self._buffer[1]
        if self._toward == "host" and function & 0x80:
            return 5
        if function in _SIZES[self._toward]:
            return _SIZES[self._toward][function]
        if self._toward == "host" and function == 43:
            return self._identification_size()
        if function not in _COUNTS[self._toward]:
            return None
        at, around = _COUNTS[self._toward][function]
        return around + self._buffer[at] if len(self._buffer) > at else around

    def _identification_size(self) -> int:
        """Of an answer to function 43: eight bytes, then each object with its length."""
        at = 8
        for _ in range(self._buffer[7] if len(self._buffer) > 7 else 0):
            at += 2 + (self._buffer[at + 1] if len(self._buffer) > at + 1 else 0)
        return at + 2


def crc16(data: bytes) -> bytes:
    """CRC-16 of Modbus (polynomial 8005 reflected, from FFFF) as it goes on the line."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")
