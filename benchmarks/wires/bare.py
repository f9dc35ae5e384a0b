"""The bare library of each wire doing the exchange of an apply, nothing around it.

Each takes the URL of a simulated amplifier that is armed and requests that are encoded already, and
gives the time of each exchange [s].
"""

import asyncio
import time
from collections.abc import Sequence

import serial
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient

from benchmarks.wires.bench import SESSION
from drivers.codec.modbus import exchanges
from drivers.codec.serial_line.exchanges import encode_request
from drivers.codec.serial_line.frame import encode_frame
from drivers.guard import SafeCommandSet
from drivers.protocol.messages import Apply, Arm, Request
from drivers.urls.modbus import ModbusUrl
from drivers.urls.serial_line import SerialUrl


def bare_serial(url: str, sets: Sequence[SafeCommandSet]) -> list[float]:
    """pyserial: write the frame, read until the zero that ends the reply."""
    parsed = SerialUrl.parse(url)
    requests = [
        encode_frame(encode_request(Apply(safe, SESSION), address=1, sequence=number & 0xFFFF))
        for number, safe in enumerate(sets)
    ]
    arm = encode_frame(encode_request(Arm(2.0, SESSION), address=1, sequence=0))
    times = []
    with serial.Serial(parsed.port, parsed.baud, timeout=1, exclusive=True) as port:
        _exchange(port, arm)
        while port.in_waiting:  # the event of having been armed
            port.read(port.in_waiting)
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


def bare_modbus(url: str, sets: Sequence[SafeCommandSet]) -> list[float]:
    """pymodbus's own client: write the block and read what was achieved, function 23."""
    return asyncio.run(_with_pymodbus(ModbusUrl.parse(url), sets))


async def _with_pymodbus(url: ModbusUrl, sets: Sequence[SafeCommandSet]) -> list[float]:
    client = (
        AsyncModbusSerialClient(url.device, baudrate=url.baud, timeout=1)
        if url.device
        else AsyncModbusTcpClient(url.host, port=url.port, timeout=1)
    )
    await client.connect()

    async def ask(request: Request, tag: int) -> None:
        exchange = exchanges.encode_request(request, tag=tag, channels=4)
        assert exchange.write is not None
        words = list(exchange.write.registers)
        begin = time.perf_counter()
        await client.readwrite_registers(
            read_address=exchange.read.address,
            read_count=exchange.read.count,
            write_address=exchange.write.address,
            values=words,
            device_id=url.unit,
        )
        times.append(time.perf_counter() - begin)

    times: list[float] = []
    await ask(Arm(2.0, SESSION), 1)
    for number, safe in enumerate(sets):
        await ask(Apply(safe, SESSION), number % 65535 + 1)
    client.close()
    return times[1:]
