"""Chains of several programs: four amplifiers, pages after losses, demonstrations, the gateway.

Sixteen ERAs on four amplifiers play over wires in virtual time, with a table that has one pattern,
in which every ERA plays; the chain is started as a user does; a browser shows losses; and the
gateway is flooded and killed. The daemon below it has an amplifier that faults without a heartbeat
within its watchdog, the longest of the protocol, so that a control loop that stands still shows as
another state than OPERATION_ENABLED.
"""

import asyncio
import contextlib
import itertools
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

import controller.demo.demonstration
import controller.demo.simulated_plate
import dashboard_pictures
import live_demonstration
import model
from cases import in_turn, shortly
from controller.api.client import Client
from controller.api.hub import Hub
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import LayoutEvent, PatternEvent, StateEvent
from controller.api.schema import ContactStatus, DaemonStateName
from controller.demo.recorder import TouchRecorder
from controller.gateway.app import MAX_SESSIONS
from dashboard_pictures import REASON, SCREENS, STATE, open_dashboard
from drivers.by_hand import actions
from drivers.errors import LinkError, LinkTimeout
from drivers.host.group_states import GroupState
from era_haptics.command import run_era
from era_haptics.lab.conformance.connection import opened
from kit.chain import Chain
from kit.clock import in_virtual_time
from kit.fingers import write_schedule
from kit.host_rules import HostTimes
from kit.set_table import SetTable, make_rig
from kit.wires import WIRES, far_side
from model.fem import Mesh
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.vibration import Tone
from processes.daemons import (
    PATIENCE,
    PLACE,
    READY,
    daemon_at,
    far_end,
    ready,
    running_daemon,
    until_state,
)
from processes.gateways import (
    TOKEN,
    UNCONFIRMED,
    GatewayProcess,
    Page,
    RawWebSocket,
    ScriptedDaemon,
    frame,
    gateway_process,
    has_ended,
    http,
    real_daemon,
    upgrade,
    wait_for,
    wait_for_daemon,
    wait_for_state,
)
from processes.patient_daemon import LONG_WATCHDOG, wait_long
from processes.typed_page import ERA
from registry import threads
from registry.limits import GuardLimits
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultWindow

NAMES = ("a", "b", "c", "d")
BUSES = {
    "serial": SimulatedWire("serial", speed=921_600, shared=True),
    "modbus-rtu": SimulatedWire("modbus-rtu", speed=115_200),
    "slcan": SimulatedWire("slcan", speed=500_000),
}
"""Wires that all four share."""
LINES = {
    "serial": dict.fromkeys(
        NAMES, SimulatedWire("serial", speed=921_600)
    ),  # not shared: one line each
    "mixed": {
        "a": SimulatedWire("serial", speed=921_600),
        "b": SimulatedWire("modbus-rtu", speed=115_200),
        "c": SimulatedWire("slcan", speed=500_000),
        "d": SimulatedWire("modbus-tcp"),
    },
}
"""Four wires for four amplifiers."""
ARRANGED = {
    **{f"one bus, {kind}": dict.fromkeys(NAMES, wire) for kind, wire in BUSES.items()},
    **{f"four lines, {kind}": wires for kind, wires in LINES.items()},
}
MAX_SKEW = 1e-3  # s; of several links, docs/reference/several-amplifiers.md
OWN = 0.250 + 0.010  # s; an amplifier's watchdog and its ramp
FED = 0.050 + 2 * 0.035  # s; a heartbeat later it may be fed, by a request that is sent three times
ALL = OWN + FED + 0.010 + 0.015  # s; and its reaction, and the stop of the others
LEVEL = 0.2


def four_amplifiers(wires: Mapping[str, SimulatedWire]) -> AbstractAsyncContextManager[Chain]:
    """The example's sixteen ERAs on a coarse mesh, armed."""
    rig = load_rig(Path(model.__file__).parents[1] / "examples" / "table.yaml")
    rig = replace(rig, mesh=Mesh(8, 8, rig.plate.length, rig.plate.width))
    tones = {
        era.name: Tone(110.0, LEVEL * era.stroke, math.radians(10 * number))
        for number, era in enumerate(rig.eras)
    }
    table = SetTable(tones, rig.plate)
    # On one bus four heartbeats go one after the other, of 20 ms each over RTU.
    return Chain.armed(wires, rig, table, times=HostTimes(heartbeat=0.05 + 5 * 0.02))


def touch(four: Chain) -> None:
    """Put a finger on the panel."""
    four.is_felt = False
    four.at = {1: (0.3, 0.3)}


def levels_of_all(four: Chain) -> list[float]:
    """The level of every channel of the four amplifiers."""
    return [*itertools.chain(*four.levels().values())]


@pytest.mark.parametrize("arranged", shortly(ARRANGED, ["one bus, serial", "four lines, mixed"]))
@in_virtual_time
async def test_sixteen_channels_of_four_amplifiers_start_together(arranged: str) -> None:
    """Every channel plays its level; on one bus from one moment, on four lines within a ms."""
    async with four_amplifiers(ARRANGED[arranged]) as four:
        touch(four)
        await four.hold(0.3)
        levels = four.levels()
        assert [*levels] == [*NAMES]
        for name, channel_levels in levels.items():
            assert channel_levels == pytest.approx((LEVEL,) * 4, abs=1e-4), name
        starts = list[float]()
        for amplifier in four.far.bench.amplifiers.values():
            voices = itertools.chain(*amplifier.outputs)
            starts += [voice.transition.start for voice in voices if voice.transition.last]
        limit = 1e-9 if arranged.startswith("one bus") else MAX_SKEW
        assert max(starts) - min(starts) <= limit


@pytest.mark.parametrize(
    ("arranged", "lost"),
    in_turn(["one bus, serial", "four lines, mixed", "one bus, slcan"], ["a", "c"]),
)
@in_virtual_time
async def test_loss_of_one_of_four_silences_all(arranged: str, lost: str) -> None:
    """Whichever hangs is silent by its watchdog, the others once that has elapsed, and all stay so.

    Until then the others play on: a set is not renewed, and an amplifier may only be late.
    """
    async with four_amplifiers(ARRANGED[arranged]) as four:
        touch(four)
        await four.hold(0.3)
        assert min(levels_of_all(four)) > 0
        four.host_rules.disturb()
        four.far.devices[lost].inject_fault(FaultWindow(fault="hang"))
        holding = asyncio.create_task(four.hold(0.6))
        await asyncio.sleep(OWN)
        assert four.levels()[lost] == (0,) * 4
        await asyncio.sleep(ALL - OWN)
        assert max(levels_of_all(four)) == 0
        assert four.controller.group.state is GroupState.LOST
        four.far.devices[lost].recover()
        await holding
        assert max(levels_of_all(four)) == 0


@pytest.mark.parametrize("of_rig", [False, True])
@pytest.mark.parametrize("of_amplifier", [False, True])
@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "can+slcan"]))
@in_virtual_time
async def test_motion_and_output_are_not_taken_for_each_other(
    wire: str, of_amplifier: bool, of_rig: bool, coarse_rig: Rig
) -> None:
    """An amplifier opens where its full level is the rig's."""
    rigs = {False: coarse_rig, True: replace(coarse_rig, outputs=frozenset(coarse_rig.amplifiers))}
    rig = rigs[of_rig]
    table = SetTable({}, rig.plate)
    async with Chain.on(WIRES[wire], rig, table, plate=rigs[of_amplifier]) as chain:
        if of_amplifier is of_rig:
            await chain.controller.open()
        else:
            with pytest.raises(LinkError, match="full level must be"):
                await chain.controller.open()
        await chain.controller.close()


RIG = make_rig("a", GuardLimits(20.0, 1000.0, 1.0))
SERIAL = ["serial", "modbus+rtu", "can+slcan"]


@pytest.mark.parametrize(
    ("boots", "openings"),
    [pytest.param(0.8, 1, marks=pytest.mark.long), (5.0, 1), (9.0, 2)],
)
@in_virtual_time
async def test_daemon_reaches_it_at_the_first_opening(
    boots: float, openings: int, tmp_path: Path
) -> None:
    """Within 6 s (docs/reference/urls.md), else while the port stays open; also after a loss."""
    async with far_end(tmp_path) as far:
        far.machine.boots = boots
        async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
            await until_state(era, READY)
            assert [*far.machine.attempts.values()] == [openings]
            far.device.inject_fault(FaultWindow(fault="unplug"))
            await until_state(era, "COMM_LOST")
            far.device.recover()
            await until_state(era, READY)


async def _conformance(url: str) -> Any:
    async with opened(url) as client:
        return await client.hello()


@pytest.mark.parametrize(
    "action", [actions.identify_amplifier, actions.status, actions.stop, _conformance]
)
@pytest.mark.parametrize("wire", SERIAL)
@in_virtual_time
async def test_command_reaches_it(wire: str, action: Callable[[str], Awaitable[Any]]) -> None:
    """Each opens the port for itself; a stop is confirmed as soon as the board has started."""
    async with far_side(WIRES[wire], RIG) as far:
        far.machine.boots = 5.0
        began = threads.now()
        result = await action(far.url)
        assert threads.now() - began < 7.0
        assert result.get("silence", "confirmed_silent") == "confirmed_silent"


@pytest.mark.parametrize(("wire", "told_after"), [("serial", 6.0), ("modbus+tcp", 1.5)])
@in_virtual_time
async def test_mute_amplifier_is_told_after_a_time(wire: str, told_after: float) -> None:
    """That of a board that restarts, or three attempts of 0.5 s; the error names the remedy."""
    async with far_side(WIRES[wire], RIG) as far:
        far.device.inject_fault(FaultWindow(fault="hang"))
        began = threads.now()
        with pytest.raises(LinkTimeout) as caught:
            await actions.identify_amplifier(far.url)
        assert threads.now() - began == pytest.approx(told_after, abs=0.6)
        assert ("restarts" in str(caught.value)) is (wire == "serial")


DESKTOP = SCREENS[0]
BANNER = "document.querySelector('#banner').innerText"
EVENTS = "[...document.querySelectorAll('#log li')].map(e => e.innerText)"
NOTES = "document.querySelectorAll('#log li:first-child .note').length"
TILE = "document.querySelector('.tile')?.innerText ?? ''"
PROBES = (Path(dashboard_pictures.__file__).with_name("page_probes.js")).read_text(encoding="utf-8")


@pytest.mark.long
@pytest.mark.asyncio(loop_scope="module")
async def test_lost_link_is_one_event_with_its_attempts(tab: Page, tmp_path: Path) -> None:
    """The banner has the watchdog time; outdated values are hidden; attempts and the return are
    listed below the loss.
    """
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await ready(era)
        with gateway_process(tmp_path, bench.socket) as gateway:
            await open_dashboard(tab, gateway, DESKTOP)
            # Disarmed: no watchdog can make it another fault on a busy machine.
            assert "%" in await tab.until(TILE)
            events = await tab.evaluate(EVENTS)
            earlier_events = events[-1:]  # a short loss on a busy machine joins this one
            bench.far.device.inject_fault(FaultWindow(fault="hang"))
            await tab.until(f"{STATE} === 'COMM_LOST'")
            assert await tab.evaluate(REASON) == "link-lost"
            await tab.until(BANNER, lambda text: f"after {LONG_WATCHDOG:g}\u00a0s" in text)
            await tab.until("document.querySelector('.tile.bad') !== null")
            tile = await tab.evaluate(TILE)
            assert "%" not in tile
            assert "°C" not in tile
            assert await tab.evaluate("document.querySelector('.plate.unknown') !== null")
            ratios = await tab.evaluate(f"({PROBES}).contrasts()")
            assert [ratio for ratio in ratios if ratio[0] < 4.5] == []
            await tab.until(f"{NOTES} > 1")
            assert (await tab.evaluate(EVENTS))[1:] == earlier_events
            bench.far.device.recover()
            await tab.until(f"{STATE} === 'READY_TO_SWITCH_ON'")
            assert (await tab.evaluate(EVENTS))[1:] == earlier_events
            assert await tab.evaluate(f"{NOTES} === 1")
            assert await tab.evaluate(REASON) == "simulated"
            await tab.until("document.querySelector('.tile.bad') === null")
            assert "%" in await tab.evaluate(TILE)


@pytest.mark.long
@pytest.mark.asyncio(loop_scope="module")
async def test_what_the_daemon_reports_is_shown(tab: Page, tmp_path: Path) -> None:
    """Which amplifiers a stop did not silence: beside the button and in the list of events.

    Until a stop is confirmed. The end of the daemon after a loss is an event of its own. Regions
    are those of the layout in use, and the level is that at the finger.
    """
    problem = "document.querySelector('#problem').innerText"
    states: list[tuple[DaemonStateName, str]] = [
        ("READY_TO_SWITCH_ON", ""),
        ("COMM_LOST", "amplifier main: cut"),
        ("NOT_READY", "told to end"),
    ]
    with ScriptedDaemon(tmp_path) as daemon, gateway_process(tmp_path, daemon.socket) as gateway:
        await open_dashboard(tab, gateway, DESKTOP)
        knob = {"name": "knob", "shape": "circle", "x_m": 0.1, "y_m": 0.1, "radius_m": 0.03}
        daemon.publish("layout", LayoutEvent(layout={"regions": [knob]}))
        await tab.until("document.querySelectorAll('.region').length === 1")
        finger = ContactStatus(source="a", id=1, x_m=0.1, y_m=0.1, role="target", level_db_sl=18.0)
        pattern = PatternEvent(
            contacts=[finger],
            drive={},
            latency_ms=2.0,
            predicted_level_db_sl=22.0,
            predicted_contrast_db=None,
        )
        daemon.publish("pattern", pattern)
        await tab.until("document.querySelector('#summary').textContent.includes('18 dB SL')")
        daemon.silence = UNCONFIRMED
        await tab.click("#stop")
        report = await tab.until(problem, lambda text: "side" in text)
        assert "main" not in report
        assert report in (await tab.evaluate(EVENTS))[0]
        daemon.silence = {}
        await tab.click("#stop")
        await tab.until(f"{problem} === ''")
        for (old, _), (new, cause) in pairwise(states):
            daemon.publish("state", StateEvent(old=old, new=new, cause=cause, remedy=None, epoch=1))
            events = await tab.until(EVENTS, lambda events, cause=cause: cause in events[0])
        assert "told to end" in events[0]
        assert events[1].endswith("amplifier main: cut")


@pytest.mark.asyncio(loop_scope="module")
async def test_page_connects_again_and_reports_a_stop_without_an_answer(
    tab: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full gateway is shown as full, not as unreachable.

    So is one without a place at the daemon, instead of a state that no event changes. A stop is not
    confirmed, after the time in which an answer may come, when the gateway hangs.
    """
    busy = RpcError(ErrorCode.BUSY, "too many clients", remedy="try again later")
    with ScriptedDaemon(tmp_path) as daemon, gateway_process(tmp_path, daemon.socket) as gateway:
        with contextlib.ExitStack() as connections:
            for _ in range(MAX_SESSIONS):
                last = RawWebSocket(gateway).connection
                connections.callback(last.close)
            await tab.show(f"{gateway.url}#token={gateway.token}")
            await tab.until(f"{REASON} === 'gateway-full'")
            last.close()
            await tab.until(f"{REASON} === 'simulated'")
        with monkeypatch.context() as full:
            full.setattr(Hub, "subscribe", Mock(side_effect=busy))
            await tab.show(f"{gateway.url}#token={gateway.token}")
            async with asyncio.timeout(PATIENCE / 6):
                await tab.until(f"{REASON} === 'gateway-full'")
        await tab.until(f"{REASON} === 'simulated'")
        gateway.process.send_signal(signal.SIGSTOP)
        await tab.click("#stop")
        async with asyncio.timeout(PATIENCE / 6):
            await tab.until("document.querySelector('#problem').textContent.includes('by hand')")


# (id, down [s], up [s], x, y in TUIO's coordinates): one finger, then a second beside it, a pause,
# and a third one alone.
SCHEDULE = [
    (1, 0.1, 1.2, 0.30, 0.35),
    (2, 0.6, 1.2, 0.80, 0.70),
    (3, 1.4, 2.0, 0.65, 0.20),
]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A TUIO capture of the schedule."""
    return write_schedule(tmp_path_factory.mktemp("touches") / "touches.tuio", SCHEDULE, 2.1)


@pytest.fixture
def demo(table_cache, tmp_path, monkeypatch, capsys):
    """Run `era demo --json` in this process; returns exit status, output and errors."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(table_cache))
    monkeypatch.chdir(tmp_path)

    def run_demo(*arguments):
        status = run_era(["demo", *map(str, arguments), "--out", str(tmp_path), "--json"])
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return run_demo


@pytest.mark.real_time
def test_demo_reports_a_far_end_that_ended(capture, demo, monkeypatch):
    """Killing the amplifiers' process midway ends the run with status 3 and one paragraph."""
    wait_long(monkeypatch)
    far_ends = []

    async def start(*arguments, **options):
        far_ends.append(await start_far_end(*arguments, **options))
        return far_ends[-1]

    def killing(*arguments, on_row):
        return TouchRecorder(*arguments, on_row=lambda row: far_ends[0].kill())

    start_far_end = controller.demo.simulated_plate.start_simulation
    monkeypatch.setattr(controller.demo.simulated_plate, "start_simulation", start)
    monkeypatch.setattr(controller.demo.demonstration, "TouchRecorder", killing)
    status, out, errors = demo("--real-time", "--touches", capture)
    assert status == 3, errors
    assert len(errors.strip().split("\n\n")) == 1
    assert out == ""


def test_far_end_ends_when_the_demo_is_killed(capture, table_cache, tmp_path):
    """After SIGKILL of the command, the amplifiers' process ends by itself."""
    with subprocess.Popen(
        [str(ERA), "demo", "--real-time", "--touches", str(capture), "--out", str(tmp_path)],
        env=os.environ | {"XDG_CACHE_HOME": str(table_cache)},
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
    ) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        far_end = int(wait_for(lambda: children.read_text().split(), timeout=60)[0])
        process.kill()
    try:
        wait_for(lambda: not is_running(far_end), timeout=60)
    finally:
        with suppress(ProcessLookupError):
            os.kill(far_end, signal.SIGKILL)


def is_running(pid):
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.long
def test_page_and_daemon(tmp_path: Path) -> None:
    """It prints the page's URL with its token, its daemon is disarmed; Ctrl-C leaves nothing."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    socket = tmp_path / "era-haptics" / "daemon.sock"
    with subprocess.Popen(
        [sys.executable, live_demonstration.__file__],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            line = process.stdout.readline()
            assert re.fullmatch(r"dashboard: http://127\.0\.0\.1:\d+/#token=[\w-]{22,}\n", line)
            with Client.connect(socket, timeout=60) as daemon:
                assert wait_for_state(daemon, READY, ENABLED) == READY
                assert daemon.hello("test").rig.simulated
                assert daemon.status().watchdog_s == 2.0
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert not socket.exists()


ENABLED = "OPERATION_ENABLED"


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of one daemon for all tests."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


def watch(path: Path, looks: list[str], over: threading.Event) -> None:
    """Hold a finger down: renew the lease, touch and read the status fifty times a second."""
    with Client.connect(path, name="watch", timeout=PATIENCE) as era:
        lease = era.arm("watch", lease_s=60).lease
        while not over.wait(0.02):
            era.touch([PLACE])
            status = era.status()
            assert status.state == ENABLED, status.cause
            era.renew(lease)
            looks.append(status.state)
        era.disarm()


@pytest.fixture
def watched(daemon: Path) -> Iterator[None]:
    """The daemon armed and watched; it must stay armed."""
    looks, over = list[str](), threading.Event()
    with Client.connect(daemon, name="test") as era, ThreadPoolExecutor() as thread:
        wait_for_state(era, "READY_TO_SWITCH_ON")
        watching = thread.submit(watch, daemon, looks, over)
        try:
            wait_for(lambda: len(looks) > 5 or watching.done())
            yield
        finally:
            over.set()
        watching.result()


@pytest.fixture
def gateway(watched: None, daemon: Path, tmp_path: Path) -> Iterator[GatewayProcess]:
    """A gateway, which must not log anything."""
    with gateway_process(tmp_path, daemon) as process:
        wait_for_daemon(process)
        yield process
        if process.process.poll() is None:
            assert process.log() == ""


def assert_served(gateway: GatewayProcess) -> None:
    """A new client is served over HTTP and over a WebSocket."""
    assert http(gateway, "/api/v1/effects", body=b"{}").status == 200
    with RawWebSocket(gateway) as ws:
        ws.call("effects", {})
        assert ws.response()["result"]


@pytest.mark.long
@pytest.mark.real_time
def test_gateway_serves_with_two_thousand_silent_connections(gateway: GatewayProcess) -> None:
    """The oldest are closed until 128 are left."""
    with contextlib.ExitStack() as held:
        silent = [held.enter_context(gateway.connect()) for _ in range(2000)]
        assert_served(gateway)
        wait_for(lambda: sum(not has_ended(connection) for connection in silent) <= 128)
        assert_served(gateway)


@pytest.mark.real_time
def test_gateway_closes_connections_that_trickle_or_do_not_read(gateway: GatewayProcess) -> None:
    """Single bytes do not extend a timeout; other clients are served meanwhile."""
    head = f"POST /api/v1/arm HTTP/1.1\r\nHost: {gateway.host}\r\n"
    full = f"{head}Authorization: Bearer {TOKEN}\r\nContent-Type: application/json\r\n"
    page = f"GET /app.js HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n".encode()
    hello = frame(b'{"jsonrpc":"2.0","id":1,"method":"hello","params":{"client":"me"}}')
    with contextlib.ExitStack() as held:
        remaining: list[tuple[socket.socket, bytes]] = []
        for begun in (
            head,
            f"{full}Content-Length: 100\r\n\r\n",
            f"{full}Transfer-Encoding: chunked\r\n\r\n",
            f"{head}Content-Length: 100\r\n\r\n",  # refused at once, without a token
            f"{full}Content-Length: 2\r\n\r\n{{}}{head}",  # a second request
        ):
            slow = held.enter_context(gateway.connect())
            slow.sendall(begun.encode())
            remaining.append((slow, b"1"))
        for number in range(20):
            deaf = held.enter_context(socket.socket())
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            deaf.connect(("127.0.0.1", gateway.port))
            if number % 2:
                deaf.sendall(upgrade(gateway))
            remaining.append((deaf, 20 * (hello if number % 2 else page)))
        assert_served(gateway)
        end = time.monotonic() + PATIENCE
        while remaining:
            assert time.monotonic() < end, f"{len(remaining)} are still there"
            for entry in list(remaining):
                connection, data = entry
                connection.setblocking(False)
                try:
                    connection.send(data)
                except BlockingIOError:
                    pass
                except ConnectionError:
                    remaining.remove(entry)
            time.sleep(0.1)
        assert_served(gateway)


@pytest.mark.real_time
def test_daemon_continues_when_gateways_are_killed_under_load(
    watched: None, daemon: Path, tmp_path: Path
) -> None:
    """Two in turn, each under a flood; the next one serves again."""
    for _ in range(2):
        with gateway_process(tmp_path, daemon) as gateway:
            wait_for_daemon(gateway)
            with RawWebSocket(gateway) as ws:
                ws.call("subscribe", {"topics": ["field", "pattern", "amplifiers"]})
                with contextlib.suppress(OSError):
                    for _ in range(200):
                        ws.send(b'{"jsonrpc":"2.0","method":"status","params":{}}')
                gateway.process.kill()
                gateway.process.wait()
    with Client.connect(daemon, name="test") as era:
        # the watch's own; a busy machine may have it expire between two repetitions
        wait_for(lambda: len({contact.source for contact in era.status().contacts}) == 1)
