"""A daemon in use, in virtual time: its start and end, its commands and requests of clients.

A reload may be interrupted; leases have a token
and an end; names and files of strengths are bounded.
"""

import asyncio
import contextlib
import json
import os
import re
import resource
import signal
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import serial
from typer.testing import CliRunner

from controller.api.client import Client
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.cli.commands import app
from controller.cli.status_text import show_status
from controller.daemon.children import gateway_options
from controller.daemon.daemon import run_daemon
from controller.daemon.handlers import check_lease
from controller.effects.strengths import MAX_NAMES
from controller.gateway.gateway_settings import read_token
from controller.operation.operation_states import (
    ENERGISED,
    DaemonEvent,
    DaemonState,
    Lease,
    Operation,
    Trigger,
    step,
)
from controller.process.log import LogThread
from drivers.errors import CommandError
from era_haptics.command import run_era
from kit.clock import in_virtual_time
from kit.plates import TWO_AMPLIFIERS
from model.errors import InputError
from processes.daemons import (
    PATIENCE,
    PLACE,
    READY,
    Journal,
    daemon_at,
    far_end,
    holding,
    next_event,
    ready_daemon,
    stated_readings,
    until,
    until_state,
    write_daemon,
)
from processes.gateways import UNCONFIRMED, ScriptedDaemon, real_daemon
from registry import threads
from registry.command_line import BAD_INPUT

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
        status = run_era([*line, "--socket", str(tmp_path / "era.sock")])
        return status, "".join(capsys.readouterr())

    with real_daemon(tmp_path, LAYOUTS) as socket, Client.connect(socket) as client:
        status, output = era("layout", "use", "climate", "--json")
        assert (status, json.loads(output)["layout"]) == (0, "climate")
        status, output = era("layout", "use", "climat")
        assert status == BAD_INPUT
        assert output.count("\n") == 1
        assert "did you mean climate" in output
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
                ["layouts.home: changed", "layouts.climate: removed", "current layout: home"],
            ),
        ):
            config.write_text(keys, "utf-8")
            home.write_text(f"elsewhere: {elsewhere}\n", "utf-8")
            status, output = era("reload", "--json")
            assert (status, json.loads(output)["reloaded"]) == (1 - is_done, is_done)
            for reason, expected in zip(json.loads(output)["reasons"], reasons, strict=True):
                assert reason.startswith(expected)
            assert (client.status().layout == "climate") is ("climate" in keys)
    log = [json.loads(line) for line in (tmp_path / "daemon.log").read_text("utf-8").splitlines()]
    verdicts = [record["level"] for record in log if record["message"].startswith("config: reload")]
    assert verdicts == ["info", "error", "info"]


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
            later_requests = [entry for entry in requests if entry.time > end.time]
            assert {entry.name for entry in later_requests} == {"GetStatus"}
            assert not any(later_requests[-1].levels)  # read back until it is silent
            assert far.summary(name).state == "SWITCH_ON_DISABLED"


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
        assert caplog.text.count("strengths: not saved: [Errno 28] No space left on device") == 1
        full.clear()
        await era.strength("test", -11.0)
    assert json.loads((tmp_path / "kept.json").read_text()) == {"test": -11.0}


@in_virtual_time
async def test_names_with_a_strength_are_bounded(tmp_path: Path) -> None:
    """A client that invents sources fills neither memory nor file: 64 names may have one.

    Every name that is listed can be set, also that of a sender whose own name is as long as may be,
    and not printable.
    """
    async with ready_daemon(tmp_path, "strengths: kept.json\n") as (bench, era):
        sender = f"table:tuio:10.0.0.2/{chr(0x1F600) * 100!a}"
        bench.daemon.layouts.player.strengths.note(sender)
        assert (await era.strength(name=sender, gain_db=-6)).strengths == {sender: -6}
        await era.strength(name=sender, gain_db=0)
        names = [f"{number} {'x' * 70}" for number in range(MAX_NAMES + 1)]
        for name in names:
            await era.touch([PLACE], source=name)
            await asyncio.sleep(0.01)
            if name is names[-1]:
                with pytest.raises(RpcError, match=r"^strengths must have at most 64 names"):
                    await era.strength(name=name, gain_db=-1)
                await era.strength(name=names[0], gain_db=0)
            await era.strength(name=name, gain_db=-1)
            await era.touch([], source=name)
    strengths = json.loads((tmp_path / "kept.json").read_text())
    assert strengths == dict.fromkeys(names[1:], -1)


@in_virtual_time
async def test_event_read_late_takes_nothing_back_that_was_seen(tmp_path: Path) -> None:
    """Of this connection or one before, even if this daemon counts from less."""
    async with ready_daemon(tmp_path) as (bench, era):
        await era.subscribe("state")
        await era.stop()
        epoch = (await era.stop()).epoch
        assert (await next_event(era, "state")).data["epoch"] < epoch
        await era.clear()
        supervisor = bench.daemon.supervisor
        supervisor.current.value = replace(supervisor.operation, epoch=0)
        for connection in list(bench.daemon.server.clients):
            connection.abort()
        await era.stop()
        assert (await next_event(era, "state")).data["epoch"] >= epoch - 1
        await era.clear()
        assert (await era.status()).state == READY


async def test_shutdown_while_a_port_is_opened_leaves_none_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system takes its time; the port is closed at last, free for others, not opened again."""
    opened: list[serial.Serial] = []
    may_open, open_now = threading.Event(), serial.Serial.open

    def slow(port: serial.Serial) -> None:
        opened.append(port)
        assert may_open.wait(PATIENCE)
        open_now(port)

    monkeypatch.setattr("serial.Serial.open", slow)
    async with far_end(tmp_path) as far:
        async with daemon_at(far, tmp_path) as bench:
            await until(lambda: opened)
            bench.daemon.shut_down("end of the test")
            await until(lambda: bench.daemon.supervisor.closing.is_set())
            asyncio.get_running_loop().call_later(0.1, may_open.set)
        await until(lambda: not opened[0].is_open)
        assert len(opened) == 1
        with serial.Serial(opened[0].port, exclusive=True):
            pass


def test_lease_lasts_its_duration_from_each_renewal_by_its_token() -> None:
    """5 s from when it is armed and 5 s from the renewal, but not from an attempt after its end.

    A refusal names the owner, not the token; without a lease every token is refused.
    """
    lease = Lease("me", 5).renewed(100)
    assert check_lease(lease, lease.token, 104.999) == lease
    renewed = check_lease(lease, lease.token, 104).renewed(104)
    assert (renewed.token, renewed.expires_at) == (lease.token, 109)
    wrong = [(held, token, 101.0) for token in ("", "x", "ü" * 32) for held in (lease, None)]
    for held, token, now in [(renewed, lease.token, 109.0), *wrong]:
        with pytest.raises(RpcError) as caught:
            check_lease(held, token, now)
        assert caught.value.code is ErrorCode.LEASE
        assert lease.token not in str(caught.value)
        assert held is not lease or "'me'" in str(caught.value)


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize("trigger", Trigger)
def test_lease_exists_while_energised_alone(state: DaemonState, trigger: Trigger) -> None:
    """However it ends; the epoch says what may not go on afterwards."""
    lease = Lease("me", 5, expires_at=10.0) if state in ENERGISED else None
    operation = Operation(state, lease=lease, epoch=7)
    updated, _ = step(operation, DaemonEvent(trigger, "a test", lease=Lease("you", 3)), 6.0)
    if updated.state in ENERGISED:
        is_new = updated.state is not state
        owner = "you" if is_new and trigger is Trigger.ARM else "me"
        end = {"you": 9.0, "me": 11.0}[owner] if is_new else 10.0
        assert (updated.lease.owner, updated.lease.expires_at) == (owner, end)
    else:
        assert updated.lease is None
    if state in ENERGISED and updated.state not in ENERGISED:
        assert updated.epoch == 8


@pytest.mark.parametrize(
    ("arguments", "address"),
    [
        ([], None),
        (["--dashboard"], "127.0.0.1:8137"),
        (["--dashboard", "127.0.0.1:9000"], "127.0.0.1:9000"),
        (["--dashboard=localhost:9000"], "localhost:9000"),
    ],
)
def test_dashboard_option_has_optional_address(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], address: str | None
) -> None:
    """Before and behind the configuration; the default is the gateway's."""
    calls: list[tuple[str, str | None]] = []
    monkeypatch.setattr(
        "controller.daemon.daemon.run_daemon",
        lambda config, *, dashboard, trace: calls.append((config.name, dashboard)),
    )
    for line in (["daemon", "d.yaml", *arguments], ["daemon", *arguments, "d.yaml"]):
        result = CliRunner().invoke(app, line)
        assert result.exit_code == 0, result.output
    assert calls == [("d.yaml", address)] * 2


def test_daemon_goes_on_without_the_page_of_its_file_when_not_installed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It says once what to install, and starts no gateway that could only end."""
    pages: list[str | None] = []
    monkeypatch.setattr("controller.gateway.gateway_settings.find_spec", lambda name: None)
    monkeypatch.setattr(
        "controller.daemon.daemon.run_until_stopped",
        lambda config, lock, *, log, dashboard: pages.append(dashboard),
    )
    monkeypatch.setattr(
        "controller.daemon.daemon.start_log", lambda file, *, level: LogThread(file)
    )
    further_line = 'dashboard: "127.0.0.1:0"\n'
    run_daemon(write_daemon(tmp_path, {"main": "sim://"}, further_line), dashboard=None)
    assert pages == [None]
    (line,) = caplog.messages
    assert "pip install -e '.[gateway]'" in line


def test_daemon_refuses_to_start_with_little_memory_or_few_descriptors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Within 300 MB of addresses a library waits for more of them for ever.

    Below 64 descriptors its own files and 40 clients would use them up.
    """
    limits = {resource.RLIMIT_AS: (300 << 20, resource.RLIM_INFINITY)}
    real_limits = resource.getrlimit
    with monkeypatch.context() as patched:
        patched.setattr(
            resource,
            "getrlimit",
            lambda resource_id: limits.get(resource_id) or real_limits(resource_id),
        )
        with pytest.raises(InputError, match="512 MB, got 300 MB"):
            run_daemon(Path("missing.yaml"), dashboard=None)
    monkeypatch.setattr("controller.daemon.daemon.allow_many_descriptors", lambda: 63)
    with pytest.raises(InputError, match="64, got 63"):
        run_daemon(Path("missing.yaml"), dashboard=None)


def test_daemon_refuses_pipe_as_log_or_trace(tmp_path: Path) -> None:
    """A named pipe is not waited for, whether it is read or not."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    for is_read in (True, False):
        with pytest.raises(InputError, match=r"daemon\.yaml: log\.file: .*pipe"):
            run_daemon(
                write_daemon(tmp_path, {"main": "sim://"}, "log: {file: pipe}\n"), dashboard=None
            )
        with pytest.raises(CommandError, match="pipe"):
            run_daemon(write_daemon(tmp_path, {"main": "sim://"}), dashboard=None, trace=pipe)
        if is_read:
            os.close(reader)
    assert not (tmp_path / "era.sock").exists()


def test_stop_exits_with_3_and_names_amplifiers_unless_all_are_silent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Success only if every amplifier is confirmed silent, or else the unconfirmed ones."""
    with ScriptedDaemon(tmp_path) as daemon:
        command = ["stop", "--socket", str(daemon.socket)]
        assert run_era(command) == 0
        daemon.silence = UNCONFIRMED
        assert run_era(command) == 3
        errors = capsys.readouterr().err
        assert re.search(r"side .*0\.20 s.*rear", errors)
        assert "main" not in errors
    assert run_era(command) == 3


@in_virtual_time
async def test_readings_are_shown_with_their_unit_to_their_step(tmp_path: Path) -> None:
    """Each as stated; a temperature in steps of 0.1 °C, by `era status` and by a page."""
    async with ready_daemon(tmp_path) as (bench, era):
        pages, status = (await era.hello("test")).readings, await era.status()
        assert pages["temperature_c"] == ("Temperature", "°C", 1)
        assert "temperature 25.0 °C" in show_status(status)
        for reading, value in stated_readings(bench):
            assert getattr(status.amplifiers[0], reading.key) == pytest.approx(value)
            places = reading.key in pages, f" {reading.label} " in show_status(status)
            assert places == ("page" in reading.views, "status" in reading.views)


def test_gateway_keeps_its_token_out_of_a_log(tmp_path: Path) -> None:
    """Not on a terminal, it reads it from a file of the owner instead of printing it.

    A demonstration prints it all the same.
    """
    assert "--token-file" not in gateway_options(
        "127.0.0.1:0", tmp_path / "era.sock", shows_token=True
    )
    *_, option, file = gateway_options("127.0.0.1:0", tmp_path / "era.sock")
    assert option == "--token-file"
    assert len(read_token(Path(file))) >= 32  # which refuses a file that others may read
