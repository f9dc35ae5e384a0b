"""The bare library of each wire doing the exchange of a set, nothing around it.

Each takes the URL of a simulated amplifier and the values of Set messages, encodes all of them
before, arms, and gives the time of each exchange [s].
"""

import asyncio
import time
from collections.abc import Sequence

import can
import serial
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient

from benchmarks.wires.bench import arm_values
from drivers.codec.can_bus.segments import REPLY, frames_of, unpack_frames
from drivers.host.can_wire import CanWire
from drivers.host.serial_wire import SerialWire
from drivers.protocol.records import Values
from drivers.protocol.table import MESSAGES
from drivers.wires.can_bus import SlcanAddress, SocketcandAddress
from drivers.wires.modbus import ModbusAddress
from drivers.wires.serial_line import SerialAddress

_BOX, _REPLY_AT = 256, 128  # registers of a message, and from there to its reply
_REPLY_HEAD = 2  # tag, result


def bare_serial(url: str, sets: Sequence[Values]) -> list[float]:
    """pyserial: write the frame, read until the zero that ends the reply."""
    place = SerialAddress(url).place
    wire = SerialWire(place.baud, sequence=0)
    arm = wire.request(1, "Arm", arm_values())
    requests = [wire.request(1, "Set", values) for values in sets]
    times = []
    with serial.Serial(place.device, place.baud, timeout=1, exclusive=True) as port:
        _exchange(port, arm)
        time.sleep(0.1)  # until the event of having been armed has come
        port.reset_input_buffer()
        for request in requests:
            begin = time.perf_counter()
            _exchange(port, request)
            times.append(time.perf_counter() - begin)
    return times


def _exchange(port: serial.Serial, request: bytes) -> None:
    port.write(request)
    ends = 0
    while ends < 2:  # one zero in front, one behind
        ends += port.read(max(1, port.in_waiting)).count(0)


def bare_modbus(url: str, sets: Sequence[Values]) -> list[float]:
    """pymodbus's own client: write the message, then read its reply."""
    return asyncio.run(_with_pymodbus(ModbusAddress(url), sets))


async def _with_pymodbus(address: ModbusAddress, sets: Sequence[Values]) -> list[float]:
    place = address.place
    client = (
        AsyncModbusSerialClient(place.device, baudrate=place.baud, timeout=1)
        if place.device
        else AsyncModbusTcpClient(place.host, port=place.port, timeout=1)
    )
    await client.connect()
    times: list[float] = []

    async def ask(name: str, tag: int, values: Values, count: int) -> None:
        message = MESSAGES[name]
        words = [tag, *message.request.pack(values)]
        begin = time.perf_counter()
        await client.write_registers(message.number * _BOX, words, device_id=address.number)
        reply = await client.read_holding_registers(
            message.number * _BOX + _REPLY_AT, count=_REPLY_HEAD + count, device_id=address.number
        )
        times.append(time.perf_counter() - begin)
        assert reply.registers[:_REPLY_HEAD] == [tag, 0]

    await ask("Arm", 1, arm_values(), 1)
    for number, values in enumerate(sets):
        await ask("Set", number % 65534 + 2, values, len(MESSAGES["Set"].reply.fields))
    client.close()
    return times[1:]


def bare_can(url: str, sets: Sequence[Values]) -> list[float]:
    """python-can: send the frames of a set, receive until its reply is whole."""
    is_slcan = url.startswith("can+slcan")
    parsed = SlcanAddress(url) if is_slcan else SocketcandAddress(url)
    wire = CanWire(parsed.bitrate, sequence=0)

    def made(name: str, values: Values) -> list[can.Message]:
        frames = unpack_frames(wire.request(parsed.number, name, values))
        return [
            can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
            for frame in frames
        ]

    hello, arm = made("Hello", {}), made("Arm", arm_values())
    requests = [made("Set", values) for values in sets]
    times = []
    with _open(parsed) as bus:
        for first in (hello, arm):
            _carry(bus, first, parsed.number)
        for request in requests:
            begin = time.perf_counter()
            _carry(bus, request, parsed.number)
            times.append(time.perf_counter() - begin)
    return times


def _carry(bus: can.BusABC, request: Sequence[can.Message], node: int) -> None:
    for message in request:
        bus.send(message)
    left: int | None = None
    while left != 0:
        received = bus.recv(1.0)
        assert received is not None
        data = received.data
        if received.arbitration_id == REPLY + node and data[0] == request[-1].data[0]:
            left = frames_of(data[3]) - 1 if data[1] == 0 else (left or 0) - 1


def _open(address: SlcanAddress | SocketcandAddress) -> can.BusABC:
    place = address.place
    if isinstance(address, SlcanAddress):
        return can.Bus(
            interface="slcan",
            channel=place.device,
            bitrate=address.bitrate,
            sleep_after_open=0,
            ignore_config=True,
        )
    return can.Bus(
        interface="socketcand",
        channel=address.channel,
        host=place.host,
        port=place.port,
        tcp_tune=True,
        ignore_config=True,
    )
