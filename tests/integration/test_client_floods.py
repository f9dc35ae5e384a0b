"""Clients that flood a daemon or read nothing: it plays on, and can be stopped."""

import asyncio
import contextlib
from pathlib import Path

import pytest

from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from processes.daemons import (
    PATIENCE,
    DaemonProcess,
    daemon_process,
    far_end,
    loudness,
    play,
    playing_daemon,
    plays_on,
    run_era,
)
from processes.daemons import until as until_seen
from processes.floods import flood

MAX_GROWTH = 64  # MiB; 32 clients with 256 KiB each to read, and as much to parse, are less


def resident(pid: int) -> float:
    """Return the resident memory of a process [MiB]."""
    with open(f"/proc/{pid}/statm", encoding="ascii") as stream:  # noqa: PTH123
        return int(stream.read().split()[1]) * 4096 / 2**20


async def stop_by_new_client(daemon: DaemonProcess) -> None:
    """Connect a new client and stop the daemon by it."""
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                async with await daemon.client() as new_client:
                    await new_client.stop()
                    break
            except (RpcError, Unreachable, ConnectionError):  # too many clients
                await asyncio.sleep(0.05)
    await until_seen(lambda: loudness(daemon.far) == 0)


@pytest.mark.long
@pytest.mark.alone
async def test_daemon_plays_on_with_idle_and_unreading_clients(tmp_path: Path) -> None:
    """With 2000 idle and 10 unreading ones memory is bounded, and a new client can stop it."""
    async with playing_daemon(tmp_path) as (daemon, era, journal):
        memory = resident(daemon.process.pid)
        async with (
            flood("unreading", daemon.socket, 10),
            flood("idle", daemon.socket, 2000) as idle,
        ):
            await plays_on("clients connecting", daemon, era, journal)
            assert int(await asyncio.wait_for(idle.stdout.readline(), 3 * PATIENCE)) == 2000
            await plays_on("2000 idle, 10 unreading", daemon, era, journal)
            await stop_by_new_client(daemon)
            assert resident(daemon.process.pid) - memory < MAX_GROWTH
        await play(era, daemon.far)


@pytest.mark.long
@pytest.mark.alone
async def test_stops_are_served_while_clients_connect_again_and_again(tmp_path: Path) -> None:
    """Of 25 new clients each, beside 2000 connections in a second, and of the command."""
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far) as daemon:
        async with flood("again", daemon.socket, 200):
            served = 0
            for _ in range(25):
                with contextlib.suppress(RpcError, Unreachable):
                    async with await daemon.client() as era:
                        await era.stop()
                        served += 1
            status, _, problem = await run_era("stop", "--socket", daemon.socket)
        assert (served, status, problem) == (25, 0, "")


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("kind", ["garbage", "asking"])
async def test_daemon_plays_on_when_clients_flood(tmp_path: Path, kind: str) -> None:
    """With malformed or endless requests any client can stop it, and the log stays short."""
    async with playing_daemon(tmp_path) as (daemon, era, journal):
        memory = resident(daemon.process.pid)
        async with flood(kind, daemon.socket, 4), flood(kind, daemon.socket, 5):
            await plays_on(f"clients flood: {kind}", daemon, era, journal)
            await stop_by_new_client(daemon)
        await play(era, daemon.far)
        assert resident(daemon.process.pid) - memory < MAX_GROWTH
        assert not daemon.has_logged("Traceback")
        assert not daemon.has_logged("no json")
        assert len(daemon.log) < 200  # invalid requests do not fill the disk
