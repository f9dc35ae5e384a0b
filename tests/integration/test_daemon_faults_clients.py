"""Clients that are idle, do not read, ask without end or talk nonsense, beside fingers that play.

The bad ones are processes of their own. The bound of each is tested on the server alone, too; here
the whole daemon is held to it, and its control loop must not notice.
"""

import asyncio
from pathlib import Path

import pytest

from controller.api.client_protocol import Unreachable
from controller.api.jsonrpc import RpcError
from daemon_bench import PATIENCE, far_end, holding, until
from daemon_process import DaemonProcess, daemon_process, play, plays_on
from floods import flood
from journal import Journal, loudness

pytestmark = pytest.mark.alone

GROWTH = 64  # MiB; 32 clients with 256 KiB each to read, and as much to be parsed, are less


def resident(pid: int) -> float:
    """Memory of a process [MiB]."""
    with open(f"/proc/{pid}/statm", encoding="ascii") as stream:  # noqa: PTH123
        return int(stream.read().split()[1]) * 4096 / 2**20


async def stopped_by_somebody_else(daemon: DaemonProcess) -> None:
    """A new client gets a place, and its stop is done."""
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                async with await daemon.client() as other:
                    await other.stop()
                    break
            except (RpcError, Unreachable, ConnectionError):  # all places are taken
                await asyncio.sleep(0.05)
    await until(lambda: loudness(daemon.far) == 0)


async def test_two_thousand_idle_and_ten_that_do_not_read(tmp_path: Path) -> None:
    """It plays on without a gap, memory stays bounded, and a new client can still stop it."""
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            before = resident(daemon.process.pid)
            async with (
                flood("unreading", daemon.socket, 10),
                flood("idle", daemon.socket, 2000) as idle,
            ):
                await plays_on("clients pour in", daemon, era, journal)
                assert idle.stdout is not None
                line = await asyncio.wait_for(idle.stdout.readline(), 3 * PATIENCE)
                assert int(line) == 2000
                await plays_on("2000 idle, 10 unreading", daemon, era, journal)
                await stopped_by_somebody_else(daemon)
                assert resident(daemon.process.pid) - before < GROWTH
            await play(era, far)


@pytest.mark.parametrize("kind", ["garbage", "asking"])
async def test_clients_that_flood(tmp_path: Path, kind: str) -> None:
    """Nonsense of all kinds, or requests without end: it plays on, and any client can stop it."""
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            before = resident(daemon.process.pid)
            async with flood(kind, daemon.socket, 4), flood(kind, daemon.socket, 5):
                await plays_on(f"clients flood: {kind}", daemon, era, journal)
                await stopped_by_somebody_else(daemon)
            await play(era, far)
            assert resident(daemon.process.pid) - before < GROWTH
        assert not daemon.said("Traceback")
        assert not daemon.said("no json")
        assert len(daemon.log) < 200  # invalid requests do not fill the disk
