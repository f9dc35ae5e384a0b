"""Modbus masters of other libraries, and an exchange of each with an amplifier of four channels."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import minimalmodbus
import pytest
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.pdu import ModbusPDU

from drivers.protocol.definition import STATES

TIMEOUT = 5.0  # s; far ends may be processes, on a busy machine
STATUS = 256 * 9 + 128


class MinimalModbus:
    """That of minimalmodbus, on a serial port."""

    def __init__(self, url: str) -> None:
        self._master = minimalmodbus.Instrument(urlsplit(url).path, 1)
        assert self._master.serial is not None
        self._serial = self._master.serial
        self._serial.timeout = 0.5  # s; it waits so long for the rest of what is an exception

    def read(self, first: int, count: int, function: int) -> list[int]:
        return self._master.read_registers(first, count, functioncode=function)

    def write(self, first: int, registers: Sequence[int]) -> None:
        self._master.write_registers(first, [*registers])

    def write_one(self, first: int, register: int) -> None:
        self._master.write_register(first, register, functioncode=6)

    def close(self) -> None:
        self._serial.close()


class Pymodbus:
    """That of pymodbus, on a serial port or over TCP."""

    def __init__(self, url: str) -> None:
        place = urlsplit(url)
        self._client: Any = (
            ModbusTcpClient(place.hostname or "", port=place.port or 0, timeout=TIMEOUT)
            if place.port
            else ModbusSerialClient(place.path, timeout=TIMEOUT)
        )
        assert self._client.connect()

    def read(self, first: int, count: int, function: int) -> list[int]:
        by = {3: self._client.read_holding_registers, 4: self._client.read_input_registers}
        return [*_granted(by[function](first, count=count)).registers]

    def write(self, first: int, registers: Sequence[int]) -> None:
        _granted(self._client.write_registers(first, [*registers]))

    def write_one(self, first: int, register: int) -> None:
        _granted(self._client.write_register(first, register))

    def close(self) -> None:
        self._client.close()


def _granted(response: ModbusPDU) -> ModbusPDU:
    if response.isError():
        raise minimalmodbus.IllegalRequestError(str(response))
    return response


Make: TypeAlias = type[MinimalModbus] | type[Pymodbus]
MASTERS: Mapping[str, tuple[str, Make]] = {
    "minimalmodbus over rtu": ("rtu", MinimalModbus),
    "pymodbus over rtu": ("rtu", Pymodbus),
    "pymodbus over tcp": ("tcp", Pymodbus),
}
"""Each with its line, made of the URL of an amplifier."""


def drive(make: Make, url: str) -> str:
    """Identity, status, arm, a set of one tone, a refusal, stop; returns the vendor."""
    master = make(url)
    try:
        vendor = b"".join(each.to_bytes(2) for each in master.read(1067, 16, 4))
        assert master.read(STATUS + 2, 1, 3) == [STATES["SWITCH_ON_DISABLED"]]
        assert master.read(STATUS + 7, 1, 4) == [250]  # 0.1 degrees C
        master.write(0x300, [1, 9, 2000, 0])
        master.write(0x500, [2, 9, 7, 3, 1, 0, 0, 0x30, 2200, 2000, 0])
        assert master.read(0x580, 5, 3) == [2, 0, 7, 5, 0]
        levels = STATUS + 2 + 11
        assert master.read(levels, 4, 4) == [0, 0, 0, 2000]
        assert master.read(STATUS + 2 + 9, 1, 3) == [7]
        with pytest.raises(minimalmodbus.IllegalRequestError):
            master.write_one(0x900, 1)  # function 6
        master.write(0x800, [3, 0])
        assert master.read(levels, 4, 3) == [0, 0, 0, 0]
        return vendor.rstrip(b"\0").decode()
    finally:
        master.close()
