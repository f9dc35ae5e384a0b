"""Touches that flood, are invalid or never end, over UDP to the whole daemon."""

import asyncio
import json
import math
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from controller.api.async_client import AsyncClient
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import PATIENCE, far_end, until
from daemon_process import DaemonProcess, armed, daemon_process, play
from floods import flood
from journal import Journal, loudness
from tuio_panel import free_port, panel

pytestmark = pytest.mark.real_time


class Panel:
    """A daemon with a TUIO panel, and a sender to it."""

    def __init__(self, daemon: DaemonProcess, era: AsyncClient, port: int) -> None:
        self.daemon, self.era, self.far = daemon, era, daemon.far
        self.port = port
        self.journal = Journal(daemon.far)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def close(self) -> None:
        """Close the sender."""
        self._socket.close()

    def send(self, *touches: Touch) -> None:
        """Send all touches of the panel."""
        datagram = tuio_datagram(TouchFrame("panel", 0.0, touches), -1)
        self._socket.sendto(datagram, ("127.0.0.1", self.port))

    async def silence(self) -> None:
        """Wait until all is silent."""
        await until(lambda: loudness(self.far) == 0)

    async def counted(self, **expected: int) -> None:
        """Wait for these counts of rejected touches by reason."""
        end = time.monotonic() + PATIENCE
        while (seen := dict((await self.era.status()).rejected_touches)) != expected:
            assert time.monotonic() < end, seen
            await asyncio.sleep(0.01)

    async def played(self, touch: Touch) -> None:
        """Arm, and hold a finger until the amplifier plays."""
        down = asyncio.create_task(self._keep(touch))
        try:
            await play(self.era, self.far)
        finally:
            down.cancel()
            await asyncio.gather(down, return_exceptions=True)

    async def _keep(self, touch: Touch) -> None:
        while True:
            self.send(touch)
            await asyncio.sleep(0.02)


@asynccontextmanager
async def touched(folder: Path) -> AsyncIterator[Panel]:
    """A daemon with a panel."""
    port = free_port()
    async with (
        far_end(folder) as far,
        daemon_process(folder, far, panel(port)) as daemon,
        await daemon.client() as era,
    ):
        made = Panel(daemon, era, port)
        try:
            yield made
        finally:
            made.close()


@pytest.mark.alone
async def test_few_of_a_flood_of_touches_become_sets(tmp_path: Path) -> None:
    """Of up to three fingers that jump at 10 kHz, fewer than a tenth; none after the last lift."""
    async with touched(tmp_path) as test:
        await armed(test.era)
        begin = time.monotonic()
        async with flood("tuio", test.port, 10_000, 1.0) as sender:
            assert sender.stdout is not None
            counts = json.loads(await sender.stdout.readline())
        await test.silence()
        silent = time.monotonic()
        await test.journal.hear(5)
        assert loudness(test.far) == 0
        assert not test.journal.raising_since(silent)
        assert len(test.journal.raising_since(begin)) < counts["sent"] / 10


async def test_invalid_touches_are_counted_and_not_played(tmp_path: Path) -> None:
    """NaN, infinite, off the plate, more than twenty; an invalid place ends a valid contact."""
    async with touched(tmp_path) as test:
        await armed(test.era)
        begin = time.monotonic()
        invalid = [math.nan, math.inf, -math.inf, 1.0001, -0.0001, 1e30]
        for x in invalid:
            test.send(Touch(1, x, 0.5), Touch(2, 0.5, x))

        await test.counted(not_finite=6, off_plate=6)
        assert not test.journal.raising_since(begin)
        assert not (await test.era.status()).contacts
        test.send(*(Touch(id, 0.02 + 0.04 * id, 0.5) for id in range(24)))
        await test.counted(not_finite=6, off_plate=6, too_many=4)
        test.send()
        await test.silence()
        await test.played(Touch(1, 0.4, 0.5))
        test.send(Touch(1, math.nan, 0.5))
        await test.silence()
        await test.counted(not_finite=7, off_plate=6, too_many=4)
