"""A daemon in virtual time: requests of clients, its commands, actions at the amplifier, events."""

import asyncio
import os
import re
import resource
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import Notification
from controller.api.methods import TOPICS, TouchParams
from controller.api.schema import TouchPoint
from controller.cli.commands import app
from controller.cli.main import run
from controller.cli.status_text import show_event, show_status
from controller.daemon.children import gateway_options
from controller.daemon.daemon import run_daemon
from controller.effects.layout import default_effects
from controller.gateway.gateway_settings import read_token
from controller.process.log import LogThread
from daemons import (
    ENABLED,
    READY,
    daemon_at,
    error_code,
    far_end,
    holding,
    next_event,
    ready_daemon,
    until,
    until_state,
    write_daemon,
)
from drivers.errors import CommandError
from gateway_bench import UNCONFIRMED, ScriptedDaemon
from model.errors import InputError
from plates import TWO_AMPLIFIERS
from sim.faults import FaultWindow
from virtual_lines import in_virtual_time


def test_event_is_shown_by_wall_clock_without_unknown_values() -> None:
    """On the second day of 1970 at 0:01:05.25 local time; figures are rounded."""
    finger = {"source": "panel", "id": 1, "x_m": 0.1 + 0.2, "role": None, "effect": "buzz"}
    ahead = datetime(1970, 1, 2).timestamp() + 60.0
    drive = {"SW": {"frequency_hz": 110.0, "level": 0.05}}
    event = Notification("pattern", 5.25, 3, {"contacts": [finger], "drive": drive})
    assert show_event(event, ahead=ahead) == (
        "00:01:05.250  pattern    contacts source panel, id 1, x_m 0.3, effect buzz, "
        "drive (SW (frequency_hz 110, level 0.05))  (3 lost)"
    )
    empty = Notification("contacts", 0.0, 0, {"contacts": []})
    assert show_event(empty, ahead=ahead).split()[2:] == ["contacts", "none"]


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
        "controller.daemon.daemon._run",
        lambda config, lock, *, log, dashboard: pages.append(dashboard),
    )
    monkeypatch.setattr(
        "controller.daemon.daemon.start_log", lambda file, *, level: LogThread(file)
    )
    more = 'dashboard: "127.0.0.1:0"\n'
    run_daemon(write_daemon(tmp_path, {"main": "sim://"}, more), dashboard=None)
    assert pages == [None]
    (line,) = caplog.messages
    assert "pip install -e '.[gateway]'" in line


def test_daemon_refuses_to_start_with_few_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Below 64 its own files and 40 clients would use them up."""
    monkeypatch.setattr("controller.daemon.daemon.allow_many_descriptors", lambda: 63)
    with pytest.raises(InputError, match="64, got 63"):
        run_daemon(Path("missing.yaml"), dashboard=None)


def test_daemon_refuses_to_start_with_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 300 MB of addresses a library waits for more of them for ever."""
    limits = {resource.RLIMIT_AS: (300 << 20, resource.RLIM_INFINITY)}
    others = resource.getrlimit
    monkeypatch.setattr(resource, "getrlimit", lambda what: limits.get(what) or others(what))
    with pytest.raises(InputError, match="512 MB, got 300 MB"):
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


def test_daemon_imports_no_package_of_other_commands() -> None:
    """Its start does not wait for optimisers, pictures or web servers."""
    program = "import sys, controller.daemon.daemon; print(*sys.modules)"
    modules = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "scipy.linalg" in modules
    assert not set(modules) & {"scipy.optimize", "scipy.ndimage", "matplotlib", "aiohttp"}


def test_stop_exits_with_3_and_names_amplifiers_unless_all_are_silent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Success only if every amplifier is confirmed silent, or else the unconfirmed ones."""
    modules = ["controller.cli.commands"]
    with ScriptedDaemon(tmp_path) as daemon:
        command = ["stop", "--socket", str(daemon.socket)]
        assert run(command, modules) == 0
        daemon.silence = UNCONFIRMED
        assert run(command, modules) == 3
        errors = capsys.readouterr().err
        assert re.search(r"side .*0\.20 s.*rear", errors)
        assert "main" not in errors
    assert run(command, modules) == 3


def test_help_of_watch_names_every_topic() -> None:
    """Those of the API, though help does not load it."""
    said = CliRunner().invoke(app, ["watch", "--help"]).output
    assert [topic for topic in TOPICS if topic not in said] == []


@in_virtual_time
async def test_daemon_stays_disarmed_and_latched_after_link_loss_while_armed(
    tmp_path: Path,
) -> None:
    """COMM_LOST ends pattern and lease; with the amplifier back there is a fault to clear."""
    async with ready_daemon(tmp_path) as (bench, era):
        await era.arm("me", lease_s=30)
        async with holding(era, far=bench.far):
            await era.subscribe("state")
            assert (await next_event(era, "state")).data["new"] == ENABLED
            await era.subscribe("link", "pattern", "silence")
            assert (await next_event(era, "pattern")).data["drive"]
            bench.far.device.inject_fault(FaultWindow(fault="hang"))
            await until_state(era, "COMM_LOST")
            status = await era.status()
            assert status.armed_by is None
            assert status.remedy
            ended = [(await next_event(era, "link", "silence")) for _ in range(3)]
            links = [event.data for event in ended if event.topic == "link"]
            assert [(each["event"], each["amplifier"]) for each in links] == [
                *(("degraded", "main"), ("lost", "main")),
            ]
            data = {event.topic: event.data for event in ended}
            assert "no reply within 30 ms" in data["silence"]["reason"]
        assert (await era.status()).drive == {}
        assert await error_code(era.arm("me")) is ErrorCode.WRONG_STATE
        assert await error_code(era.clear()) is ErrorCode.LINK
        assert await error_code(era.stop()) is ErrorCode.NOT_SILENT
        bench.far.device.recover()
        await until_state(era, "FAULT")
        assert not (await era.status()).assume_energised
        assert bench.far.summary().state != "OPERATION_ENABLED"
        await era.clear()
        await until_state(era, READY)
        await era.arm("me")


@in_virtual_time
async def test_readings_are_shown_with_their_unit_to_their_step(tmp_path: Path) -> None:
    """A temperature in steps of 0.1 °C, by `era status` and by a page."""
    async with ready_daemon(tmp_path) as (_, era):
        assert (await era.hello("test")).readings["temperature_c"] == ("Temperature", "°C", 1)
        assert "temperature 25.0 °C" in show_status(await era.status())


@in_virtual_time
async def test_status_tells_lost_amplifier_from_one_closed_with_it(tmp_path: Path) -> None:
    """Of two amplifiers: while one is lost, during all attempts; and once both are."""
    present, lost, closed = (False, False), (True, False), (False, True)
    async with (
        far_end(tmp_path, changes=TWO_AMPLIFIERS) as far,
        daemon_at(far, tmp_path, changes=TWO_AMPLIFIERS) as bench,
        await bench.client() as era,
    ):

        async def losses() -> dict[str, tuple[bool, bool]]:
            amplifiers = (await era.status()).amplifiers
            return {each.name: (each.lost, each.closed_with_lost) for each in amplifiers}

        async def until_losses(**expected: tuple[bool, bool]) -> None:
            for _ in range(1000):
                if await losses() == expected:
                    return
                await asyncio.sleep(0.01)
            pytest.fail(f"{await losses()} instead of {expected}")

        await until_state(era, READY)
        assert await losses() == {"main": present, "side": present}
        far.devices["side"].inject_fault(FaultWindow(fault="hang"))
        await until_losses(main=closed, side=lost)
        await era.subscribe("link")
        begun = lost_for = (await era.status()).lost_for_s or 0.0
        while lost_for < begun + 0.6:  # an attempt to reopen them
            assert await losses() == {"main": closed, "side": lost}
            status = await era.status()
            lost_for = status.lost_for_s or 0.0
            await asyncio.sleep(0.01)
        retry = await era.next_event()
        while retry is not None and retry.data["event"] == "lost":  # may follow the status
            assert retry.data["amplifier"] == "side"
            retry = await era.next_event()
        assert retry is not None
        assert (retry.data["event"], retry.data["amplifier"]) == ("retry", "side")
        main, side = (line for line in show_status(status).splitlines() if "serial://" in line)
        assert re.search(r"amplifier main .*\): closed ", main)
        assert re.search(r"amplifier side .*\): LOST, ", side)
        far.devices["main"].inject_fault(FaultWindow(fault="hang"))
        await until_losses(main=lost, side=lost)
        far.devices["side"].recover()
        await until_losses(main=lost, side=closed)
        assert await error_code(era.disarm()) is ErrorCode.NOT_SILENT  # it is a stop then


@in_virtual_time
async def test_reload_applies_a_layout_alone(tmp_path: Path) -> None:
    """While armed a lower level; no higher one, invalid one or one beside another change."""
    async with ready_daemon(tmp_path, "level_db_sl: 20\n# more\n") as (bench, era):
        await era.arm("me", lease_s=30)
        path = tmp_path / "daemon.yaml"
        original = path.read_text("utf-8")

        async def reload(*changes: tuple[str, str], refused: str = "") -> float:
            text = original
            for old, new in changes:
                assert old in text
                text = text.replace(old, new)
            path.write_text(text, "utf-8")
            verdict = await era.reload()
            assert verdict.reloaded is not bool(refused)
            assert refused in verdict.reasons[0]
            return bench.daemon._config.section.level_db_sl

        level = "level_db_sl: "
        assert await reload((f"{level}20", f"{level}10")) == 10
        await era.subscribe("pattern")
        async with holding(era, far=bench.far):
            await next_event(era, "pattern")  # reported after it plays
            (contact,) = (await era.status()).contacts
        assert 9.99 < contact.level_db_sl < 16  # single precision
        lower = (f"{level}20", f"{level}5")
        assert await reload((f"{level}20", f"{level}21"), refused="while armed") == 10
        assert await reload((f"{level}20", f"{level}loud"), refused="level_db_sl") == 10
        assert await reload(("rig: rig", "rig: bench"), lower, refused="rig: ") == 10
        page = ("# more", "dashboard: 127.0.0.1:1")
        assert await reload(page, lower, refused="dashboard: ") == 10
        await era.disarm()
        await until_state(era, READY)
        assert await reload((f"{level}20", f"{level}21")) == 21


def test_gateway_keeps_its_token_out_of_a_log(tmp_path: Path) -> None:
    """Not on a terminal, it reads it from a file of the owner instead of printing it."""
    *_, option, file = gateway_options("127.0.0.1:0", tmp_path / "era.sock")
    assert option == "--token-file"
    assert len(read_token(Path(file))) >= 32  # which refuses a file that others may read


@in_virtual_time
async def test_status_has_the_reasons_of_now_and_latencies_of_touches_apart(tmp_path: Path) -> None:
    """Why nothing plays, before and after arming; why a lost amplifier stays so, and why it was.

    Of four touches, one of them a move, and of three lifts the latencies are counted apart.
    """
    async with ready_daemon(tmp_path) as (bench, era):
        await era.arm("me", lease_s=60)
        await until(lambda: bench.daemon._publisher.view.report is not None)
        assert "no contact" in ((await era.status()).silence_reason or "")
        for places in ([ON_PAD], [], [ON_PAD], [ON_QUIET], [], [ON_PAD], []):
            for _ in range(4):
                await era.touch(places)
                await asyncio.sleep(0.05)
        status = await era.status()
        assert status.lift_latency_ms is not None
        assert (status.latency_ms.count, status.lift_latency_ms.count) == (4, 1 + 3)  # and to arm
        await era.disarm()
        await asyncio.sleep(0.1)
        assert (await era.status()).silence_reason is None
        assert bench.daemon._publisher.view.silence_event() is None
        identity = bench.far.device.identity
        before, identity["serial_number"] = identity["serial_number"], "A1"  # another one
        bench.far.device.inject_fault(FaultWindow(fault="hang"))
        await until_state(era, "COMM_LOST")
        assert "no reply" in (await era.status()).cause
        bench.far.device.recover()
        await until(lambda: "A1" in bench.daemon._supervisor.operation.cause)
        assert "cables" not in ((await era.status()).remedy or "")
        identity["serial_number"] = before
        seen = []
        await era.subscribe("state")
        while not seen or seen[-1]["new"] != READY:
            seen.append((await next_event(era, "state")).data)
        assert any("before: " in each["cause"] and "no reply" in each["cause"] for each in seen)


LAYOUT = """\
effects:
  hum: {kind: buzz, level: 14}
  alert: {kind: buzz, duration: 10 s, level: 18}
regions:
  pad: {rectangle: {start: [0, 0], end: [0.15, 0.15]}, on_press: hum}
  quiet: {rectangle: {start: [0.16, 0], end: [0.3, 0.15]}}
elsewhere: null
"""
ON_PAD, ON_QUIET = (0.1, 0.1), (0.25, 0.1)


@in_virtual_time
async def test_daemon_plays_effects_by_region_and_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A region's effect plays at its own level; a request needs a finger and at most that level."""
    (tmp_path / "layout.yaml").write_text(LAYOUT, encoding="utf-8")
    async with ready_daemon(tmp_path, "layouts: {panel: layout.yaml}\n") as (bench, era):
        view = bench.daemon._publisher.view

        async def level_of(effect: str) -> float | None:
            await until(lambda: [each.effect for each in view.contact_statuses()] == [effect])
            await until(lambda: view.applied is not None)
            return view.contact_statuses()[0].level_db_sl

        layout = (await era.hello("test")).layout
        assert layout is not None
        assert [region["name"] for region in layout["regions"]] == ["pad", "quiet"]
        assert layout["regions"][0] | {"x_m": 0.0, "width_m": 0.15} == layout["regions"][0]
        listed = {each.name: each for each in (await era.effects()).effects}
        assert listed.keys() == {"alert", "hum", *default_effects()}
        assert (listed["alert"].kind, listed["alert"].parameters["duration"]) == ("buzz", 10.0)
        assert await error_code(era.play("alert", ON_QUIET)) is ErrorCode.WRONG_STATE
        await era.arm("me", lease_s=60)
        async with holding(era, ON_PAD):
            assert await level_of("hum") == pytest.approx(14, abs=0.01)
        await era.touch([])
        async with holding(era, ON_QUIET):
            await until(lambda: [each.effect for each in view.contact_statuses()] == [None])
            await until(lambda: not any(bench.far.summary().levels))
            assert (await era.status()).silence_reason
            for effect, place, level in (
                ("alert", ON_PAD, None),  # no finger there
                ("unknown", ON_QUIET, None),
                ("alert", ON_QUIET, 18.1),
                ("alert", ON_QUIET, -20.1),  # no answer has such levels: all would be silent
            ):
                refused = era.play(effect, place, level_db_sl=level)
                assert await error_code(refused) is ErrorCode.REFUSED
            decided: list[bool] = []
            request_update = bench.daemon._controller.cycle.request_update
            monkeypatch.setattr(
                bench.daemon._controller.cycle,
                "request_update",
                lambda: (decided.append(True), request_update()),
            )
            await era.play("alert", ON_QUIET, level_db_sl=12)
            assert decided  # not with the next heartbeat
            assert await level_of("alert") == pytest.approx(12, abs=0.5)
            steady = [(0.0, 1.0, 0.5), (30.0, 1.0, 0.5)]
            for played, loop, level, words in (
                ([*reversed(steady)], False, None, r"points\[1\] time_s must be 30 to 60, got 0"),
                ([(0.0, 1.1, 0.5)], False, None, r"points\[0\] intensity must be 0 to 1"),
                (steady, False, 20.1, "^level must be from -20 to 20 dB SL, got 20.1"),
                ("alert", True, None, "loop must be left out"),
            ):
                with pytest.raises(RpcError, match=words):
                    await era.play(played, ON_QUIET, level_db_sl=level, loop=loop)
            await era.play(steady, ON_QUIET, level_db_sl=12, loop=True)
            assert await level_of("points") == pytest.approx(12, abs=0.5)
            assert (await era.status()).silence_reason is None


@in_virtual_time
async def test_a_radius_beyond_a_fingers_is_a_hand_in_the_status(tmp_path: Path) -> None:
    """Of 13 mm, over the API, beside a finger of 5 mm and one without a radius."""
    touches = [
        TouchPoint(id=number, x_m=0.05 * number, y_m=0.1, radius_m=radius)
        for number, radius in enumerate((0.013, 0.005, None), start=1)
    ]
    async with ready_daemon(tmp_path) as (_, era):
        await era.request("touch", TouchParams(source="pad", touches=touches))
        status = await era.status()
        assert [each.role for each in status.contacts] == ["hand", None, None]
        assert "m: hand, load 12.0" in show_status(status)
