"""Touches that flood, make no sense or never end, over UDP to the whole daemon."""

import asyncio
import json
import math
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from best_of import best_of
from controller.api.async_client import AsyncClient
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import PATIENCE, far_end, until
from daemon_process import DaemonProcess, armed, daemon_process, disarmed, play
from floods import flood
from journal import Journal, loudness, silent_from
from tuio_panel import free_port, panel

pytestmark = pytest.mark.alone

UP_TO_ZERO = 0.020  # s; from the last finger up to zero on the wire
LEASE = 0.150  # s; without news a finger counts as lifted


class Panel:
    """A daemon with a TUIO panel, and a sender to it."""

    def __init__(self, daemon: DaemonProcess, era: AsyncClient, port: int) -> None:
        self.daemon, self.era, self.far = daemon, era, daemon.far
        self.port = port
        self.journal = Journal(daemon.far)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def close(self) -> None:
        """Send no more."""
        self._socket.close()

    def say(self, *touches: Touch, source: str = "panel") -> float:
        """All fingers of a source; when [s] that was."""
        now = time.monotonic()
        datagram = tuio_datagram(TouchFrame(source, 0.0, touches), -1)
        self._socket.sendto(datagram, ("127.0.0.1", self.port))
        return now

    async def silence(self) -> float:
        """When [s] all was silent, once it is."""
        await until(lambda: loudness(self.far) == 0)
        return silent_from(self.far)

    async def counted(self, **expected: int) -> None:
        """Wait until so many touches were rejected, by the reason."""
        end = time.monotonic() + PATIENCE
        while (seen := dict((await self.era.status()).rejected_touches)) != expected:
            assert time.monotonic() < end, seen
            await asyncio.sleep(0.01)

    async def played(self, touch: Touch) -> None:
        """Armed, and a finger down until it is felt."""
        down = asyncio.create_task(self._keep(touch))
        try:
            await play(self.era, self.far)
        finally:
            down.cancel()
            await asyncio.gather(down, return_exceptions=True)

    async def _keep(self, touch: Touch) -> None:
        while True:
            self.say(touch)
            await asyncio.sleep(0.02)


@asynccontextmanager
async def touched(folder: Path) -> AsyncIterator[Panel]:
    """A daemon whose panel is ours."""
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


async def test_ten_thousand_touches_a_second_and_the_last_finger_up(tmp_path: Path) -> None:
    """Up to three fingers that jump about at 10 kHz: lifted, there is zero on the wire in 20 ms.

    Few of them become sets, for the newest counts; after the last none plays any more.
    """
    async with touched(tmp_path) as test:

        async def attempt() -> float:
            await armed(test.era)
            begin = time.monotonic()
            async with flood("tuio", test.port, 10_000, 1.0) as sender:
                assert sender.stdout is not None
                told = json.loads(await sender.stdout.readline())
            silent = await test.silence()
            await test.journal.hear(5)
            assert loudness(test.far) == 0
            assert len(test.journal.raising_since(begin)) < told["sent"] / 10
            await disarmed(test.era)
            return silent - float(told["up_s"])

        await best_of("from the last finger up to zero on the wire, at 10 kHz", attempt, UP_TO_ZERO)


async def test_the_last_finger_up_is_zero_on_the_wire(tmp_path: Path) -> None:
    """Without any flood: within 20 ms of the datagram."""
    async with touched(tmp_path) as test:

        async def attempt() -> float:
            await test.played(Touch(1, 0.4, 0.5))
            return -test.say() + await test.silence()

        await best_of("from the last finger up to zero on the wire", attempt, UP_TO_ZERO)


async def test_a_finger_that_is_never_lifted_is_lifted_by_its_lease(tmp_path: Path) -> None:
    """Its sender is gone: zero on the wire 150 ms and those 20 ms after it was last heard."""
    async with touched(tmp_path) as test:

        async def attempt() -> float:
            await test.played(Touch(1, 0.4, 0.5))
            last = test.say(Touch(1, 0.41, 0.5))
            silent = await test.silence()
            return silent - last if silent - last > LEASE - UP_TO_ZERO else -1.0

        await best_of("from the last word of a finger to zero", attempt, LEASE + UP_TO_ZERO)


async def test_touches_that_make_no_sense_are_counted_and_not_felt(tmp_path: Path) -> None:
    """Not a number, infinite, off the plate, one id twice, more than ten: nothing for any of them.

    A good finger beside them is felt, and ended by a place that is none.
    """
    async with touched(tmp_path) as test:
        await armed(test.era)
        begin = time.monotonic()
        nonsense = [math.nan, math.inf, -math.inf, 1.0001, -0.0001, 1e30]
        for x in nonsense:
            test.say(Touch(1, x, 0.5), Touch(2, 0.5, x))

        await test.counted(not_finite=6, off_plate=6)
        assert not test.journal.raising_since(begin)
        assert not (await test.era.status()).contacts
        test.say(*(Touch(id, 0.05 + 0.06 * id, 0.5) for id in range(14)))
        await test.counted(not_finite=6, off_plate=6, too_many=4)
        test.say()
        await test.silence()
        await test.played(Touch(1, 0.4, 0.5))
        test.say(Touch(1, math.nan, 0.5))
        await test.silence()
        await test.counted(not_finite=7, off_plate=6, too_many=4)
