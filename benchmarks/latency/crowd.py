"""Clients that crowd a daemon's socket, and what its holder and new clients get beside them.

The floods are those of the tests (tests/support/floods.py), each a process.
"""

import asyncio
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path

import numpy as np

from benchmarks.latency.machine import TIMEOUT, running
from benchmarks.latency.session import RESTING, UNANSWERED, Session
from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable

_FLOODS = Path(__file__).parents[2] / "tests" / "support" / "floods.py"
RECONNECTING = ("again", 200)
SLOW, MALFORMED, ASKING = ("unreading", 10), ("garbage", 1), ("asking", 5)
ALL = (SLOW, MALFORMED, ASKING, RECONNECTING)  # these last: they leave no place to others
_SETTLING = 1.0  # s


@asynccontextmanager
async def floods(path: Path, *kinds: tuple[str, int]) -> AsyncIterator[None]:
    """Flood the daemon at a socket while this lasts."""
    async with AsyncExitStack() as stack:
        for kind, count in kinds:
            command = (sys.executable, "-P", _FLOODS, kind, path, count)
            await stack.enter_async_context(running(*command))
        await asyncio.sleep(_SETTLING)
        yield


@asynccontextmanager
async def computing(count: int) -> AsyncIterator[None]:
    """Keep so many processors busy while this lasts."""
    async with AsyncExitStack() as stack:
        for _ in range(count):
            command = (sys.executable, "-c", "while True: sum(range(10_000))")
            await stack.enter_async_context(running(*command, has_line=False))
        yield


async def fresh_stops(session: Session, count: int) -> int:
    """Return how many of so many new clients were served a stop."""
    served = 0
    for _ in range(count):
        with suppress(RpcError, Unreachable):
            async with await AsyncClient.connect(session.socket, name="fresh") as era:
                await era.stop()
                served += 1
    return served


async def round_trips(session: Session, count: int) -> np.ndarray:
    """Return the times [s] of so many touches of the lease's holder, each until its response."""
    assert session.era is not None
    times = []
    for number in range(count):
        at = session.rig.plate.length * (0.3 + 0.4 * number / count), session.rig.plate.width / 2
        begun = time.monotonic()
        await session.era.touch([at])
        times.append(time.monotonic() - begun)
        await asyncio.sleep(0.01)
    return np.array(times)


async def stops(session: Session, count: int) -> np.ndarray:
    """Return the times [s] of so many stops beside a finger, from the request of the lease's holder
    to the last byte of the stop at the last amplifier; infinite for one that was not seen."""
    era, far, times = session.era, session.far, []
    assert era is not None
    async with AsyncExitStack() as armed:
        for _ in range(count):
            far.begin()
            session.touch(RESTING)
            await far.until(lambda: far.playing_since(1), UNANSWERED)
            begun = time.monotonic()
            stopping = asyncio.create_task(era.stop())
            stopped_at = await far.until(far.stopped_at, UNANSWERED)
            times.append(np.inf if stopped_at is None else stopped_at - begun)
            session.touch()
            await stopping
            await _clear(era)
            await armed.enter_async_context(era.armed("latency"))
    return np.array(times)


async def _clear(era: AsyncClient) -> None:
    """Clear a stop, once the daemon has done with it; raises TimeoutError."""
    async with asyncio.timeout(TIMEOUT):
        while True:
            with suppress(RpcError):
                return await era.clear()
            await asyncio.sleep(0.02)
