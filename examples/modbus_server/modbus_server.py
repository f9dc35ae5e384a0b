"""An amplifier of protocol 4 on pymodbus's own server, over TCP or a serial port.

    python examples/modbus_server/modbus_server.py tcp 5020
    python examples/modbus_server/modbus_server.py rtu /dev/ttyUSB0 [N, for no parity]

The server frames and answers; here are the registers of docs/reference/modbus.md, and behind them
the project's simulated amplifier, in whose place yours goes: it takes the values of a message and
returns the reply registers, or raises Refusal. Written for pymodbus 3.16, whose servers change with
its minor versions.
"""

import asyncio
import sys

from pymodbus.constants import ExcCodes
from pymodbus.datastore import ModbusServerContext
from pymodbus.exceptions import NoSuchIdException
from pymodbus.framer import FramerType
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.protocol.definition import BY_NUMBER, MAX_WORDS, Message, decode_request, nak_of
from drivers.protocol.records import Refusal
from drivers.protocol.sets import is_earlier_part
from drivers.wires.modbus_frames import (
    AREA,
    BOX,
    IDENTITY_REGISTER,
    PRESENT,
    REPLY_OFFSET,
    pack_identity,
)
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier

UNIT, BAUD = 1, 115_200
STEP = 0.001  # s; between looks at the watchdog
_COUNTS = range(1, 124)  # registers of a write


class Unit:
    """An amplifier under a number, as registers: a message is written, then its reply is read."""

    def __init__(self, amplifier: SimulatedAmplifier, number: int) -> None:
        self.amplifier, self.number = amplifier, number
        self.is_rtu = False  # where number 0 is a broadcast
        self.moves_to = 0  # the number that SetAddress has given it
        self._replies: dict[int, tuple[int, ...]] = {}  # tag, result and words by message

    def write(self, address: int, words: list[int], *, is_broadcast: bool) -> ExcCodes | None:
        """Carry out what is written; an exception where no message is written there."""
        number, offset = divmod(address, BOX)
        if offset or number not in BY_NUMBER or len(words) > MAX_WORDS + 1:
            return ExcCodes.ILLEGAL_ADDRESS
        message = BY_NUMBER[number]
        if is_broadcast and not message.is_broadcast:
            return None
        result, reply = self._carry_out(message, words[1:])
        if is_broadcast and not result:
            self.amplifier.withdraw_status()
        if not is_broadcast:
            self._replies[number] = words[0], result, *reply
        if message.name == "SetAddress" and result == 0:
            self.moves_to = words[1]
            if is_broadcast:
                self._move()
        return None

    def read(self, address: int, count: int) -> list[int] | ExcCodes:
        """Return registers of a reply, or of the identity."""
        number, offset = divmod(address, BOX)
        first, area = IDENTITY_REGISTER, [*pack_identity(self.amplifier.identity)]
        if offset >= REPLY_OFFSET and number in BY_NUMBER:
            first, area = number * BOX + REPLY_OFFSET, self._reply(BY_NUMBER[number])
        if not first <= address <= address + count <= first + len(area):
            return ExcCodes.ILLEGAL_ADDRESS
        if first // BOX in BY_NUMBER and BY_NUMBER[first // BOX].name == "SetAddress":
            asyncio.get_running_loop().call_later(STEP, self._move)  # behind the response
        return area[address - first :][:count]

    def _reply(self, message: Message) -> list[int]:
        tag, result, *words = self._replies.get(message.number, (0, 0))
        if message.name in PRESENT and result:  # a refusal is read once
            self._replies[message.number] = tag, 0
        elif message.name in PRESENT:
            result, words = self._carry_out(message, [])
        row = [tag, result, *words]
        return row + [0] * (AREA - len(row))

    def _carry_out(self, message: Message, words: list[int]) -> tuple[int, list[int]]:
        """Return the result of a message and the words of its reply."""
        try:
            name, values = decode_request(message.number, words)
            done = self.amplifier.handle(name, values, threads.now())
        except Refusal as refusal:
            if is_earlier_part(message.number, words):
                return 0, []
            _, code, channel = nak_of(refusal, message.number)
            return code << 8 | channel, []
        return 0, [*message.reply.pack(done)] if done else []

    def _move(self) -> None:
        self.number, self.moves_to = self.moves_to or self.number, 0


unit = Unit(SimulatedAmplifier("pymodbus", channels=4), UNIT)


def check_unit(number: int) -> None:
    """Raise the exception for which the server does not respond unless a unit is there."""
    if number != unit.number:
        raise NoSuchIdException(f"no unit {number}")


class ReadInput(ReadInputRegistersRequest):
    """Function 4."""

    answer: type[ModbusPDU] = ReadInputRegistersResponse

    async def datastore_update(self, context: ModbusServerContext, device_id: int) -> ModbusPDU:
        """Return the response."""
        check_unit(device_id)
        found = unit.read(self.address, self.count)
        if isinstance(found, ExcCodes):
            return ExceptionResponse(self.function_code, found)
        return self.answer(registers=found)


class ReadHolding(ReadInput):
    """Function 3, which reads the same registers."""

    function_code = ReadHoldingRegistersRequest.function_code
    answer = ReadHoldingRegistersResponse


class Write(WriteMultipleRegistersRequest):
    """Function 16."""

    async def datastore_update(self, context: ModbusServerContext, device_id: int) -> ModbusPDU:
        """Return the response."""
        is_broadcast = self.dev_id == 0 and unit.is_rtu
        if not is_broadcast:
            check_unit(device_id)
        fits = self.byte_count == 2 * self.count and len(self.registers) == self.count
        code: ExcCodes | None = ExcCodes.ILLEGAL_VALUE
        if fits and self.count in _COUNTS:
            code = unit.write(self.address, [*self.registers], is_broadcast=is_broadcast)
        if code is not None:
            return ExceptionResponse(self.function_code, code)
        return WriteMultipleRegistersResponse(address=self.address, count=self.count)


async def serve(kind: str, port: str, parity: str = "E") -> None:
    """Serve the amplifier on a TCP port of this machine or on a serial port until it is ended."""
    device = [SimDevice(UNIT, SimData(0, datatype=DataType.REGISTERS, values=0))]  # not used
    requests: list[type[ModbusPDU]] = [ReadInput, ReadHolding, Write]
    server: ModbusTcpServer | ModbusSerialServer
    if kind == "tcp":
        place = ("127.0.0.1", int(port))
        server = ModbusTcpServer(
            device, address=place, custom_pdu=requests, ignore_missing_devices=True
        )
    else:
        unit.is_rtu = True
        server = ModbusSerialServer(
            device,
            framer=FramerType.RTU,
            port=port,
            baudrate=BAUD,
            parity=parity,
            broadcast_enable=True,
            custom_pdu=requests,
            ignore_missing_devices=True,
        )
    known = [each.function_code for each in requests]  # others have exception 1
    server.decoder.pdu_table = {each: server.decoder.pdu_table[each] for each in known}
    await server.serve_forever(background=True)
    if isinstance(server.transport, asyncio.Server):
        port = str(server.transport.sockets[0].getsockname()[1])
    url = f"modbus+rtu://{port}?baud={BAUD}#{UNIT}"
    print(f"modbus+tcp://127.0.0.1:{port}/{UNIT}" if kind == "tcp" else url, flush=True)
    while True:
        unit.amplifier.tick(threads.now())
        await asyncio.sleep(STEP)


if __name__ == "__main__":
    asyncio.run(serve(*sys.argv[1:]))
