"""Datagrams that arrive while the event loop is busy: their times, their sizes, and floods."""

import asyncio
import math
import socket
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest

from controller.sources.tuio import TuioSource
from controller.sources.udp_source import BACKLOG_THRESHOLD, Datagrams, Peer, listen
from kit.fingers import frame

PAUSE = 0.02  # s
TIME_LIMIT = 60.0  # s

Received = tuple[bytes, float]
"""A datagram, and its reported time of arrival [s]."""


class BusyLoop:
    """Sends datagrams to a line of the loop while the loop is busy."""

    def __init__(self, line: Datagrams, sender: socket.socket) -> None:
        self.line = line
        self.sender = sender
        self.received: asyncio.Queue[Received] = asyncio.Queue()

    async def send(self, *datagrams: bytes, pause: float = 0.0) -> list[Received]:
        """Send datagrams with a pause after each [s]; return what was received."""
        for datagram in datagrams:
            self.sender.sendto(datagram, ("127.0.0.1", self.line.port))
            time.sleep(pause)  # noqa: ASYNC251  the loop is to be busy
        async with asyncio.timeout(TIME_LIMIT):
            return [await self.received.get() for _ in datagrams]


@asynccontextmanager
async def busy_loop() -> AsyncIterator[BusyLoop]:
    """A busy loop whose line takes 100 bytes."""

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        assert peer == sender.getsockname()
        loop.received.put_nowait((data, arrived))

    line = await listen("127.0.0.1", 0, feed, max_size=100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        loop = BusyLoop(line, sender)
        try:
            yield loop
        finally:
            line.close()


@pytest.mark.skipif(sys.platform != "linux", reason="timestamps of Linux")
async def test_datagrams_have_their_time_of_arrival() -> None:
    """However late they are read, arrivals are as far apart as they were sent, and in the past.

    Linux begins some time after the first socket requested it; until then they have the time at
    which they are read.
    """
    loop = asyncio.get_running_loop()
    async with busy_loop() as line, asyncio.timeout(TIME_LIMIT):
        arrival = math.inf
        while arrival >= loop.time() - PAUSE / 2:
            ((_, arrival),) = await line.send(b"0", pause=PAUSE)
        begin = loop.time()
        received = await line.send(b"1", b"2", b"3", pause=PAUSE)
    assert [data for data, _ in received] == [b"1", b"2", b"3"]
    arrivals = [arrived for _, arrived in received]
    assert arrivals[0] >= begin - 0.1 * PAUSE
    assert np.diff([*arrivals, loop.time()]).min() > 0.9 * PAUSE


async def test_datagrams_have_the_time_of_reading_when_the_clock_was_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock that jumps by an hour between arrival and reading does not make touches old."""
    loop = asyncio.get_running_loop()
    begin = loop.time()
    clock = time.time

    def clock_an_hour_later() -> float:
        return clock() + 3600

    monkeypatch.setattr(time, "time", clock_an_hour_later)
    async with busy_loop() as line:
        ((_, arrived),) = await line.send(b"1", pause=PAUSE)
    assert begin + 0.9 * PAUSE < arrived <= loop.time()


async def test_oversized_datagram_is_cut_to_one_byte_more() -> None:
    """The receiver sees by its size that it was cut."""
    async with busy_loop() as line:
        received = await line.send(bytes(100), bytes(150))
    assert [len(data) for data, _ in received] == [100, 101]


async def test_datagram_behind_a_failure_is_delivered(caplog: pytest.LogCaptureFixture) -> None:
    """After two failures of the callback, of which one is logged, the third datagram arrives."""
    received: asyncio.Queue[bytes] = asyncio.Queue()

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        if data == b"bad":
            raise OverflowError
        received.put_nowait(data)

    line = await listen("127.0.0.1", 0, feed, max_size=100)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in (b"bad", b"bad", b"good"):
            sender.sendto(data, ("127.0.0.1", line.port))
        async with asyncio.timeout(TIME_LIMIT):
            assert await received.get() == b"good"
    line.close()
    assert line.failures == 2
    assert caplog.text.count("dropped because of a bug") == 1


async def test_superseded_bundles_of_a_flood_are_dropped() -> None:
    """Of 200 frames that arrived while the loop was busy, a few and the newest are delivered."""
    received: list[bytes] = []
    is_over = asyncio.Event()
    lift = frame(source="a")

    def feed(data: bytes, peer: Peer, arrived: float) -> None:
        received.append(data)
        if data == lift:
            is_over.set()

    drop = TuioSource("tuio:").drop_superseded
    line = await listen("127.0.0.1", 0, feed, max_size=8192, drop_superseded=drop)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number in range(200):
            sender.sendto(frame((number, 0.5, 0.5), source="a"), ("127.0.0.1", line.port))
        sender.sendto(lift, ("127.0.0.1", line.port))
        async with asyncio.timeout(TIME_LIMIT):
            await is_over.wait()
    line.close()
    assert len(received) <= BACKLOG_THRESHOLD
    assert received[-1] == lift
