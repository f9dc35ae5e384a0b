"""Decode request PDUs of Modbus, with the exceptions of invalid ones."""

import struct
from collections.abc import Sequence

READ_HOLDING, READ_INPUT, WRITE = 3, 4, 16
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
_READ_MAX, _WRITE_MAX = 125, 123


class ModbusException(Exception):
    """A Modbus exception, by its code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def pair(body: bytes) -> tuple[int, int]:
    """Two words: an address and a count."""
    if len(body) != 4:
        raise ModbusException(ILLEGAL_VALUE)
    first, second = struct.unpack(">HH", body)
    return first, second


def check_range(address: int, count: int, *, end: int) -> None:
    """Check a register range against the end of the map; raises ModbusException."""
    if not 1 <= count <= _READ_MAX:
        raise ModbusException(ILLEGAL_VALUE)
    if address + count > end:
        raise ModbusException(ILLEGAL_ADDRESS)


def to_write(body: bytes) -> tuple[int, Sequence[int]]:
    """The address and the words of a write."""
    if len(body) < 5:
        raise ModbusException(ILLEGAL_VALUE)
    address, count, size = struct.unpack_from(">HHB", body)
    if not (1 <= count <= _WRITE_MAX and size == 2 * count == len(body) - 5):
        raise ModbusException(ILLEGAL_VALUE)
    return address, struct.unpack(f">{count}H", body[5:])


def registers_read(function: int, words: Sequence[int]) -> bytes:
    """The reply PDU of a read."""
    return struct.pack(f">BB{len(words)}H", function, 2 * len(words), *words)
