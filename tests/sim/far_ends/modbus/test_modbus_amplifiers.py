"""The amplifiers' side of Modbus in protocol 3: registers, exceptions, and masters not ours."""

import asyncio
import os
import tty

import minimalmodbus
import pytest

from drivers.protocol.table import STATES, STATUS
from drivers.wires.modbus.registers import HEAD
from sim.amplifier.contract import Amplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers

STATUS_AREA = 256 * 9 + 128


def register(name: str) -> int:
    """The register of a value of the status, of the first level for the levels."""
    return STATUS_AREA + HEAD + STATUS.places.get(name, STATUS.words)


def drive(master: minimalmodbus.Instrument) -> None:
    """Identity, status, arm, a set of one tone, a refusal, stop; every function it has."""
    assert master.read_string(1067, 16, functioncode=4).rstrip("\0") == "era-haptics"
    assert master.read_register(register("state"), functioncode=3) == STATES["SWITCH_ON_DISABLED"]
    assert master.read_register(register("temperature"), 1, functioncode=4, signed=True) == 25
    master.write_registers(0x300, [1, 9, 2000])
    master.write_registers(0x500, [2, 9, 7, 3, 1, 0, 0, 0x30, 2200, 2000, 0])
    assert master.read_registers(0x580, 5) == [2, 0, 7, 5, 0]
    levels = register("levels")
    assert master.read_registers(levels, 4, functioncode=4) == [0, 0, 0, 2000]
    assert master.read_register(register("token")) == 7
    with pytest.raises(minimalmodbus.IllegalRequestError):
        master.write_register(0x900, 1, functioncode=6)
    master.write_registers(0x800, [3, 0])
    assert master.read_registers(levels, 4) == [0, 0, 0, 0]


async def test_minimalmodbus_drives_it_over_a_serial_line() -> None:
    """A master that is not ours, through a pseudo-terminal."""
    loop = asyncio.get_running_loop()
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        end = ModbusAmplifiers(
            {1: Amplifier("a", channels=4)}, lambda data: os.write(ours, data) and None, is_rtu=True
        )
        loop.add_reader(ours, lambda: end.receive(os.read(ours, 4096), loop.time()))
        master = minimalmodbus.Instrument(os.ttyname(theirs), 1)
        assert master.serial is not None
        master.serial.timeout = 0.5  # s; it waits so long for the rest of what is an exception
        try:
            await asyncio.to_thread(drive, master)
        finally:
            master.serial.close()
    finally:
        loop.remove_reader(ours)
        os.close(ours)
        os.close(theirs)
