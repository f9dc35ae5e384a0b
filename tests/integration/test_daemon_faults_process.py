"""Faults of the daemon's process: paused, starved, no disk space or descriptors, clock jumps.

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
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

import jumping_clock
import patient_daemon
from controller.api.async_client import AsyncClient
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import PATIENCE, READY, far_end, holding, until, until_state
from daemon_process import (
    ERA,
    REACTION,
    WATCHDOG,
    DaemonProcess,
    armed,
    daemon_process,
    disarmed,
    play,
    plays_on,
    ready,
    tell,
)
from journal import Journal, energised, loudness, silent_from
from model.rig.file import load_rig
from rig_files import TWO_AMPLIFIERS, write_rig
from rig_on_wire import far_side
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from tuio_panel import free_port, panel

pytestmark = pytest.mark.real_time


@asynccontextmanager
async def held(
    folder: Path,
    more: str = "",
    *,
    program: Sequence[str] = patient_daemon.PROGRAM,
) -> AsyncIterator["Held"]:
    """A daemon that plays for a finger, and a journal of its amplifier's requests."""
    async with (
        far_end(folder) as far,
        daemon_process(folder, far, more, program=program) as daemon,
    ):
        journal = Journal(far)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            yield Held(daemon, era, journal)


class Held:
    """A playing daemon with client and journal."""

    def __init__(self, daemon: DaemonProcess, era: AsyncClient, journal: Journal) -> None:
        self.daemon, self.era, self.journal = daemon, era, journal
        self.far, self.pid = daemon.far, daemon.process.pid

    async def plays_on(self, what: str, *, seconds: float = 0.6) -> None:
        """Assert that it plays on, and tell the widest gap between signs of life."""
        await plays_on(what, self.daemon, self.era, self.journal, seconds=seconds)

    def silent_in_time(self) -> bool:
        """Whether all was silent within the watchdog time after the last sign of life."""
        fed = self.journal.last_fed("main")
        return silent_from(self.far) - fed <= WATCHDOG + REACTION + 1e-9


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


async def test_daemon_plays_nothing_for_touch_during_short_pause(tmp_path: Path) -> None:
    """SIGSTOP for 120 ms, within which a finger comes and goes."""
    port = free_port()
    program = patient_daemon.PROGRAM
    async with (
        far_end(tmp_path) as far,
        daemon_process(tmp_path, far, panel(port), program=program) as daemon,
    ):
        journal = Journal(far)
        async with await daemon.client() as era:
            await armed(era)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                begin = time.monotonic()
                os.kill(daemon.process.pid, signal.SIGSTOP)
                for touches in ((Touch(1, 0.4, 0.5),), ()):
                    frame = TouchFrame("brief", 0.0, touches)
                    sender.sendto(tuio_datagram(frame, -1), ("127.0.0.1", port))
                    await asyncio.sleep(0.06)
                os.kill(daemon.process.pid, signal.SIGCONT)
            await until(lambda: len(journal.since(begin)) > 5)
            assert not journal.raising_since(begin)


async def test_daemon_ignores_jumps_of_wall_clock(tmp_path: Path) -> None:
    """By a day, back, by less than a lease, by years: it plays on, and leases keep their time."""
    async with held(tmp_path, program=(sys.executable, jumping_clock.__file__)) as test:
        for jump in jumping_clock.JUMPS:
            begin, before = time.monotonic(), time.time()
            os.kill(test.pid, signal.SIGVTALRM)
            status = await test.era.status()
            assert before - 0.01 <= status.unix_time_s - jump <= time.time() + 0.01
            await test.plays_on(f"clock set by {jump:g} s", seconds=0.3)
            status = await test.era.status()
            assert status.lease_left_s is not None
            assert 0 < 60 - status.lease_left_s <= time.monotonic() - begin + 60
            assert not status.rejected_touches
        await disarmed(test.era)
        begin = time.monotonic()
        await test.era.arm("test", lease_s=1)
        os.kill(test.pid, signal.SIGVTALRM)
        await until_state(test.era, READY)
        lasted = time.monotonic() - begin
        assert 1.0 <= lasted < PATIENCE


async def test_daemon_loses_only_log_lines_when_disk_is_full(tmp_path: Path) -> None:
    """It plays on, stops at a fault and can be armed again; no partial dump is left.

    Once there is space, the log continues.
    """
    more = "log: {file: era.log}\ndumps: {folder: dumps}\n"
    program = patient_daemon.PROGRAM
    async with (
        far_end(tmp_path) as far,
        daemon_process(tmp_path, far, more, program=program, waits=False) as daemon,
    ):
        await until(lambda: (tmp_path / "era.sock").is_socket())
        pid, journal = daemon.process.pid, Journal(far)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            before = limited(pid, resource.RLIMIT_FSIZE, 0)
            size = (tmp_path / "era.log").stat().st_size
            assert size > 0
            await plays_on("disk full", daemon, era, journal)
            far.device.inject_fault(FaultWindow("arc"))
            await until_state(era, "FAULT")
            assert loudness(far) == 0
            far.device.recover()
            os.kill(pid, signal.SIGHUP)
            await plays_on("disk full, after a fault", daemon, era, journal)
            assert (tmp_path / "era.log").stat().st_size == size
            assert not list((tmp_path / "dumps").glob("*"))
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
    async with held(tmp_path, "dumps: {folder: dumps}\n") as test:
        limit = max(descriptors(test.pid)) + 1
        before = limited(test.pid, resource.RLIMIT_NOFILE, limit)
        waiting = []
        try:
            for _ in range(40):
                waiting.append(socket.socket(socket.AF_UNIX))
                waiting[-1].connect(str(test.daemon.socket))
            os.kill(test.pid, signal.SIGHUP)
            await test.plays_on("no descriptors left")
            await test.era.stop()
            stopped = time.monotonic()
            await until(lambda: loudness(test.far) == 0)
            assert not test.journal.raising_since(stopped)
            await ready(test.era)
        finally:
            resource.prlimit(test.pid, resource.RLIMIT_NOFILE, before)
            for each in waiting:
                each.close()
        await test.plays_on("descriptors again")
        async with await test.daemon.client() as other:
            await other.stop()


@pytest.mark.parametrize(
    ("number", "changes"), [(signal.SIGTERM, ()), (signal.SIGINT, TWO_AMPLIFIERS)]
)
async def test_daemon_ramps_down_reads_back_and_disarms_when_terminated(
    tmp_path: Path, number: signal.Signals, changes: Sequence[tuple[str, str]]
) -> None:
    """While playing: zero along 50 ms, read back, high voltage off; exit status 0 within 1 s."""
    rig = load_rig(write_rig(tmp_path / "bench.yaml", *changes))

    async with far_side(Wire("serial"), rig) as far:
        journal = Journal(far)
        async with daemon_process(tmp_path, far, changes=changes) as daemon:
            async with await daemon.client() as era, holding(era):
                await play(era, far)
                begin = time.monotonic()
                daemon.process.send_signal(number)
                assert await daemon.status() == 0
                tell(f"from {number.name} to the exit", time.monotonic() - begin)
            assert not daemon.socket.exists()
            assert daemon.has_logged("OPERATION_ENABLED -> NOT_READY")
            assert not daemon.has_logged("no json")
        for name in far.devices:
            requests = [entry for entry in journal.since(begin) if entry.amplifier == name]
            end = next(entry for entry in requests if entry.name == "Disarm")
            assert end.values["ramp"] == 50
            after = [entry for entry in requests if entry.time > end.time]
            assert {entry.name for entry in after} == {"GetStatus"}
            assert not any(after[-1].levels)  # read back until it is silent
            assert far.summary(name).state == "SWITCH_ON_DISABLED"


async def test_daemon_exits_when_terminated_over_dead_link(tmp_path: Path) -> None:
    """It does not wait for a hung amplifier, which silences itself in time."""
    async with held(tmp_path, program=(ERA,)) as test:
        test.far.device.inject_fault(FaultWindow("hang"))
        begin = time.monotonic()
        test.daemon.process.send_signal(signal.SIGTERM)
        await test.daemon.status()
        tell("from SIGTERM to the exit, amplifier hung", time.monotonic() - begin)
        await until(lambda: not energised(test.far))
        assert test.silent_in_time()
