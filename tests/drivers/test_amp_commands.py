import asyncio
import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pytest
from click.testing import Result
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner

from drivers.cli import app
from drivers.discovery.places import candidates
from drivers.errors import CommandError, CommandRefused
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Disarm,
    Fault,
    GetCaps,
    Hello,
    Nak,
    NakCode,
    Ping,
    Reply,
    Stop,
)
from model.rig.file import example_rig_path
from patient_daemon import PROGRAM, wait_long
from scripted_amplifier import FarEnd
from sim.amplifier.amplifier import SimulatedAmplifier
from vendor_pages import ARMED, PLAYING

T = TypeVar("T")


class BackgroundFarEnd:
    """A scripted far end in an event loop of its own, for commands that run one themselves."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self.end = self.run(self._do(FarEnd))

    async def _do(self, work: Callable[[], T]) -> T:
        return work()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Return the result of a coroutine in that loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(180)

    def replies(self, **replies: Reply) -> None:
        """Reply otherwise to requests of these types."""
        self.end.answer = lambda request, _: (
            replies.get(type(request).__name__) or self.end.usual_reply(request)
        )

    def simulate(self, **replies: Reply) -> None:
        """Reply as a simulated amplifier, but otherwise to requests of these types."""
        amplifier = SimulatedAmplifier("A-17", channels=4)
        self.end.answer = lambda request, _: (
            replies.get(type(request).__name__) or amplifier.handle(request, time.monotonic())
        )

    def close(self) -> None:
        self.run(self._do(self.end.close))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@pytest.fixture
def background(monkeypatch: pytest.MonkeyPatch) -> Iterator[BackgroundFarEnd]:
    """A far end that replies while a command runs, which waits for it as long as it takes."""
    wait_long(monkeypatch)
    background = BackgroundFarEnd()
    yield background
    background.close()


def invoke(*args: str) -> Result:
    """Run `era amp` with these arguments."""
    return CliRunner().invoke(app, ["amp", *args])


def result_of(*args: str) -> dict[str, Any]:
    """Run `era amp` with these arguments and --json; its result."""
    result = invoke(*args, "--json")
    assert result.exit_code == 0, result.output
    parsed: dict[str, Any] = json.loads(result.stdout)
    return parsed


def test_identify_reports_identity_capabilities_and_wire(background: BackgroundFarEnd) -> None:
    """At 115 200 baud: 53 and 47 bytes are 8.68 ms, 115 sets a second, a watchdog of 159 ms."""
    answer = result_of("identify", f"{background.end.url}?baud=115200")
    assert (answer["serial_number"], answer["channels"]) == ("A-17", 4)
    assert (answer["frequency_min_hz"], answer["frequency_max_hz"]) == (20.0, 600.0)
    assert answer["watchdog_min_s"] == 0.1
    assert answer["wire_round_trip_s"] == pytest.approx(100 * 10 / 115200, abs=1e-6)
    assert answer["sets_per_second_max"] == 115
    assert answer["watchdog_shortest_s"] == pytest.approx(0.15 + 100 * 10 / 115200, abs=1e-6)


def test_status_stop_and_clear(background: BackgroundFarEnd) -> None:
    """State, levels and faults; stop and clear are sent as such."""
    answer = result_of("status", background.end.url)
    assert (answer["state"], answer["levels"]) == ("OPERATION_ENABLED", [0.0] * 4)
    assert (answer["temperature_c"], answer["faults"]) == (25.0, [])
    background.end.requests.clear()
    result = invoke("stop", background.end.url)
    assert result.exit_code == 0
    shown = re.findall(r"^(?:silence|high_voltage|levels) +(.*)$", result.stdout, re.MULTILINE)
    assert shown == ["confirmed_silent", "yes", "0, 0, 0, 0"]
    assert background.end.requests[:2] == [Stop(0.005), Hello()]
    assert invoke("clear", background.end.url).exit_code == 0
    assert isinstance(background.end.requests[-1], Clear)


@pytest.mark.parametrize("reply", [None, ARMED, PLAYING])
def test_unconfirmed_stop_exits_3(
    background: BackgroundFarEnd, reply: Reply | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No reply, or one from an amplifier that could play or does; the Stop is repeated."""
    monkeypatch.setattr("drivers.amp_actions._STOP_TIMEOUT", 0.2)
    background.end.answer = lambda request, _: reply
    result = invoke("stop", background.end.url, "--json")
    assert result.exit_code == 3
    answer = json.loads(result.stdout)
    assert (answer["silence"], answer["may_play_for_s"]) == ("may_play", None)
    assert background.end.requests.count(Stop(0.005)) > 0
    assert isinstance(background.end.requests[0], Stop)


def test_stop_at_a_missing_port_exits_3() -> None:
    """Nothing could be sent."""
    result = invoke("stop", "serial:///dev/no-such-port", "--json")
    assert result.exit_code == 3
    assert "no such port" in json.loads(result.stdout)["cause"]


def test_trace_shows_frames_and_requests(background: BackgroundFarEnd, tmp_path: Path) -> None:
    """Both directions and layers of a command."""
    trace = tmp_path / "trace.txt"
    assert invoke("status", background.end.url, "--trace", str(trace)).exit_code == 0
    text = trace.read_text("utf-8")
    assert re.search(r" request GetStatus\(\) -> Status\(.* in [\d.]+ ms$", text, re.MULTILINE)


def test_stop_needs_no_trace(background: BackgroundFarEnd, tmp_path: Path) -> None:
    """With a trace file that cannot be written it stops, while other commands do nothing."""
    options = ("--trace", str(tmp_path / "missing" / "trace.txt"))
    assert isinstance(invoke("clear", background.end.url, *options).exception, CommandError)
    assert background.end.requests == []
    invoke("stop", background.end.url, *options)
    assert isinstance(background.end.requests[0], Stop)


def test_drive_plays_and_ends_silent(background: BackgroundFarEnd) -> None:
    """Arm, one set on one channel, heartbeats, and a disarm at the end."""
    options = ["--channel", "2", "--frequency", "123.45", "--level", "0.3", "--for", "0.12"]
    background.simulate()
    (achieved,) = result_of("drive", background.end.url, *options)["achieved"]
    assert achieved == {"channel": 2, "frequency_hz": 123.45, "level": 0.3, "phase_deg": 0.0}
    arm, apply, *others = background.end.requests[3:]
    assert isinstance(arm, Arm)
    assert isinstance(apply, Apply)
    assert apply.command_set.valid_for == 0.12
    assert Ping(arm.session) in others
    assert isinstance(others[-2], Disarm)


@pytest.mark.parametrize(
    ("replies", "problem"),
    [
        ({"Apply": Nak(NakCode.BAD_VALUE)}, "Apply"),
        (
            {"Ping": replace(ARMED, state=AmplifierState.FAULT, fault=Fault.ARC)},
            "FAULT with fault ARC",
        ),
        ({"Ping": ARMED}, "playing set"),
    ],
)
def test_failed_drive_is_disarmed(
    background: BackgroundFarEnd, replies: dict[str, Reply], problem: str
) -> None:
    """A refused set, a fault, or heartbeats without the set are reported."""
    background.simulate(**replies)
    result = invoke("drive", background.end.url, "--for", "5")
    assert isinstance(result.exception, CommandRefused)
    assert problem in str(result.exception)
    assert isinstance(background.end.requests[-1], Disarm)


@pytest.mark.parametrize(
    ("query", "options"),
    [
        ("", ["--level", "1.1"]),
        ("", ["--frequency", "nan"]),
        ("", ["--channel", "4"]),
        ("", ["--for", "0"]),
        ("", ["--for", "nan"]),
        ("?baud=4800", []),  # too slow for three heartbeats and a round trip
    ],
)
def test_invalid_drive_never_arms(
    background: BackgroundFarEnd, query: str, options: list[str]
) -> None:
    """It is bad input and does not change the amplifier."""
    result = invoke("drive", background.end.url + query, *options)
    assert isinstance(result.exception, CommandError)
    assert not any(isinstance(request, Arm) for request in background.end.requests)


def test_drive_after_a_stop_names_the_clear_command(background: BackgroundFarEnd) -> None:
    """State, fault and remedy, with the URL quoted for a shell."""
    stopped = replace(ARMED, state=AmplifierState.QUICK_STOP_ACTIVE)
    background.replies(Arm=Nak(NakCode.WRONG_STATE), GetStatus=stopped)
    url = f"{background.end.url}?baud=115200"
    result = invoke("drive", url)
    assert isinstance(result.exception, CommandRefused)
    assert "QUICK_STOP_ACTIVE" in str(result.exception)
    assert str(result.exception).endswith(f"era amp clear '{url}'")
    assert invoke("stop", url).stdout.splitlines()[-1] == f"Next: era amp clear '{url}'"


def test_terminated_drive_ends_silent(background: BackgroundFarEnd) -> None:
    """SIGTERM during a drive disarms before the process ends."""
    process = subprocess.Popen(
        [*PROGRAM, "amp", "drive", background.end.url, "--for", "60"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "NO_COLOR": "1"},
    )

    async def driven() -> None:
        async with asyncio.timeout(120):
            while not any(isinstance(request, Ping) for request in background.end.requests):
                await background.end.count(len(background.end.requests) + 1)

    try:
        background.run(driven())
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=120) == 130
    finally:
        process.kill()
        process.wait()
    assert isinstance(background.end.requests[-1], Disarm)


def test_conformance_stops_after_a_failed_reading_check(background: BackgroundFarEnd) -> None:
    """An amplifier that is armed already: exit status 1, and nothing is driven."""
    background.simulate(GetStatus=ARMED)
    result = invoke("conformance", background.end.url, "--write", "--json")
    assert result.exit_code == 1, result.output
    answer = json.loads(result.stdout)
    rows = {row["name"]: row for row in answer["checks"]}
    assert (answer["overall"], answer["failed"]) == ("failed", 1)
    assert "OPERATION_ENABLED" in rows["starts_disarmed"]["seen"]
    assert rows["starts_disarmed"]["place"] == "wire-protocol.md#states"
    assert rows["identity"]["result"] == "passed"
    assert answer["not_run"] > 40
    assert not any(isinstance(request, Arm | Apply) for request in background.end.requests)


def test_discover_only_identifies(background: BackgroundFarEnd) -> None:
    """Only Hello and GetCaps are sent; a URL without a reply is no error."""
    urls = [background.end.url, "serial:///dev/no-such-port"]
    (found,) = result_of("discover", *urls, "--no-probe")["amplifiers"]
    assert (found["url"], found["serial_number"]) == (background.end.url, "A-17")
    assert background.end.requests == [Hello(), GetCaps()]


@pytest.mark.parametrize(("mode", "helps_group"), [(0o660, True), (0o600, False)])
def test_discover_suggests_a_group_that_has_permission(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, mode: int, helps_group: bool
) -> None:
    """Else only a temporary remedy."""
    port = tmp_path / "tty"
    port.touch()
    port.chmod(mode)
    monkeypatch.setattr("drivers.discovery.places.comports", lambda: [ListPortInfo(str(port))])
    monkeypatch.setattr("drivers.discovery.places.os.access", lambda path, mode: False)
    (place,) = [one for one in candidates() if one.name == str(port)]
    assert place.description == "serial port"  # pyserial reports n/a
    assert ("usermod -aG" in (place.remedy or "")) == helps_group
    assert f"chmod a+rw {port}" in (place.remedy or "")


def test_discover_reports_why_a_port_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason stands with the port."""
    port = ListPortInfo("/dev/no-such-port")
    monkeypatch.setattr("drivers.discovery.places.comports", lambda: [port])
    monkeypatch.setattr("drivers.discovery.places.os.access", lambda path, mode: True)
    result = invoke("discover")
    assert result.exit_code == 0, result.output
    assert "no such port" in result.stdout


def test_results_have_the_documented_keys(background: BackgroundFarEnd) -> None:
    """Those of docs/reference/commands.md."""
    page = (Path(__file__).parents[2] / "docs" / "reference" / "commands.md").read_text("utf-8")
    (row,) = re.findall(r"^\| `era amp status`.* \| (.*) \|$", page, re.MULTILINE)
    common, of_status, of_drive, of_stop = re.split(r"[;,] \w+ `(?:status|drive|stop)`", row)
    (wire,) = re.findall(r"^\| `era amp identify` .*: (.*) \|$", page, re.MULTILINE)
    beside = {"status": of_status + wire, "drive": of_drive, "stop": of_stop, "clear": ""}
    background.simulate()
    for command, more in beside.items():
        keys = set(re.findall(r"`(\w+)`", re.sub(r"\(.*?\)", "", common + more)))
        assert set(result_of(command, background.end.url)) == keys


def test_tones_are_measured_by_hand() -> None:
    """Sensors with unit and channel; a reading of two tones at each, of a plate at rest."""
    url = f"sim://{example_rig_path()}?exact"
    described = CliRunner().invoke(app, ["amp", "sensors", url, "--json"])
    sensors = json.loads(described.stdout)["sensors"]
    assert [one["channel"] for one in sensors] == [0, 1, 2, 3]
    assert {one["unit"] for one in sensors} == {"m/s²"}
    tones = ["--frequency", "110", "--frequency", "150", "--window", "0.1"]
    result = CliRunner().invoke(app, ["amp", "measure", url, *tones, "--json"])
    reading = json.loads(result.stdout)
    assert (reading["state"], reading["token"]) == ("COMPLETE", 0)
    for one in reading["sensors"]:
        assert [tone["frequency_hz"] for tone in one["tones"]] == [110.0, 150.0]
        assert [tone["amplitude"] for tone in one["tones"]] == [0.0, 0.0]


def test_tones_too_close_are_an_error_of_the_command() -> None:
    """Exit status 2 of the program, by the error's class."""
    url = f"sim://{example_rig_path()}"
    tones = ["--frequency", "110", "--frequency", "112", "--window", "0.1"]
    result = CliRunner().invoke(app, ["amp", "measure", url, *tones])
    assert isinstance(result.exception, CommandError)
