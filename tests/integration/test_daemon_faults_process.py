"""Disturbances of the daemon's process: paused, starved, without disk or descriptors, clock jumps.

Over a pseudo-terminal to a far end in the test's process, whose amplifier's clock is that of all.
Silence is asked for each time; that it plays on, where that is meant, only of the best of some
tries: a machine that others use can take the processor from the amplifier, too.
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
from best_of import best_of
from controller.api.async_client import AsyncClient
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import PATIENCE, far_end, until, until_state
from daemon_process import (
    REACTION,
    WATCHDOG,
    DaemonProcess,
    armed,
    daemon_process,
    disarmed,
    holding,
    play,
    plays_on,
    ready,
)
from drivers.protocol.messages import AmplifierState, Apply, Disarm, Fault, GetStatus
from journal import Journal, energised, loudness, silent_from
from model.rig.file import load_rig
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from tuio_panel import free_port, panel
from wires import WIRES, far_side

pytestmark = pytest.mark.alone


@asynccontextmanager
async def held(folder: Path, more: str = "", **options: object) -> AsyncIterator["Held"]:
    """A daemon that plays for a finger, and a journal of what its amplifier is asked."""
    async with far_end(folder) as far, daemon_process(folder, far, more, **options) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            yield Held(daemon, era, journal)


class Held:
    """What such a test needs."""

    def __init__(self, daemon: DaemonProcess, era: AsyncClient, journal: Journal) -> None:
        self.daemon, self.era, self.journal = daemon, era, journal
        self.far, self.pid = daemon.far, daemon.process.pid

    async def plays_on(self, what: str, *, seconds: float = 0.6) -> float:
        """The widest gap [s] between signs of life while it plays for a while."""
        return await plays_on(what, self.daemon, self.era, self.journal, seconds=seconds)

    def silent_in_time(self) -> bool:
        """Whether all was silent within the watchdog's time of the last sign of life."""
        fed = self.journal.last_fed("main")
        return silent_from(self.far) - fed <= WATCHDOG + REACTION + 1e-9


@asynccontextmanager
async def running(program: str) -> AsyncIterator[None]:
    """A Python program in a process of its own, killed with the context."""
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", program)
    try:
        yield
    finally:
        process.kill()
        await process.wait()


def threads(pid: int) -> list[int]:
    """Those of a process."""
    return [int(name) for name in os.listdir(f"/proc/{pid}/task")]  # noqa: PTH208


def limited(pid: int, what: int, limit: int) -> tuple[int, int]:
    """Set a running process a limit, which can be lifted again; the one before."""
    return resource.prlimit(pid, what, (limit, resource.prlimit(pid, what)[1]))


def descriptors(pid: int) -> list[int]:
    """Those that a process has open."""
    return [int(name) for name in os.listdir(f"/proc/{pid}/fd")]  # noqa: PTH208


async def test_paused_for_longer_than_the_watchdog_nothing_old_is_replayed(tmp_path: Path) -> None:
    """SIGSTOP: silent in time; resumed, not one set is sent, whatever has queued up meanwhile.

    Neither what was being played, nor the touches that came over UDP and the socket while none
    was read, nor after it was acknowledged and armed again: those fingers are gone.
    """
    port = free_port()
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far, panel(port)) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era:
            async with holding(era):
                await play(era, far)
                os.kill(daemon.process.pid, signal.SIGSTOP)
                await until(lambda: far.device.status().state is AmplifierState.FAULT)
                assert far.amplifier.fault is Fault.WATCHDOG
                fed = journal.last_fed("main")
                assert silent_from(far) - fed <= WATCHDOG + REACTION + 1e-9
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                    for number in range(50):
                        frame = TouchFrame("old", 0.0, (Touch(1, 0.01 * number, 0.5),))
                        sender.sendto(tuio_datagram(frame, -1), ("127.0.0.1", port))
            resumed = time.monotonic()
            os.kill(daemon.process.pid, signal.SIGCONT)
            await until_state(era, "FAULT")
            await ready(era)
            await journal.hear(5)  # for longer than any of those fingers stays without news
            await armed(era)
            await journal.hear(10)
            assert not journal.raising_since(resumed)
            assert loudness(far) == 0


async def test_paused_for_a_moment_a_finger_that_is_gone_is_not_felt(tmp_path: Path) -> None:
    """SIGSTOP for 120 ms, within which a finger comes and goes: nothing is ever played for it."""
    port = free_port()
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far, panel(port)) as daemon:
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


async def test_a_wall_clock_that_jumps_is_not_noticed(tmp_path: Path) -> None:
    """By a day, back, by less than a lease, by years: it plays on, and a lease lasts as it says."""
    program = (sys.executable, "-P", jumping_clock.__file__)
    environment = {"PYTHONPATH": str(Path(jumping_clock.__file__).parent)}
    async with held(tmp_path, program=program, environment=environment) as test:
        for jump in jumping_clock.JUMPS:
            begin = time.monotonic()
            os.kill(test.pid, signal.SIGUSR1)
            status = await test.era.status()
            assert status.unix_time_s - time.time() == pytest.approx(jump, abs=0.3)
            await test.plays_on(f"clock set by {jump:g} s", seconds=0.3)
            status = await test.era.status()
            assert status.lease_left_s is not None
            assert 0 < 60 - status.lease_left_s <= time.monotonic() - begin + 60
            assert not status.rejected_touches
        await disarmed(test.era)
        for _ in range(5):  # a machine that is busy may lose the link instead
            await ready(test.era)
            begin = time.monotonic()
            await test.era.arm("test", lease_s=1)
            os.kill(test.pid, signal.SIGUSR1)
            await until_state(test.era, "READY_TO_SWITCH_ON", "FAULT", "COMM_LOST")
            lasted = time.monotonic() - begin
            if (await test.era.status()).state == "READY_TO_SWITCH_ON":
                break
        assert 1.0 <= lasted < PATIENCE


async def test_a_full_disk_costs_log_lines_and_nothing_else(tmp_path: Path) -> None:
    """No file may grow any more: it plays on, stops at a fault, is cleared and armed again.

    Not even half a dump is left; once there is room, the log goes on.
    """
    more = "log: {file: era.log}\ndumps: {folder: dumps}\n"
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far, more, waits=False) as daemon:
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


async def test_a_starved_daemon_plays_on_or_is_silent_but_replays_nothing(tmp_path: Path) -> None:
    """The lowest priority on a processor that four others keep busy; its finger lifts meanwhile.

    Whatever came of it, silence came, and nothing is played for that finger afterwards.
    """
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
                        os.setpriority(os.PRIO_PROCESS, thread, 19)
                    for _ in range(4):
                        await starving.enter_async_context(running(busy))
                    await asyncio.sleep(1.0)
                await era.touch([])
                lifted = time.monotonic()
                await until(lambda: loudness(far) == 0)
                silent = time.monotonic()
            await until(lambda: len(journal.since(silent)) > 5)
            assert len(journal.raising_since(lifted)) <= 1  # which was under way
            assert not journal.raising_since(silent)
            if far.amplifier.fault is Fault.WATCHDOG:
                assert silent_from(far) - journal.last_fed("main") <= WATCHDOG + REACTION + 1e-9


async def test_without_descriptors_it_plays_on_and_is_stopped(tmp_path: Path) -> None:
    """None is left while armed, and clients queue up: it plays on, and a client stops it."""
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
        async with await test.daemon.client() as other:  # again, once there are some
            await other.stop()


async def test_hangups_in_a_loop_change_nothing(tmp_path: Path) -> None:
    """Two hundred SIGHUPs: it plays on, reads fewer times than it is asked to, and the last counts.

    What has changed just before the last one is taken over; no descriptor is left open.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        heard: list[bytes] = []

        def hear() -> None:
            said = manager.recv(4096)
            if said.startswith((b"READY", b"RELOADING")):
                heard.append(said)

        asyncio.get_running_loop().add_reader(manager, hear)
        async with held(tmp_path, environment=environment) as test:
            before = len(descriptors(test.pid))

            async def hang_up() -> None:
                for number in range(200):
                    if number == 199:
                        with (tmp_path / "daemon.yaml").open("a", encoding="utf-8") as file:
                            file.write("longest_lease: 5 s\n")
                    os.kill(test.pid, signal.SIGHUP)
                    await asyncio.sleep(0.001)

            hanging_up = asyncio.create_task(hang_up())
            await test.plays_on("200 SIGHUPs")
            await hanging_up
            await until(lambda: len(descriptors(test.pid)) <= before)
            quiet = False
            while not quiet:  # the last reading is over
                seen = len(heard)
                await asyncio.sleep(0.5)
                quiet = seen == len(heard) and heard[-1].startswith(b"READY")
            await disarmed(test.era)
            await armed(test.era)
            lasts = (await test.era.status()).lease_left_s
            assert lasts is not None
            assert lasts <= 5
        asyncio.get_running_loop().remove_reader(manager)
    assert 1 <= sum(b"RELOADING=1" in each for each in heard) <= 100


@pytest.mark.parametrize(
    ("number", "changes"), [(signal.SIGTERM, ()), (signal.SIGINT, TWO_AMPLIFIERS)]
)
async def test_told_to_end_it_ramps_down_reads_back_and_disarms(
    tmp_path: Path, number: signal.Signals, changes: Sequence[tuple[str, str]]
) -> None:
    """SIGTERM while playing: zero along 50 ms, read back, high voltage off; exit 0 within 1 s."""
    rig = load_rig(write_rig(tmp_path / "bench.yaml", *changes))

    async def attempt() -> float:
        async with far_side(Wire("serial"), rig) as far:
            journal = Journal(far)
            async with daemon_process(tmp_path, far, changes=changes) as daemon:
                async with await daemon.client() as era, holding(era):
                    await play(era, far)
                    begin = time.monotonic()
                    daemon.process.send_signal(number)
                    assert await daemon.status() == 0
                    took = time.monotonic() - begin
                assert not daemon.socket.exists()
                assert daemon.said("OPERATION_ENABLED -> NOT_READY")
                assert not daemon.said("no json")
            for name in far.devices:
                asked = [entry for entry in journal.since(begin) if entry.amplifier == name]
                ends = [entry for entry in asked if isinstance(entry.request, Apply)]
                end = ends[-1]
                assert not end.raises
                assert end.request.command_set.ramp == pytest.approx(0.050)
                after = [entry for entry in asked if entry.time >= end.time][1:]
                assert isinstance(after[0].request, GetStatus)
                silent = next(entry for entry in after if not any(entry.levels))
                assert isinstance(silent.request, GetStatus)  # it was read back before disarming
                assert isinstance(after[-1].request, Disarm)
                assert far.devices[name].status().state is AmplifierState.SWITCH_ON_DISABLED
            return took

    await best_of(f"from {number.name} to the exit", attempt, 1.0)


async def test_told_to_end_over_a_dead_link_it_ends_all_the_same(tmp_path: Path) -> None:
    """The amplifier hangs: exit within 1 s, and the amplifier silences itself in time."""

    async def attempt() -> float:
        async with held(tmp_path) as test:
            test.far.device.inject_fault(FaultWindow("hang"))
            begin = time.monotonic()
            test.daemon.process.send_signal(signal.SIGTERM)
            await test.daemon.status()
            took = time.monotonic() - begin
            await until(lambda: not energised(test.far))
            assert test.silent_in_time()
            return took

    await best_of("from SIGTERM to the exit, amplifier hung", attempt, 1.0)


@pytest.mark.parametrize("wire", ["serial", "modbus+tcp", "can+slcan"])  # links alone: all
async def test_a_cut_cable_is_told_in_time(tmp_path: Path, wire: str) -> None:
    """Clients hear COMM_LOST within three heartbeats of the cut; the amplifier is silent in time.

    Plugged in again the daemon finds it by itself, and stays disarmed.
    """
    rig = load_rig(write_rig(tmp_path / "bench.yaml"))
    async with far_side(WIRES[wire], rig) as far, daemon_process(tmp_path, far) as daemon:
        journal = Journal(far)
        async with await daemon.client() as era, holding(era):

            async def attempt() -> float:
                await play(era, far)
                await era.subscribe("state")
                cut = time.monotonic()
                far.device.inject_fault(FaultWindow("unplug"))
                async with asyncio.timeout(20):
                    async for told in era.events():
                        if told.topic == "state" and told.data["new"] == "COMM_LOST":
                            break
                await era.unsubscribe("state")
                await until(lambda: not energised(far))
                assert silent_from(far) - journal.last_fed("main") <= WATCHDOG + REACTION + 1e-9
                far.device.recover()
                await until_state(era, "FAULT")
                assert loudness(far) == 0
                return told.time - cut

            await best_of(f"from the cut to COMM_LOST at a client, {wire}", attempt, 0.150)
