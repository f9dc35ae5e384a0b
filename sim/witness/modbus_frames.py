"""Modbus ADUs in a stream of bytes, TCP and RTU, from docs/reference/modbus.md."""

import struct
from typing import NamedTuple

from drivers.codec.modbus.crc import crc16
from sim.witness.capture import Direction

READS, WRITE = (3, 4), 16
_HEADER, _RTU_MIN, _RTU_MAX = 7, 4, 256  # bytes
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


def split_tcp(data: bytes) -> tuple[list[Adu], bytes]:
    """Split bytes by the headers (transaction, 0, length, unit); returns what is left, too."""
    found: list[Adu] = []
    while len(data) >= _HEADER:
        number, protocol, length, unit = struct.unpack_from(">HHHB", data)
        if protocol or not 2 <= length <= 254:
            return [*found, Adu(data)], b""
        raw, rest = data[: 6 + length], data[6 + length :]
        if len(raw) < 6 + length:
            break
        found.append(Adu(raw, unit, number, raw[7], raw[8:]))
        data = rest
    return found, data


def split_rtu(direction: Direction, data: bytes) -> tuple[list[Adu], bytes]:
    """Split bytes by functions, which determine lengths, and CRC-16; returns what is left, too."""
    found: list[Adu] = []
    begin = 0
    while begin + _RTU_MIN <= len(data):
        size = _size(direction, data[begin:])
        raw = data[begin : begin + size]
        if size and len(raw) == size and crc16(raw[:-2]) == raw[-2:]:
            if begin:
                found.append(Adu(data[:begin]))
            found.append(Adu(raw, raw[0], 0, raw[1], raw[2:-2]))
            begin, data = 0, data[begin + size :]
        else:
            begin += 1
    if len(data) >= max(_RTU_MIN, _size(direction, data)):  # it cannot become an ADU
        return [*found, Adu(data)], b""
    return found, data


def _size(direction: Direction, data: bytes) -> int:
    """Size of the ADU that begins with these bytes; 0 where it is invalid."""
    at, around = _SIZES[direction].get(data[1], (None, 0)) if len(data) > 1 else (None, 0)
    size = around if at is None else around + sum(data[at : at + 1])
    return size if size <= _RTU_MAX else 0
