"""Latency of a stop on a busy wire: from the call to the last byte of the Stop on the wire.

Sets and heartbeats are sent without a pause, and a stop is called at random moments. The time when
the port was given the frame is measured; how long the wire transmits it is added by its length,
since the system takes a frame at once.
"""

import asyncio
import contextlib
import itertools
import random
from collections.abc import Awaitable, Callable, Mapping, Sequence

from benchmarks.wires.bench import CALM, armed, layer
from drivers import clock
from drivers.errors import CommandRefused
from drivers.host.line import Line

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
_STOP_WORDS = 1


async def stop_latencies(url: str, count: int = STOPS) -> list[float]:
    """Return the latency [s] of each of a number of stops."""
    async with armed([url]) as group:
        (amplifier,) = group.amplifiers.values()
        sent_at = _note_stops(amplifier.line)
        transit = amplifier.line.wire.transit(_STOP_WORDS)
        numbers, pauses, latencies = itertools.count(1), random.Random(15), []

        async def play() -> None:
            number = next(numbers)
            await amplifier.stage(number & 0xFFFF, [layer(number)], now=True)

        busy = [asyncio.create_task(_repeat(call)) for call in (play, amplifier.ping)]
        try:
            await amplifier.stop()
            for session in range(1, count + 1):
                await amplifier.clear()
                await amplifier.arm(session, CALM)
                await asyncio.sleep(pauses.uniform(0.0, 0.05))
                sent_at.clear()
                begin = clock.now()
                await amplifier.stop()
                latencies.append(sent_at[0] - begin + transit)
        finally:
            for task in busy:
                task.cancel()
            await asyncio.gather(*busy, return_exceptions=True)
    return latencies


def _note_stops(line: Line) -> list[float]:
    """Note when each Stop was given to the port [s]."""
    sent_at: list[float] = []
    write, request = line._port.write, line.wire.request
    names: list[str] = []

    def made(address: int, name: str, values: dict[str, object]) -> bytes:
        names[:] = [name]
        return request(address, name, values)

    def noted(data: bytes) -> None:
        write(data)
        if names == ["Stop"]:
            sent_at.append(clock.now())

    line.wire.request, line._port.write = made, noted  # type: ignore[method-assign]
    return sent_at


async def _repeat(call: Callable[[], Awaitable[object]]) -> None:
    while True:
        with contextlib.suppress(CommandRefused):
            await call()
        await asyncio.sleep(0)
