"""`era daemon` as a process with faults: paused, starved, killed, without room on disk.

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
from pathlib import Path

import httpx
import pytest

from controller.sources.touch import Touch, TouchFrame
from examples.make_touches import tuio_datagram
from kills import PLACES as KILLED_AT
from kills import kill_everywhere
from kit.fingers import free_port, panel
from processes import patient_daemon
from processes.daemons import (
    PATIENCE,
    REACTION,
    WATCHDOG,
    Journal,
    armed,
    daemon_process,
    disarmed,
    far_end,
    holding,
    loudness,
    play,
    playing_daemon,
    plays_on,
    ready,
    silent_from,
    until,
    until_state,
)
from sim.faults import FaultWindow


@pytest.mark.real_time
async def test_dashboard_process_ends_with_killed_daemon(tmp_path: Path) -> None:
    """`--dashboard` prints the address of the page."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    def serves() -> bool:
        with socket.socket() as client:
            return client.connect_ex(("127.0.0.1", port)) == 0

    async def page(path: str) -> str:
        url = f"http://127.0.0.1:{port}{path}"
        return (await asyncio.to_thread(httpx.get, url, timeout=PATIENCE)).text

    async with far_end(tmp_path) as far:
        options = ("--dashboard", f"127.0.0.1:{port}")
        async with daemon_process(tmp_path, far, options=options) as daemon:
            line = await asyncio.wait_for(daemon.process.stdout.readline(), PATIENCE)
            assert line.decode().startswith(f"dashboard: http://127.0.0.1:{port}/")
            await until(serves)
            assert "<html" in await page("/")
            while "era_up 1.0" not in (metrics := await page("/metrics")):
                assert "era_up 0.0" in metrics  # not connected to the daemon yet
            daemon.process.kill()
            await daemon.process.wait()
            await until(lambda: not serves())


def limited(pid: int, resource_id: int, limit: int) -> tuple[int, int]:
    """Set a soft limit of a running process; return the previous limits."""
    return resource.prlimit(pid, resource_id, (limit, resource.prlimit(pid, resource_id)[1]))


def numbers_in(folder: str) -> list[int]:
    """What /proc lists there: threads or open descriptors of a process."""
    return [int(path.name) for path in Path(folder).iterdir()]


@pytest.mark.real_time
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
                    sender.sendto(b"the last one", ("127.0.0.1", port))  # will be rejected
            resumed = time.monotonic()
            os.kill(daemon.process.pid, signal.SIGCONT)
            await until_state(era, "FAULT")
            await ready(era)
            async with asyncio.timeout(PATIENCE):
                status = await era.status()
                # Until all queued touches have been read, and their contacts have expired.
                while status.contacts or not status.rejected_touches:
                    await asyncio.sleep(0.05)
                    status = await era.status()
            await armed(era)
            await journal.hear(10)
            accepted = [entry for entry in journal.raising_since(resumed) if not entry.is_refused]
            assert accepted == []
            assert loudness(far) == 0


@pytest.mark.real_time
async def test_daemon_loses_only_log_lines_when_disk_is_full(tmp_path: Path) -> None:
    """It plays on, stops at a fault and can be armed again.

    Once there is space, the log continues.
    """
    log = "log: {file: era.log}\n"
    async with playing_daemon(tmp_path, log, waits=False) as (daemon, era, journal):
        pid, far = daemon.process.pid, daemon.far
        limits = limited(pid, resource.RLIMIT_FSIZE, 0)
        size = (tmp_path / "era.log").stat().st_size
        assert size > 0
        await plays_on("disk full", daemon, era, journal)
        far.device.inject_fault(FaultWindow(fault="arc"))
        await until_state(era, "FAULT")
        assert loudness(far) == 0
        far.device.recover()
        os.kill(pid, signal.SIGHUP)
        await plays_on("disk full, after a fault", daemon, era, journal)
        assert (tmp_path / "era.log").stat().st_size == size
        resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)
        await disarmed(era)
        await until(lambda: (tmp_path / "era.log").stat().st_size > size)


@pytest.mark.long
@pytest.mark.real_time
@pytest.mark.alone
async def test_daemon_replays_nothing_when_starved(tmp_path: Path) -> None:
    """At low priority beside four busy processes the last finger lifts: silence follows."""
    processor = max(os.sched_getaffinity(0))
    busy = f"import os; os.sched_setaffinity(0, {{{processor}}})\nwhile True: pass"
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era:
            with contextlib.ExitStack() as starving:
                async with holding(era):
                    await play(era, far)
                    for thread in numbers_in(f"/proc/{daemon.process.pid}/task"):
                        os.sched_setaffinity(thread, {processor})
                        os.setpriority(os.PRIO_PROCESS, thread, 10)  # at 19 none is served
                    for _ in range(4):
                        process = await asyncio.create_subprocess_exec(sys.executable, "-c", busy)
                        starving.callback(process.kill)
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


KILLS = 8  # `make kill-test` takes two hundred


@pytest.mark.real_time
async def test_channels_are_silent_in_time_when_daemon_is_killed() -> None:
    """At most 255 ms after the last sign of life by the amplifier's own clock, and for good.

    SIGKILL while starting, armed, playing or stopping; nothing arrives but what was on the wire,
    and the next daemon at the same amplifiers requires an acknowledgement, then plays.
    """
    kills = await kill_everywhere(KILLS, seed=4, serial=1 / 3)
    assert len(kills) == KILLS
    assert {kill.wire for kill in kills} == {name for name, _, _ in KILLED_AT}
    assert [kill for kill in kills if not kill.is_good] == []
    # The test is void unless many were energised, and some of them audibly.
    energised_kills = [kill for kill in kills if kill.energised > 0]
    assert len(energised_kills) >= KILLS // 3
    assert max(kill.level for kill in kills) > 0
