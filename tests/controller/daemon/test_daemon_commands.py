"""A daemon in virtual time: requests of clients, its commands, actions at the amplifier, events."""

import os
import re
import resource
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controller.api.link import Notification
from controller.api.methods import TOPICS
from controller.cli.commands import app
from controller.cli.main import run
from controller.cli.status_text import show_event, show_status
from controller.daemon.children import gateway_options
from controller.daemon.daemon import run_daemon
from controller.gateway.gateway_settings import read_token
from controller.process.log import LogThread
from daemons import (
    ready_daemon,
    write_daemon,
)
from drivers.errors import CommandError
from gateway_bench import UNCONFIRMED, ScriptedDaemon
from model.errors import InputError
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
async def test_readings_are_shown_with_their_unit_to_their_step(tmp_path: Path) -> None:
    """A temperature in steps of 0.1 °C, by `era status` and by a page."""
    async with ready_daemon(tmp_path) as (_, era):
        assert (await era.hello("test")).readings["temperature_c"] == ("Temperature", "°C", 1)
        assert "temperature 25.0 °C" in show_status(await era.status())


def test_gateway_keeps_its_token_out_of_a_log(tmp_path: Path) -> None:
    """Not on a terminal, it reads it from a file of the owner instead of printing it."""
    *_, option, file = gateway_options("127.0.0.1:0", tmp_path / "era.sock")
    assert option == "--token-file"
    assert len(read_token(Path(file))) >= 32  # which refuses a file that others may read
