"""Datagrams that arrive while the event loop is busy."""

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
    """Sends datagrams while the loop is busy; returns them with their reported arrival.

    pause [s]: after each of them.
    """
    received: asyncio.Queue[tuple[bytes, float]] = asyncio.Queue()

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        assert peer == sender.getsockname()
        received.put_nowait((data, arrived))

    async def send(*datagrams: bytes, pause: float = 0.0) -> list[tuple[bytes, float]]:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", line.port))
            time.sleep(pause)  # noqa: ASYNC251  the loop is to be busy
        async with asyncio.timeout(60):
            return [await received.get() for _ in datagrams]

    line = await listen("127.0.0.1", 0, feed, max_size=100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        try:
            yield send
        finally:
            line.close()


async def until_stamped(send: Send) -> None:
    """Wait until the system timestamps datagrams.

    Linux begins some time after the first socket requested it; until then they have the time at
    which they are read.
    """
    loop = asyncio.get_running_loop()
    async with asyncio.timeout(60):
        while True:
            begin = loop.time()
            ((_, arrived),) = await send(b"0", pause=PAUSE)
            if arrived < begin + PAUSE / 2:
                return


@pytest.mark.skipif(sys.platform != "linux", reason="timestamps of Linux")
async def test_datagrams_have_their_time_of_arrival() -> None:
    """However late they are read, arrivals are as far apart as they were sent, and in the past."""
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


async def test_oversized_datagram_is_cut_to_one_byte_more() -> None:
    """The receiver sees by its size that it was cut."""
    async with receiving() as send:
        (short, _), (long, _) = await send(bytes(100), bytes(150))
    assert (len(short), len(long)) == (100, 101)


async def test_receiver_may_close_within_its_callback() -> None:
    """Datagrams that arrived after that one are not handed on."""
    received: list[bytes] = []
    lines: list[Datagrams] = []
    done = asyncio.Event()

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        received.append(data)
        lines[0].close()
        done.set()

    lines.append(await listen("127.0.0.1", 0, feed, max_size=100))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (b"1", b"2"):
            sender.sendto(datagram, ("127.0.0.1", lines[0].port))
    async with asyncio.timeout(60):
        await done.wait()
    await asyncio.sleep(0)
    assert received == [b"1"]


async def test_datagrams_have_the_time_of_reading_when_the_clock_was_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock that jumps by an hour between arrival and reading does not make touches old."""
    loop = asyncio.get_running_loop()
    begin = loop.time()
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + 3600)
    async with receiving() as send:
        ((_, arrived),) = await send(b"1", pause=PAUSE)
    assert begin + 0.9 * PAUSE < arrived <= loop.time()
