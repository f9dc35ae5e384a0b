"""Datagrams that arrive while the event loop does something else."""

import asyncio
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import TypeAlias

import pytest

from controller.sources.datagrams import Datagrams, Peer, listen

PAUSE = 0.02  # s


Send: TypeAlias = Callable[..., Awaitable[list[tuple[bytes, float]]]]


@asynccontextmanager
async def receiving() -> AsyncIterator[Send]:
    """Sends datagrams while the loop is busy, and gives them with when they are said to have come.

    pause [s]: after each of them.
    """
    received: asyncio.Queue[tuple[bytes, float]] = asyncio.Queue()

    def take(data: bytes, peer: Peer, arrived: float) -> None:
        assert peer == sender.getsockname()
        received.put_nowait((data, arrived))

    async def send(*datagrams: bytes, pause: float = 0.0) -> list[tuple[bytes, float]]:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", line.port))
            time.sleep(pause)  # noqa: ASYNC251  the loop is to be busy
        async with asyncio.timeout(20):
            return [await received.get() for _ in datagrams]

    line = await listen("127.0.0.1", 0, take, max_size=100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        try:
            yield send
        finally:
            line.close()


async def until_stamped(send: Send) -> None:
    """Wait until the system notes when datagrams come.

    Linux begins to do so some time after the first socket of all has asked for it; until then they
    have the time at which they are read.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(20):
        while True:
            begin = loop.time()
            ((_, arrived),) = await send(b"0", pause=PAUSE)
            if arrived < begin + PAUSE / 2:
                return


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not say when they came")
async def test_each_has_the_time_at_which_it_arrived() -> None:
    """However late the loop looks, they are as far apart as they were sent, and in the past."""
    loop = asyncio.get_running_loop()
    async with receiving() as send:
        await until_stamped(send)
        begin = loop.time()
        received = await send(b"1", b"2", b"3", pause=PAUSE)
    assert [data for data, _ in received] == [b"1", b"2", b"3"]
    times = [arrived for _, arrived in received]
    assert begin - 0.1 * PAUSE <= times[0]
    assert times[1] - times[0] > 0.9 * PAUSE
    assert times[2] - times[1] > 0.9 * PAUSE
    assert times[2] < loop.time() - 0.9 * PAUSE


async def test_one_that_is_too_long_is_known_by_its_length() -> None:
    """Of more than the largest exactly one byte more is handed on."""
    async with receiving() as send:
        (short, _), (long, _) = await send(bytes(100), bytes(150))
    assert (len(short), len(long)) == (100, 101)


async def test_whoever_receives_may_close() -> None:
    """What has arrived behind the datagram that closed the line is not handed on."""
    received: list[bytes] = []
    lines: list[Datagrams] = []
    done = asyncio.Event()

    def take(data: bytes, peer: Peer, arrived: float) -> None:
        received.append(data)
        lines[0].close()
        done.set()

    lines.append(await listen("127.0.0.1", 0, take, max_size=100))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (b"1", b"2"):
            sender.sendto(datagram, ("127.0.0.1", lines[0].port))
    async with asyncio.timeout(20):
        await done.wait()
    await asyncio.sleep(0)
    assert received == [b"1"]


async def test_a_system_clock_that_was_set_makes_nothing_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Between arrival and reading the clock jumped by an hour: it counts from when it is read."""
    loop = asyncio.get_running_loop()
    begin = loop.time()
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + 3600)
    async with receiving() as send:
        ((_, arrived),) = await send(b"1", pause=PAUSE)
    assert begin + 0.9 * PAUSE < arrived <= loop.time()
