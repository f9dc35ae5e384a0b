import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pytest
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner

from drivers.cli import EXIT_STATUS, app
from drivers.discovery.search import candidates
from drivers.errors import CommandError, CommandRefused, FrameError, LinkError, LinkTimeout
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Disarm,
    Fault,
    GetCaps,
    GetStatus,
    Hello,
    Nak,
    NakCode,
    Ping,
    Stop,
)
from drivers.registry import known_schemes
from scripted_amplifier import FarEnd
from vendor_pages import ARMED

T = TypeVar("T")


class BackgroundFarEnd:
    """A scripted far end in an event loop of its own, for commands that run one themselves."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self.end = self.run(self._make())

    async def _make(self) -> FarEnd:
        return FarEnd()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """The result of a coroutine in the far end's loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(10)

    def close(self) -> None:

        async def close() -> None:
            self.end.close()

        self.run(close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@pytest.fixture
def background() -> Iterator[BackgroundFarEnd]:
    """A far end that answers while a command runs."""
    background = BackgroundFarEnd()
    yield background
    background.close()


def test_identify_in_json(background: BackgroundFarEnd) -> None:
    """One JSON object whose keys carry the units."""
    result = CliRunner().invoke(app, ["amp", "identify", background.end.url, "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["serial_number"] == "A-17"
    assert answer["channels"] == 4
    assert (answer["frequency_min_hz"], answer["frequency_max_hz"]) == (20.0, 600.0)
    assert answer["watchdog_min_s"] == 0.1


def test_status_stop_and_clear(background: BackgroundFarEnd) -> None:
    """Status tells state, levels and faults; stop and clear are sent as such."""
    result = CliRunner().invoke(app, ["amp", "status", background.end.url, "--json"])
    answer = json.loads(result.stdout)
    assert (answer["state"], answer["levels"]) == ("OPERATION_ENABLED", [0.0] * 4)
    assert (answer["temperature_c"], answer["faults"]) == (25.0, [])
    result = CliRunner().invoke(app, ["amp", "stop", background.end.url])
    assert result.exit_code == 0
    assert re.findall(r"^(?:state|high_voltage|levels) +(.*)$", result.stdout, re.MULTILINE) == [
        "OPERATION_ENABLED",
        "yes",
        "0, 0, 0, 0",
    ]
    assert isinstance(background.end.requests[-1], Stop)
    result = CliRunner().invoke(app, ["amp", "clear", background.end.url])
    assert result.exit_code == 0
    assert isinstance(background.end.requests[-1], Clear)


def test_drive_plays_and_ends_silent(background: BackgroundFarEnd) -> None:
    """Arm, one set on one channel, heartbeats, and a disarm at the end."""
    options = ["--channel", "2", "--frequency", "123.45", "--level", "0.3", "--for", "0.12"]
    result = CliRunner().invoke(app, ["amp", "drive", background.end.url, *options, "--json"])
    assert result.exit_code == 0, result.output
    (achieved,) = json.loads(result.stdout)["achieved"]
    assert achieved == {"channel": 2, "frequency_hz": 123.45, "level": 0.3, "phase_deg": 0.0}
    kinds = [type(request) for request in background.end.requests[2:]]
    assert kinds[:2] == [Arm, Apply]
    assert Ping in kinds
    assert kinds[-2] is Disarm
    apply = background.end.requests[3]
    assert apply.command_set.valid_for == 0.12


def test_a_refused_drive_is_disarmed(background: BackgroundFarEnd) -> None:
    """Where the set is refused the amplifier does not stay armed."""
    usual = background.end.answer
    background.end.answer = lambda request, frame: (
        Nak(NakCode.BAD_VALUE) if isinstance(request, Apply) else usual(request, frame)
    )
    result = CliRunner().invoke(app, ["amp", "drive", background.end.url])
    assert isinstance(result.exception, CommandRefused)
    assert isinstance(background.end.requests[-1], Disarm)


def test_a_drive_that_the_amplifier_ends_is_no_success(background: BackgroundFarEnd) -> None:
    """A fault during a drive is reported, and the amplifier is disarmed."""
    usual = background.end.answer
    arc = replace(ARMED, state=AmplifierState.FAULT, fault=Fault.ARC)
    background.end.answer = lambda request, frame: (
        arc if isinstance(request, Ping) else usual(request, frame)
    )
    result = CliRunner().invoke(app, ["amp", "drive", background.end.url, "--for", "5"])
    assert isinstance(result.exception, CommandRefused)
    assert "FAULT, fault ARC" in str(result.exception)
    assert isinstance(background.end.requests[-1], Disarm)


@pytest.mark.parametrize(
    "options",
    [
        ["--level", "1.1"],
        ["--frequency", "nan"],
        ["--channel", "4"],
        ["--for", "0"],
        ["--for", "nan"],
    ],
)
def test_a_bad_drive_never_arms(background: BackgroundFarEnd, options: list[str]) -> None:
    """An invalid drive is bad input and does not change the amplifier."""
    result = CliRunner().invoke(app, ["amp", "drive", background.end.url, *options])
    assert isinstance(result.exception, CommandError)
    assert not any(isinstance(request, Arm) for request in background.end.requests)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_silent(background: BackgroundFarEnd, number: signal.Signals) -> None:
    """An interrupt or an order to end in the middle of a drive disarms before the process ends."""
    command = [sys.executable, "-P", "-c", "from controller.cli.main import main; exit(main())"]
    process = subprocess.Popen(
        [*command, "amp", "drive", background.end.url, "--for", "30"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "NO_COLOR": "1"},
    )

    async def driven() -> None:
        async with asyncio.timeout(10):
            while not any(isinstance(request, Ping) for request in background.end.requests):
                await background.end.count(len(background.end.requests) + 1)

    try:
        background.run(driven())
        process.send_signal(number)
        assert process.wait(timeout=10) == 130
    finally:
        process.kill()
        process.wait()
    assert isinstance(background.end.requests[-1], Disarm)


@pytest.mark.parametrize(
    ("error", "status"),
    [(CommandError, 2), (CommandRefused, 1), (LinkError, 3), (LinkTimeout, 3), (FrameError, 3)],
)
def test_every_error_has_its_exit_status(error: type[Exception], status: int) -> None:
    """1 the answer is no, 2 bad input, 3 hardware or link."""
    found = {code for kind, code in EXIT_STATUS.items() if issubclass(error, kind)}
    assert found == {status}


def test_conformance_says_what_is_kept_and_what_is_not(background: BackgroundFarEnd) -> None:
    """Over a far end that is armed from the first, looking shows it: exit 1, and nothing driven."""
    result = CliRunner().invoke(
        app, ["amp", "conformance", background.end.url, "--write", "--json"]
    )
    assert result.exit_code == 1, result.output
    answer = json.loads(result.stdout)
    problems = {row["check"]: row["problem"] for row in answer["checks"]}
    assert not answer["kept"]
    assert "OPERATION_ENABLED" in problems["starts_disarmed"]
    assert problems["identity"] is None
    assert answer["left_out"] > 10
    assert not any(isinstance(request, Arm | Apply) for request in background.end.requests)


def test_discover_asks_who_is_there_and_nothing_else(background: BackgroundFarEnd) -> None:
    """A URL that answers is named, one that does not is no error; only Hello and GetCaps go out."""
    urls = [background.end.url, "serial:///dev/no-such-port"]
    result = CliRunner().invoke(app, ["amp", "discover", *urls, "--no-probe", "--json"])
    assert result.exit_code == 0, result.output
    (found,) = json.loads(result.stdout)["amplifiers"]
    assert (found["url"], found["serial_number"]) == (background.end.url, "A-17")
    assert background.end.requests == [Hello(), GetCaps()]


def test_discover_tells_how_to_mend_permissions(monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that this user may not use is listed with its group, and is not asked."""
    monkeypatch.setattr("drivers.discovery.search.comports", lambda: [ListPortInfo("/dev/null")])
    monkeypatch.setattr("drivers.discovery.search.os.access", lambda path, mode: False)
    (place,) = [one for one in candidates() if one.place == "/dev/null"]
    assert place.description == "serial port"  # pyserial has n/a where nothing is known
    assert "usermod -aG" in (place.remedy or "")
    assert "chmod a+rw /dev/null" in (place.remedy or "")


def test_discover_suggests_no_group_that_may_not_either(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A port that only its owner may use is not mended by joining its group."""
    port = tmp_path / "tty"
    port.touch(mode=0o600)
    monkeypatch.setattr("drivers.discovery.search.comports", lambda: [ListPortInfo(str(port))])
    monkeypatch.setattr("drivers.discovery.search.os.access", lambda path, mode: False)
    (place,) = [one for one in candidates() if one.place == str(port)]
    assert "usermod" not in (place.remedy or "")
    assert f"chmod a+rw {port}" in (place.remedy or "")


def test_discover_says_why_a_port_could_not_be_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that cannot be opened has a reason; a missing reply has none."""
    monkeypatch.setattr(
        "drivers.discovery.search.comports", lambda: [ListPortInfo("/dev/no-such-port")]
    )
    monkeypatch.setattr("drivers.discovery.search.os.access", lambda path, mode: True)
    result = CliRunner().invoke(app, ["amp", "discover"])
    assert result.exit_code == 0, result.output
    assert "no such port" in result.stdout


def test_the_page_of_commands_names_what_is_printed(background: BackgroundFarEnd) -> None:
    """Status, drive, stop and clear have the keys of their row, and status those of its wire."""
    page = (Path(__file__).parents[2] / "docs" / "reference" / "commands.md").read_text("utf-8")
    (row,) = re.findall(r"^\| `era amp status`.* \| (.*) \|$", page, re.MULTILINE)
    everyone, of_status, of_drive = re.split(r"; of `status`|, of `drive`", row)
    (wire,) = re.findall(r"^\| `era amp identify` .* what it allows: (.*) \|$", page, re.MULTILINE)
    beside = {"status": of_status + wire, "drive": of_drive, "stop": "", "clear": ""}
    for command, more in beside.items():
        result = CliRunner().invoke(app, ["amp", command, background.end.url, "--json"])
        assert set(json.loads(result.stdout)) == set(re.findall(r"`(\w+)`", everyone + more))


def test_identify_says_what_the_wire_allows(background: BackgroundFarEnd) -> None:
    """At 115 200 baud: 50 and 46 bytes are 8.33 ms, 120 sets a second, a watchdog of 158 ms."""
    url = f"{background.end.url}?baud=115200"
    answer = json.loads(CliRunner().invoke(app, ["amp", "identify", url, "--json"]).stdout)
    assert answer["wire_round_trip_s"] == pytest.approx(96 * 10 / 115200, abs=1e-6)
    assert answer["sets_per_second_max"] == 120
    assert answer["watchdog_shortest_s"] == pytest.approx(0.15 + 96 * 10 / 115200, abs=1e-6)


def test_a_drive_over_too_slow_a_line_never_arms(background: BackgroundFarEnd) -> None:
    """At 4800 baud three heartbeats and a round trip do not fit into the watchdog."""
    result = CliRunner().invoke(app, ["amp", "drive", f"{background.end.url}?baud=4800"])
    assert isinstance(result.exception, CommandError)
    assert "350 ms" in str(result.exception)
    assert not any(isinstance(request, Arm) for request in background.end.requests)


def test_a_drive_after_a_stop_says_how_to_clear(background: BackgroundFarEnd) -> None:
    """The state, the fault and the command that acknowledges it, as a shell takes the URL."""
    usual = background.end.answer
    stopped = replace(ARMED, state=AmplifierState.QUICK_STOP_ACTIVE)
    background.end.answer = lambda request, frame: (
        Nak(NakCode.WRONG_STATE)
        if isinstance(request, Arm)
        else stopped
        if isinstance(request, GetStatus)
        else usual(request, frame)
    )
    url = f"{background.end.url}?baud=115200"
    result = CliRunner().invoke(app, ["amp", "drive", url])
    assert isinstance(result.exception, CommandRefused)
    assert "QUICK_STOP_ACTIVE" in str(result.exception)
    assert str(result.exception).endswith(f"era amp clear '{url}'")
    result = CliRunner().invoke(app, ["amp", "stop", url])
    assert result.stdout.splitlines()[-1] == f"Next: era amp clear '{url}'"


def test_the_help_shows_urls_of_all_wires() -> None:
    """Every scheme, but for another spelling of a serial server and the bus inside a program."""
    shown = CliRunner().invoke(app, ["amp", "--help"]).stdout
    for scheme in set(known_schemes()) - {"socket", "can+virtual"}:
        assert f"  {scheme}://" in shown
