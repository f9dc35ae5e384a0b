"""Latency of a stop on a busy wire: from the call to the last byte of the Stop on the wire.

Sets and heartbeats are sent without a pause, and a stop is called at random moments. The time when
the system took the last byte is measured; how long a line of known speed transmits the frame is
added by its length, since the system takes a frame at once.
"""

import asyncio
import contextlib
import random
from collections.abc import Awaitable, Callable, Mapping, Sequence
from itertools import cycle

from benchmarks.wires.bench import CALM, make_sets
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.codec.can_bus.canopen import BLOCK
from drivers.codec.can_bus.timing import CanTimes
from drivers.codec.modbus import exchanges
from drivers.codec.modbus.adu import build_adu
from drivers.codec.modbus.timing import ModbusTimes
from drivers.codec.serial_line.exchanges import encode_request
from drivers.codec.serial_line.frame import encode_frame
from drivers.errors import CommandRefused
from drivers.protocol.messages import Reply, Request, Stop
from drivers.registry import open_backend
from drivers.urls.modbus import ModbusUrl
from drivers.urls.serial_line import SerialUrl

STOPS = 200
WIRES: Mapping[str, Sequence[str]] = {
    "serial, 921 600 baud": ["--serial", "--speed", "921600"],
    "serial, 115 200 baud": ["--serial", "--speed", "115200"],
    "Modbus RTU, 115 200 baud": ["--modbus-rtu", "--speed", "115200"],
    "Modbus RTU, 19 200 baud": ["--modbus-rtu", "--speed", "19200"],
    "Modbus TCP": ["--modbus-tcp", "0"],
    "CAN, slcan, 500 kbit/s": ["--slcan", "--speed", "500000"],
    "CAN, socketcand": ["--socketcand", "0"],
}
_STOP = Stop(0.0)


def stop_duration(url: str) -> float:
    """Return how long the wire of a URL transmits a Stop [s]; 0 on a network."""
    if url.startswith("serial"):
        frame = encode_frame(encode_request(_STOP, address=1, sequence=1))
        return len(frame) * 10 / SerialUrl.parse(url).baud
    if url.startswith("modbus+rtu"):
        line = ModbusUrl.parse(url)
        exchange = exchanges.encode_request(_STOP, tag=1, channels=4)
        adu = build_adu(exchange.read, exchange.write, unit=1, transaction=0, is_rtu=True)
        return ModbusTimes(line.baud, line.bits_per_byte).of(len(adu.frame))
    times = open_backend(url).wire_times
    return times.frame(BLOCK) if isinstance(times, CanTimes) and "slcan" in url else 0.0


async def stop_latencies(url: str, count: int = STOPS) -> list[float]:
    """Return the latency [s] of each of a number of stops."""
    backend = open_backend(url)
    sent_at = _note_stops(backend)
    amplifier = Amplifier(backend, reply_timeout=1.0)  # a busy machine is late and loses nothing
    await amplifier.open()
    sets = cycle(make_sets(amplifier.capabilities, 1000))
    duration, pauses, latencies = stop_duration(url), random.Random(15), []
    busy = [
        asyncio.create_task(_repeat(call))
        for call in (lambda: amplifier.apply(next(sets)), amplifier.heartbeat)
    ]
    for _ in range(count):
        await _until_accepted(amplifier.clear)
        await _until_accepted(lambda: amplifier.arm(CALM))
        await asyncio.sleep(pauses.uniform(0.0, 0.05))
        sent_at.clear()
        begin = clock.now()
        await amplifier.stop(0.0)
        latencies.append(sent_at[0] - begin + duration)
    for task in busy:
        task.cancel()
    await asyncio.gather(*busy, return_exceptions=True)
    await amplifier.close()
    return latencies


def _note_stops(backend: Backend) -> list[float]:
    """Note when each Stop was sent [s]."""
    sent_at: list[float] = []
    exchange = backend.exchange

    async def noting(request: Request, *, timeout: float) -> Reply:
        try:
            return await exchange(request, timeout=timeout)
        finally:
            if isinstance(request, Stop):
                sent_at.append(backend.last_sent_at)

    backend.exchange = noting  # type: ignore[method-assign]
    return sent_at


async def _repeat(call: Callable[[], Awaitable[object]]) -> None:
    while True:
        with contextlib.suppress(CommandRefused):
            await call()
        await asyncio.sleep(0)


async def _until_accepted(call: Callable[[], Awaitable[object]]) -> None:
    while True:
        try:
            await call()
        except CommandRefused:
            await asyncio.sleep(0.001)
        else:
            return
