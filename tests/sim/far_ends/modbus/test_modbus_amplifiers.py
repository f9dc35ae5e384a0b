"""The amplifiers' side of Modbus in protocol 3: registers, exceptions, and masters not ours."""

import asyncio
import os
import struct
import tty

import minimalmodbus
import pytest
from pymodbus.client import AsyncModbusTcpClient

from drivers.protocol.table import MESSAGES, REFUSALS, STATES
from sim.amplifier.contract import Amplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.modbus_frames import FRAME_TIMEOUT, rtu_frame

STATUS = 256 * 9 + 128


class Port:
    """Amplifiers of four channels at units 1 and 2 of a line; PDUs in, PDUs out."""

    def __init__(self) -> None:
        self.now = 0.0
        self.sent: list[bytes] = []
        self.amplifiers = {unit: Amplifier(str(unit), channels=4) for unit in (1, 2)}
        self.end = ModbusAmplifiers(self.amplifiers, self.sent.append, is_rtu=True)

    def ask(self, pdu: bytes, unit: int = 1) -> bytes | None:
        """The response to a PDU, None without one."""
        self.sent.clear()
        self.end.receive(rtu_frame(unit, pdu), self.now)
        self.end.tick(self.now + 2 * FRAME_TIMEOUT)
        return self.sent[0][1:-2] if self.sent else None

    def write(self, address: int, *registers: int, unit: int = 1) -> bytes | None:
        """Write registers."""
        count = len(registers)
        head = struct.pack(">BHHB", 16, address, count, 2 * count & 0xFF)
        return self.ask(head + struct.pack(f">{count}H", *registers), unit)

    def read(self, address: int, count: int, unit: int = 1, function: int = 3) -> tuple[int, ...]:
        """Read registers; the code of an exception alone."""
        pdu = self.ask(struct.pack(">BHH", function, address, count), unit)
        assert pdu is not None
        return tuple(pdu[1:]) if pdu[0] & 0x80 else struct.unpack(f">{count}H", pdu[2:])


def test_broadcast_reaches_all_units_and_has_no_response() -> None:
    """A stop silences both; to arm is for one unit alone; other units are silent."""
    port = Port()
    for unit in (1, 2):
        port.write(0x300, 1, 9, 250, unit=unit)
    assert port.write(0x800, 2, 5, unit=0) is None
    port.now = 0.01
    for unit in (1, 2):
        assert port.read(STATUS + 2, 1, unit) == (STATES["QUICK_STOP_ACTIVE"],)
        assert port.read(0x880, 2, unit) == (0, 0)
        port.write(0xB00, 3, 1, unit=unit)
    assert port.write(0x300, 4, 8, 250, unit=0) is None
    assert port.read(STATUS + 2, 1, 2) == (STATES["SWITCH_ON_DISABLED"],)
    assert port.write(0x900, 5, unit=3) is None


def test_address_is_taken_once_its_reply_was_read() -> None:
    """By the amplifier of this serial number; after a broadcast at once."""
    port = Port()
    serial = MESSAGES["SetAddress"].request.pack({"address": 9, "serial_number": "SIM-2"})
    port.write(0xF00, 1, *serial)
    assert port.read(0xF80, 2) == (1, REFUSALS["BAD_VALUE"] << 8 | 255)
    assert port.write(0xF00, 2, *serial, unit=2) is not None
    assert port.read(STATUS, 1, 2) == (0,)
    assert port.read(0xF80, 2, 2) == (2, 0)
    assert port.write(0x900, 3, unit=2) is None
    assert port.write(0x900, 3, unit=9) is not None
    again = MESSAGES["SetAddress"].request.pack({"address": 4, "serial_number": "SIM-1"})
    assert port.write(0xF00, 4, *again, unit=0) is None
    assert [port.write(0x900, 5, unit=unit) is None for unit in (1, 4, 9)] == [True, False, False]


def drive(master: minimalmodbus.Instrument) -> None:
    """Identity, status, arm, a set of one tone, a refusal, stop; every function it has."""
    assert master.read_string(1067, 16, functioncode=4).rstrip("\0") == "era-haptics"
    assert master.read_register(STATUS + 2, functioncode=3) == STATES["SWITCH_ON_DISABLED"]
    assert master.read_register(STATUS + 7, 1, functioncode=4, signed=True) == 25.0
    master.write_registers(0x300, [1, 9, 2000])
    master.write_registers(0x500, [2, 9, 7, 3, 1, 0, 0, 0x30, 2200, 2000, 0])
    assert master.read_registers(0x580, 5) == [2, 0, 7, 5, 0]
    levels = STATUS + 2 + 9
    assert master.read_registers(levels, 4, functioncode=4) == [0, 0, 0, 2000]
    assert master.read_register(STATUS + 2 + 7) == 7
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


async def test_pymodbus_reads_its_status_over_tcp() -> None:
    """Two units behind one port, one of them armed."""
    loop = asyncio.get_running_loop()
    amplifiers = {unit: Amplifier(str(unit), channels=4) for unit in (1, 2)}
    amplifiers[2].handle("Arm", {"session": 9, "watchdog": 2000}, loop.time())

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        end = ModbusAmplifiers(amplifiers, writer.write, is_rtu=False)
        while data := await reader.read(4096):
            end.receive(data, loop.time())
        writer.close()
        await writer.wait_closed()
        ended.set()

    ended = asyncio.Event()
    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    client = AsyncModbusTcpClient("127.0.0.1", port=server.sockets[0].getsockname()[1])
    try:
        assert await client.connect()
        for unit, state in ((1, 1), (2, 4)):
            status = await client.read_holding_registers(STATUS, count=23, device_id=unit)
            assert status.registers[:4] == [0, 0, state, 0]
            assert status.registers[10] == 0x0408
        wrong = await client.read_input_registers(0x900, count=1, device_id=1)
        assert wrong.exception_code == 2
    finally:
        client.close()
        await ended.wait()
        server.close()
        await server.wait_closed()
