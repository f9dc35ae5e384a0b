"""Signals and the service manager of a daemon, and jumps of the wall clock, in virtual time."""

import contextlib
import os
import signal
import socket
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.api.client import AsyncClient
from controller.play.intent import NO_CONTACTS
from controller.play.layer_contents import BEING_CHOSEN
from controller.play.selection import GIVEN_UP
from daemons import (
    ENABLED,
    READY,
    Journal,
    daemon_at,
    energised,
    far_end,
    holding,
    ready_daemon,
    silent_from,
    until,
    until_state,
)
from drivers.host.amplifier import WATCHDOG
from plates import TWO_AMPLIFIERS
from registry import threads
from several_fingers import answers_take
from sim.faults import FaultWindow
from virtual_lines import in_virtual_time

JUMPS = (86_400.0, -86_400.0, 0.4, -0.4, 3e8, -1.7e9, 0.0)
"""How far [s] the wall clock is from the real one: days, less than a lease, decades."""


@in_virtual_time
async def test_daemon_ignores_jumps_of_wall_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a day, back, by less than a lease, by years: it plays on, and leases keep their time."""
    real = time.time
    async with ready_daemon(tmp_path) as (bench, era):
        await era.arm("test", lease_s=3)
        armed = threads.now()
        async with holding(era, far=bench.far):
            for jump in JUMPS:
                monkeypatch.setattr(time, "time", lambda jump=jump: real() + jump)
                status = await era.status()
                assert status.unix_time_s == pytest.approx(real() + jump, abs=60)
                renewed = threads.now()
                await until(lambda renewed=renewed: threads.now() > renewed + 0.3)
                assert any(bench.far.summary().levels)
            status = await era.status()
            assert not status.rejected_touches
            assert status.lease_left_s == pytest.approx(armed + 3 - threads.now(), abs=0.01)
            await until_state(era, READY)
            assert threads.now() - armed == pytest.approx(3, abs=0.1)


@pytest.mark.parametrize(
    ("number", "changes"), [(signal.SIGTERM, ()), (signal.SIGINT, TWO_AMPLIFIERS)]
)
@in_virtual_time
async def test_daemon_ramps_down_reads_back_and_disarms_when_terminated(
    tmp_path: Path, number: signal.Signals, changes: Sequence[tuple[str, str]]
) -> None:
    """While playing: zero along 50 ms, read back, high voltage off; ended within 1 s."""
    async with (
        far_end(tmp_path, changes=changes) as far,
        daemon_at(far, tmp_path, changes=changes) as bench,
        await bench.client() as era,
    ):
        journal = Journal(far)
        await until_state(era, READY)
        await era.arm("test", lease_s=60)
        async with holding(era, far=far):
            begin = threads.now()
            os.kill(os.getpid(), number)
            await until(bench.running.done)
        assert threads.now() - begin < 1
        for name in far.devices:
            requests = [entry for entry in journal.since(begin) if entry.amplifier == name]
            end = next(entry for entry in requests if entry.name == "Disarm")
            assert end.values["ramp"] == 50
            after = [entry for entry in requests if entry.time > end.time]
            assert {entry.name for entry in after} == {"GetStatus"}
            assert not any(after[-1].levels)  # read back until it is silent
            assert far.summary(name).state == "SWITCH_ON_DISABLED"


@in_virtual_time
async def test_daemon_ends_when_terminated_over_dead_link(tmp_path: Path) -> None:
    """It does not wait for a hung amplifier, which silences itself in time."""
    async with ready_daemon(tmp_path) as (bench, era):
        journal = Journal(bench.far)
        await era.arm("test", lease_s=60)
        assert await until_state(era, ENABLED)
        async with holding(era, far=bench.far):
            bench.far.device.inject_fault(FaultWindow(fault="hang"))
            begin = threads.now()
            bench.daemon.shut_down("end of the test")
            await until(bench.running.done)
        assert threads.now() - begin < 1
        await until(lambda: not energised(bench.far))
        assert silent_from(bench.far) - journal.last_fed("main") <= WATCHDOG + 0.005 + 1e-9


@in_virtual_time
async def test_daemon_notifies_systemd(tmp_path: Path) -> None:
    """READY=1, WATCHDOG=1, RELOADING=1 and STOPPING=1."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
        heard: list[str] = []

        def has_heard(text: str) -> bool:
            with contextlib.suppress(BlockingIOError):
                while True:
                    heard.append(manager.recv(4096).decode())
            return any(text in message for message in heard)

        async with ready_daemon(tmp_path, environment=environment) as (bench, _):
            for text in ("READY=1", "WATCHDOG=1", "STATUS=ready: "):
                await until(lambda text=text: has_heard(text))
            os.kill(os.getpid(), signal.SIGHUP)
            await until(lambda: has_heard("RELOADING=1\nMONOTONIC_USEC="))
            os.kill(os.getpid(), signal.SIGTERM)
            await until(bench.running.done)
            assert has_heard("STOPPING=1")


LEFT, RIGHT = (0.08, 0.1), (0.22, 0.1)
_HALF = "{rectangle: {start: [%s m, 0 m], end: [%s m, 0.2 m]}, on_press: %s}"
_LAYOUT = f"regions: {{west: {_HALF % (0, 0.15, 'buzz')}, east: {_HALF % (0.15, 0.3, '%s')}}}\n"


async def said(era: AsyncClient) -> set[str | None]:
    """Why fingers feel nothing; the status says the same where nothing plays though it is armed."""
    status = await era.status()
    reasons = {each.held_back for each in status.contacts}
    if status.state == ENABLED:
        assert {status.silence_reason} == reasons
    return reasons


@in_virtual_time
async def test_a_daemon_goes_on_while_answers_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every reason is the present one; a stop is at once, and the end within a second."""
    layout = tmp_path / "layout.yaml"
    layout.write_text(_LAYOUT % "buzz", "utf-8")
    async with ready_daemon(tmp_path, "layouts: {panel: layout.yaml}\n") as (bench, era):
        asked = answers_take(monkeypatch, 1e6)
        async with holding(era, LEFT, RIGHT):
            await until(lambda: bench.daemon._controller.cycle.tracker.contacts)
            assert await said(era) == {"ready: arm first (era arm)"}
            await era.arm("test", lease_s=60)
            await until(lambda: asked)
            assert await said(era) == {BEING_CHOSEN}
            begin = threads.now()
            await until(lambda: threads.now() > begin + 1.1)
            assert await said(era) == {GIVEN_UP}
            begin = threads.now()
            await era.stop()
            assert threads.now() - begin < 0.05
            assert await said(era) == {"stopped: clear (era clear), then arm again"}
            layout.write_text(_LAYOUT % "click", "utf-8")
            os.kill(os.getpid(), signal.SIGHUP)
            await until(lambda: bench.daemon._layouts.player.layout.regions[1].on_press == "click")
            await era.clear()
            await until_state(era, READY)
            await era.arm("test", lease_s=60)
            assert len(asked) == 1
        await until(lambda: not bench.daemon._controller.cycle.tracker.contacts)
        await until(lambda: not any(bench.far.summary().levels))
        assert (await era.status()).silence_reason == NO_CONTACTS
        async with holding(era, LEFT, far=bench.far):  # one alone needs no thread
            assert await said(era) == {None}
        layout.write_text(_LAYOUT % "buzz", "utf-8")
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: bench.daemon._layouts.player.layout.regions[1].on_press == "buzz")
        async with holding(era, LEFT, RIGHT):
            await until(lambda: len(asked) == 2)
            begin = threads.now()
            os.kill(os.getpid(), signal.SIGTERM)
            await until(bench.running.done)
            assert threads.now() - begin < 1
