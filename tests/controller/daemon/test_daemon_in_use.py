"""A daemon in use, in virtual time: dumps, commands of layouts, signals, the service manager.

Dumps have what came before the plate was stopped; names and files of strengths are bounded.
"""

import asyncio
import contextlib
import json
import math
import os
import signal
import socket
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from controller.api.client import AsyncClient, Client
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.cli.main import BAD_INPUT, run
from controller.effects.strengths import MAX_NAMES
from controller.operation.fault_dumps import (
    MAX_LINE,
    MAX_RECORDS,
    FaultDumps,
    write_dump,
)
from courses import Planted
from daemons import (
    ENABLED,
    PLACE,
    READY,
    DaemonBench,
    Journal,
    daemon_at,
    energised,
    error_code,
    far_end,
    holding,
    ready_daemon,
    silent_from,
    until,
    until_state,
)
from drivers.host.amplifier import WATCHDOG
from gateway_bench import real_daemon
from plates import TWO_AMPLIFIERS
from registry import threads
from sim.faults import FaultWindow
from virtual_lines import in_virtual_time


def dumped(folder: Path, kind: str) -> list[str]:
    """The dumps of a kind."""
    return [each.read_text("utf-8") for each in folder.glob(f"dumps/era-{kind}-*.jsonl")]


async def fails_in_the_loop(bench: DaemonBench, era: AsyncClient) -> None:
    """Let a turn of the control loop fail once."""

    def fail() -> bool:
        del vars(bench.daemon._controller.cycle._wake)["clear"]
        raise Planted("in the loop")

    vars(bench.daemon._controller.cycle._wake)["clear"] = fail


async def reports_a_fault(bench: DaemonBench, era: AsyncClient) -> None:
    """Let the amplifier have a fault."""
    bench.far.device.inject_fault(FaultWindow(fault="over_voltage"))


async def is_stopped(bench: DaemonBench, era: AsyncClient) -> None:
    """Stop as a client."""
    await era.stop()


@pytest.mark.parametrize(
    ("stops", "kind", "cause"),
    [
        (fails_in_the_loop, "fault", "in the loop"),
        (reports_a_fault, "fault", "OVER_VOLTAGE"),
        (is_stopped, "stop", "stopped by 'test'"),
    ],
)
@in_virtual_time
async def test_dump_names_the_last_touch_and_request_before_a_stop(
    tmp_path: Path,
    stops: Callable[[DaemonBench, AsyncClient], Awaitable[None]],
    kind: str,
    cause: str,
) -> None:
    """With what was played for the finger, what was refused, and how the plate came to stop."""
    async with ready_daemon(tmp_path, "dumps: {folder: dumps}\n") as (bench, era):
        lease = await era.arm("me", lease_s=30)
        assert await error_code(era.play("none", PLACE)) is ErrorCode.REFUSED
        async with holding(era, far=bench.far):
            await stops(bench, era)
            await until(lambda: dumped(tmp_path, kind))
        bench.far.device.recover()
    (text,) = dumped(tmp_path, kind)
    head, *lines = map(json.loads, text.splitlines())
    assert cause in head["cause"]
    assert lease.lease not in text

    def last(key: str, value: object = None) -> Any:
        """The last record with a key, or with a value of it."""
        return [each for each in lines if each.get(key) and value in (None, each[key])][-1]

    (finger,), (felt,) = last("contacts")["contacts"], last("pattern")["pattern"]
    assert (finger["key"], finger["x"]) == (["api:1:python", 1], pytest.approx(PLACE[0]))
    assert (felt["contact"]["key"], felt["verdict"]) == (finger["key"], "own")
    assert (last("request", "touch")["client"], last("request", "arm")["outcome"]) == (
        *("test", "done"),
    )
    assert "unknown effect" in last("request", "play")["refused"]
    assert last("request", "stop" if kind == "stop" else "touch")["time_s"] >= finger["since"]
    assert last("state")["state"].startswith("OPERATION_ENABLED -> ")
    assert {"Arm", "Set", "Reply"} <= {each.get("message") for each in lines}
    assert (times := [each["time_s"] for each in lines]) == sorted(times)


def test_what_is_kept_for_a_dump_is_bounded(tmp_path: Path) -> None:
    """Whatever comes, in number and in length; a client that repeats itself leaves the others."""
    dumps, long = FaultDumps(tmp_path), "x" * 70_000
    dumps.requested("other", "arm", 0.0)
    for _ in range(10 * MAX_RECORDS):
        dumps.requested("me", "touch", 1.0)["outcome"] = long
    assert [each["times"] for each in dumps._ring.values()] == [1, 10 * MAX_RECORDS]
    for number in range(MAX_RECORDS):
        dumps.requested(f"client {number}", "stop", 2.0)
        dumps.note({"time_s": 2.0, "message": long})
        dumps.note({"time_s": math.inf, "contacts": [long]})
    kept = [*dumps._ring.values()]
    assert len(kept) == MAX_RECORDS
    lines = write_dump(tmp_path, kept, cause="").read_text("utf-8").splitlines()
    assert max(map(len, lines)) <= MAX_LINE
    assert "Infinity" not in "".join(lines)


LAYOUTS = "layouts: {home: home.yaml, climate: climate.yaml}\n"


def write_layouts(folder: Path) -> None:
    """At home the west hums and the east ticks; for the climate all of it hums low."""
    half = "{rectangle: {start: [%s m, 0 m], end: [%s m, 0.2 m]}, on_press: %s}"
    (folder / "home.yaml").write_text(
        f"effects: {{tick: {{kind: click, duration: 0.2 s}}, hum: {{kind: buzz, level: 14}}}}\n"
        f"regions: {{west: {half % (0, 0.15, 'hum')}, east: {half % (0.15, 0.3, 'tick')}}}\n",
        "utf-8",
    )
    low = "effects: {low: {kind: buzz, level: 10}}\nelsewhere: low\n"
    (folder / "climate.yaml").write_text(low, "utf-8")


@pytest.mark.real_time
def test_commands_choose_a_layout_and_reload(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a daemon's process, with what they print and refuse, in its log, too.

    For a layout that is removed while it is in use the first is.
    """
    write_layouts(tmp_path)

    def era(*line: str) -> tuple[int, str]:
        status = run([*line, "--socket", str(tmp_path / "era.sock")], ["controller.cli.commands"])
        return status, "".join(capsys.readouterr())

    with real_daemon(tmp_path, LAYOUTS) as socket, Client.connect(socket) as client:
        status, said = era("layout", "use", "climate", "--json")
        assert (status, json.loads(said)["layout"]) == (0, "climate")
        status, said = era("layout", "use", "climat")
        assert status == BAD_INPUT
        assert said.count("\n") == 1
        assert "did you mean climate" in said
        assert "\n  layout climate (of home, climate)\n" in era("status")[1]
        assert era("strength", "python", "-6") == era("strength") == (0, "python: -6 dB\n")
        config, home = tmp_path / "daemon.yaml", tmp_path / "home.yaml"
        text = config.read_text("utf-8")
        home.write_text("elsewhere: null\n", "utf-8")
        for keys, elsewhere, is_done, reasons in (
            (text, "buzz", True, ["layouts.home: changed"]),
            (f"{text}mode: phased\n", "click", False, ["mode: ", "layouts.home: changed, but not"]),
            (
                text.replace(", climate: climate.yaml", ""),
                "click",
                True,
                ["layouts.home: changed", "layouts.climate: removed", "layout in use: home"],
            ),
        ):
            config.write_text(keys, "utf-8")
            home.write_text(f"elsewhere: {elsewhere}\n", "utf-8")
            status, said = era("reload", "--json")
            assert (status, json.loads(said)["reloaded"]) == (1 - is_done, is_done)
            for found, expected in zip(json.loads(said)["reasons"], reasons, strict=True):
                assert found.startswith(expected)
            assert (client.status().layout == "climate") is ("climate" in keys)
    log = [json.loads(line) for line in (tmp_path / "daemon.log").read_text("utf-8").splitlines()]
    verdicts = [each["level"] for each in log if each["message"].startswith("config: reload")]
    assert verdicts == ["info", "error", "info"]


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


@in_virtual_time
async def test_a_disk_that_hangs_delays_no_other_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Strengths hold and are answered; touches and disarming go on, and the newest is kept.

    One that is full is logged once.
    """
    disk, full = asyncio.Event(), [True]

    async def hangs(work: Callable[[Path], None], file: Path) -> None:
        await disk.wait()
        if full:
            raise OSError(28, "No space left on device")
        work(file)

    async with ready_daemon(tmp_path, "strengths: kept.json\n") as (_, era):
        await era.arm("test", lease_s=60)
        monkeypatch.setattr(asyncio, "to_thread", hangs)
        setting = [era.strength(name="test", gain_db=-1.0 - gain) for gain in range(10)]
        await asyncio.wait_for(asyncio.gather(*setting), 0.5)
        await era.touch([PLACE])
        await era.disarm()
        disk.set()
        await asyncio.sleep(0.1)
        assert caplog.text.count("strengths: not kept: [Errno 28] No space left on device") == 1
        full.clear()
        await era.strength("test", -11.0)
    assert json.loads((tmp_path / "kept.json").read_text()) == {"test": -11.0}


@in_virtual_time
async def test_names_with_a_strength_are_bounded(tmp_path: Path) -> None:
    """A client that invents sources fills neither memory nor file: 64 names may have one."""
    async with ready_daemon(tmp_path, "strengths: kept.json\n") as (_, era):
        names = [f"{number} {'x' * 70}" for number in range(MAX_NAMES + 1)]
        for name in names:
            await era.touch([PLACE], source=name)
            await asyncio.sleep(0.01)
            if name is names[-1]:
                with pytest.raises(RpcError, match=r"^strengths must be of at most 64 names"):
                    await era.strength(name=name, gain_db=-1)
                await era.strength(name=names[0], gain_db=0)
            await era.strength(name=name, gain_db=-1)
    kept = json.loads((tmp_path / "kept.json").read_text())
    assert kept == dict.fromkeys(names[1:], -1)


@in_virtual_time
async def test_every_name_that_is_listed_can_be_set(tmp_path: Path) -> None:
    """Also that of a sender whose own name is as long as may be, and not printable."""
    async with ready_daemon(tmp_path) as (bench, era):
        sender = f"table:tuio:10.0.0.2/{chr(0x1F600) * 100!a}"
        bench.daemon._layouts.player.strengths.note(sender)
        assert (await era.strength(name=sender, gain_db=-6)).strengths == {sender: -6}
