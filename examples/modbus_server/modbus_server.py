"""Serve an amplifier of protocol 4 with pymodbus, over TCP or a serial port.

    python examples/modbus_server/modbus_server.py tcp 5020
    python examples/modbus_server/modbus_server.py rtu /dev/ttyUSB0 [N, for no parity]

pymodbus handles frames and connections. `Unit` implements the registers of
docs/reference/modbus.md on top of the project's simulated amplifier. Replace the simulated
amplifier by your own, which receives the values of a message and returns the values of its reply,
or raises Refusal. Requires pymodbus 3.16; its server classes change between minor versions.
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

UNIT = 1
BAUD = 115_200
STEP = 0.001  # s; interval of watchdog checks
_COUNTS = range(1, 124)  # registers per write


class Unit:
    """Registers of an amplifier: the host writes a message, then reads its reply."""

    def __init__(self, amplifier: SimulatedAmplifier, number: int) -> None:
        self.amplifier = amplifier
        self.number = number
        self.is_rtu = False  # in RTU, number 0 is a broadcast
        self.new_number = 0  # set by SetAddress, effective after its reply
        self._replies: dict[int, tuple[int, ...]] = {}  # tag, result and words by message

    def write(self, address: int, words: list[int], *, is_broadcast: bool) -> ExcCodes | None:
        """Execute a written message; return an exception code if the registers hold none."""
        number, offset = divmod(address, BOX)
        if offset or number not in BY_NUMBER or len(words) > MAX_WORDS + 1:
            return ExcCodes.ILLEGAL_ADDRESS
        message = BY_NUMBER[number]
        if is_broadcast and not message.is_broadcast:
            return None
        result, reply = self._execute(message, words[1:])
        if is_broadcast and not result:
            self.amplifier.withdraw_status()
        if not is_broadcast:
            self._replies[number] = words[0], result, *reply
        if message.name == "SetAddress" and result == 0:
            self.new_number = words[1]
            if is_broadcast:
                self._move()
        return None

    def read(self, address: int, count: int) -> list[int] | ExcCodes:
        """Return registers of a reply or of the identity."""
        number, offset = divmod(address, BOX)
        is_reply = offset >= REPLY_OFFSET and number in BY_NUMBER
        if is_reply:
            first = number * BOX + REPLY_OFFSET
            area = self._reply(BY_NUMBER[number])
        else:
            first = IDENTITY_REGISTER
            area = list(pack_identity(self.amplifier.identity))
        if not first <= address <= address + count <= first + len(area):
            return ExcCodes.ILLEGAL_ADDRESS
        if is_reply and BY_NUMBER[number].name == "SetAddress":
            asyncio.get_running_loop().call_later(STEP, self._move)  # after the response
        start = address - first
        return area[start : start + count]

    def _reply(self, message: Message) -> list[int]:
        tag, result, *words = self._replies.get(message.number, (0, 0))
        if message.name in PRESENT and result:  # a refusal is read once
            self._replies[message.number] = tag, 0
        elif message.name in PRESENT:
            result, words = self._execute(message, [])
        registers = [tag, result, *words]
        return registers + [0] * (AREA - len(registers))

    def _execute(self, message: Message, words: list[int]) -> tuple[int, list[int]]:
        """Execute a message; return its result code and the words of its reply."""
        try:
            name, values = decode_request(message.number, words)
            reply = self.amplifier.handle(name, values, threads.now())
        except Refusal as refusal:
            if is_earlier_part(message.number, words):
                return 0, []
            _, code, channel = nak_of(refusal, message.number)
            return code << 8 | channel, []
        return 0, list(message.reply.pack(reply)) if reply else []

    def _move(self) -> None:
        if self.new_number:
            self.number = self.new_number
        self.new_number = 0


unit = Unit(SimulatedAmplifier("pymodbus", channels=4), UNIT)


def check_unit(number: int) -> None:
    """Raise NoSuchIdException, which prevents a response, unless the number is the unit's."""
    if number != unit.number:
        raise NoSuchIdException(f"no unit {number}")


class ReadInput(ReadInputRegistersRequest):
    """Function code 4."""

    response: type[ModbusPDU] = ReadInputRegistersResponse

    async def datastore_update(self, context: ModbusServerContext, device_id: int) -> ModbusPDU:
        """Return the response."""
        check_unit(device_id)
        registers = unit.read(self.address, self.count)
        if isinstance(registers, ExcCodes):
            return ExceptionResponse(self.function_code, registers)
        return self.response(registers=registers)


class ReadHolding(ReadInput):
    """Function code 3, which reads the same registers."""

    function_code = ReadHoldingRegistersRequest.function_code
    response = ReadHoldingRegistersResponse


class Write(WriteMultipleRegistersRequest):
    """Function code 16."""

    async def datastore_update(self, context: ModbusServerContext, device_id: int) -> ModbusPDU:
        """Return the response."""
        is_broadcast = self.dev_id == 0 and unit.is_rtu
        if not is_broadcast:
            check_unit(device_id)
        is_complete = self.byte_count == 2 * self.count and len(self.registers) == self.count
        code: ExcCodes | None = ExcCodes.ILLEGAL_VALUE
        if is_complete and self.count in _COUNTS:
            code = unit.write(self.address, [*self.registers], is_broadcast=is_broadcast)
        if code is not None:
            return ExceptionResponse(self.function_code, code)
        return WriteMultipleRegistersResponse(address=self.address, count=self.count)


async def serve(kind: str, port: str, parity: str = "E") -> None:
    """Serve the amplifier on a local TCP port or a serial port until the process ends."""
    device = [SimDevice(UNIT, SimData(0, datatype=DataType.REGISTERS, values=0))]  # not used
    requests: list[type[ModbusPDU]] = [ReadInput, ReadHolding, Write]
    server: ModbusTcpServer | ModbusSerialServer
    if kind == "tcp":
        server = ModbusTcpServer(
            device,
            address=("127.0.0.1", int(port)),
            custom_pdu=requests,
            ignore_missing_devices=True,
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
    codes = [request.function_code for request in requests]
    table = server.decoder.pdu_table
    server.decoder.pdu_table = {code: table[code] for code in codes}  # exception 1 for the others
    await server.serve_forever(background=True)
    url = f"modbus+rtu://{port}?baud={BAUD}#{UNIT}"
    if isinstance(server.transport, asyncio.Server):
        port = str(server.transport.sockets[0].getsockname()[1])
        url = f"modbus+tcp://127.0.0.1:{port}/{UNIT}"
    print(url, flush=True)
    while True:
        unit.amplifier.tick(threads.now())
        await asyncio.sleep(STEP)


if __name__ == "__main__":
    asyncio.run(serve(*sys.argv[1:]))
