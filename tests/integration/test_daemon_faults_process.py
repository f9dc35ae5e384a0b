"""Faults of the daemon's process: paused, starved, no disk space or descriptors.

The far end runs in the test's process with the same clock, by which silence must be in time.
"""

import asyncio
import contextlib
import os
import resource
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

import patient_daemon
from controller.sources.touch import Touch, TouchFrame
from daemon_bench import far_end, holding, until, until_state
from daemon_process import (
    REACTION,
    WATCHDOG,
    Journal,
    armed,
    daemon_process,
    disarmed,
    loudness,
    play,
    playing_daemon,
    plays_on,
    ready,
    silent_from,
)
from examples.make_touches import tuio_datagram
from sim.faults.fault_window import FaultWindow
from tuio_messages import free_port, panel

pytestmark = pytest.mark.real_time


@asynccontextmanager
async def running(program: str) -> AsyncIterator[None]:
    """Run a Python program as a process until the context ends."""
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", program)
    try:
        yield
    finally:
        process.kill()
        await process.wait()


def threads(pid: int) -> list[int]:
    """Return the thread ids of a process."""
    return [int(name) for name in os.listdir(f"/proc/{pid}/task")]  # noqa: PTH208


def limited(pid: int, what: int, limit: int) -> tuple[int, int]:
    """Set a soft limit of a running process; return the previous limits."""
    return resource.prlimit(pid, what, (limit, resource.prlimit(pid, what)[1]))


def descriptors(pid: int) -> list[int]:
    """Return the open descriptors of a process."""
    return [int(name) for name in os.listdir(f"/proc/{pid}/fd")]  # noqa: PTH208


async def test_daemon_replays_nothing_when_paused_longer_than_watchdog(tmp_path: Path) -> None:
    """SIGSTOP: silent in time; resumed it plays no set, not even after clear and arm.

    Neither the previous pattern nor one for touches that were queued meanwhile: the amplifier
    refuses what is sent before its fault has been read.
    """
    port = free_port()
    program = patient_daemon.PROGRAM
    async with (
        far_end(tmp_path) as far,
        daemon_process(tmp_path, far, panel(port), program=program) as daemon,
    ):
        journal = Journal(far)
        async with await daemon.client() as era:
            async with holding(era):
                await play(era, far)
                os.kill(daemon.process.pid, signal.SIGSTOP)
                await until(lambda: far.summary().state == "FAULT")
                assert far.amplifier.fault == "WATCHDOG"
                fed = journal.last_fed("main")
                assert silent_from(far) - fed <= patient_daemon.WATCHDOG + REACTION + 1e-9
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                    for number in range(50):
                        frame = TouchFrame("old", 0.0, (Touch(1, 0.01 * number, 0.5),))
                        sender.sendto(tuio_datagram(frame, -1), ("127.0.0.1", port))
            resumed = time.monotonic()
            os.kill(daemon.process.pid, signal.SIGCONT)
            await until_state(era, "FAULT")
            await ready(era)
            await journal.hear(5)  # longer than the timeout of those contacts
            await armed(era)
            await journal.hear(10)
            sent = journal.raising_since(resumed)
            assert all(entry.is_refused for entry in sent), sent
            assert loudness(far) == 0


async def test_daemon_loses_only_log_lines_when_disk_is_full(tmp_path: Path) -> None:
    """It plays on, stops at a fault and can be armed again; no partial dump is left.

    Once there is space, the log continues.
    """
    more = "log: {file: era.log}\ndumps: {folder: dumps}\n"
    async with playing_daemon(tmp_path, more, waits=False) as (daemon, era, journal):
        pid, far = daemon.process.pid, daemon.far
        before = limited(pid, resource.RLIMIT_FSIZE, 0)
        size = (tmp_path / "era.log").stat().st_size
        dumps = {*(tmp_path / "dumps").glob("*")}  # of a reply lost before, on a busy machine
        assert size > 0
        await plays_on("disk full", daemon, era, journal)
        far.device.inject_fault(FaultWindow("arc"))
        await until_state(era, "FAULT")
        assert loudness(far) == 0
        far.device.recover()
        os.kill(pid, signal.SIGHUP)
        await plays_on("disk full, after a fault", daemon, era, journal)
        assert (tmp_path / "era.log").stat().st_size == size
        assert not {*(tmp_path / "dumps").glob("*")} - dumps
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
        await disarmed(era)
        await until(lambda: (tmp_path / "era.log").stat().st_size > size)


@pytest.mark.alone
async def test_daemon_replays_nothing_when_starved(tmp_path: Path) -> None:
    """At low priority beside four busy processes the last finger lifts: silence follows."""
    processor = max(os.sched_getaffinity(0))
    busy = f"import os; os.sched_setaffinity(0, {{{processor}}})\nwhile True: pass"
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era:
            async with contextlib.AsyncExitStack() as starving:
                async with holding(era):
                    await play(era, far)
                    for thread in threads(daemon.process.pid):
                        os.sched_setaffinity(thread, {processor})
                        os.setpriority(os.PRIO_PROCESS, thread, 10)  # at 19 none is served
                    for _ in range(4):
                        await starving.enter_async_context(running(busy))
                    await asyncio.sleep(1.0)
                await era.touch([])
                lifted = time.monotonic()
                await until(lambda: loudness(far) == 0)
                silent = time.monotonic()
            await until(lambda: len(journal.since(silent)) > 5)
            assert len(journal.raising_since(lifted)) <= 1  # already under way
            assert not journal.raising_since(silent)
            if far.amplifier.fault == "WATCHDOG":
                assert silent_from(far) - journal.last_fed("main") <= WATCHDOG + REACTION + 1e-9


async def test_daemon_plays_on_and_stops_without_descriptors(tmp_path: Path) -> None:
    """A connected client stops it; with descriptors again, new clients connect."""
    more = "dumps: {folder: dumps}\n"
    async with playing_daemon(tmp_path, more) as (daemon, era, journal):
        pid = daemon.process.pid
        before = limited(pid, resource.RLIMIT_NOFILE, max(descriptors(pid)) + 1)
        waiting = []
        try:
            for _ in range(40):
                waiting.append(socket.socket(socket.AF_UNIX))
                waiting[-1].connect(str(daemon.socket))
            os.kill(pid, signal.SIGHUP)
            await plays_on("no descriptors left", daemon, era, journal)
            await era.stop()
            stopped = time.monotonic()
            await until(lambda: loudness(daemon.far) == 0)
            assert not journal.raising_since(stopped)
            await ready(era)
        finally:
            resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
            for each in waiting:
                each.close()
        await plays_on("descriptors again", daemon, era, journal)
        async with await daemon.client() as other:
            await other.stop()
