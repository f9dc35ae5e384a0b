"""The `era amp` commands of version 3, at amplifiers simulated in the process itself."""

import asyncio
import json
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner, Result

from drivers.by_hand.cli import app
from drivers.errors import CommandError
from model.rig.file import example_rig_path
from word_wires import WORD_WIRES

URL = f"sim://{example_rig_path()}?exact"
COMMON = {
    *("url", "state", "fault", "interlock_open", "limited", "token", "high_voltage"),
    *("high_voltage_v", "temperature_c", "watchdog_left_s", "levels", "layer_tokens"),
}


def invoke(*args: str) -> Result:
    """Run `era amp` with these arguments."""
    return CliRunner().invoke(app, ["amp", *args])


def result_of(*args: str) -> dict[str, Any]:
    """Run `era amp` with these arguments and --json; its result."""
    result = invoke(*args, "--json")
    assert result.exit_code == 0, result.output
    parsed: dict[str, Any] = json.loads(result.stdout)
    return parsed


@pytest.mark.parametrize(
    ("command", "more"),
    [
        ("status", {"faults", "measured", "last_round_trip_s"}),
        ("clear", set()),
        ("stop", {"silence", "may_play_for_s", "cause"}),
    ],
)
def test_results_have_the_documented_keys(command: str, more: set[str]) -> None:
    """Those of docs/reference/commands.md, and what version 3 has besides."""
    assert set(result_of(command, URL)) == COMMON | more


def test_drive_and_identify_of_a_simulated_rig() -> None:
    """Four channels; what is driven is said as the wire has it."""
    assert result_of("identify", URL)["channels"] == 4
    options = ["--channel", "2", "--frequency", "123.45", "--level", "0.3", "--for", "0.05"]
    driven = result_of("drive", URL, *options)
    assert set(driven) == COMMON | {"achieved", "duration_s"}
    assert driven["achieved"] == [
        {"channel": 2, "frequency_hz": 123.45, "level": 0.3, "phase_deg": 0.0}
    ]


def test_unconfirmed_stop_exits_3_and_a_confirmed_one_names_the_next_command() -> None:
    """Nothing could be sent to a port that is not there."""
    result = invoke("stop", "serial:///dev/no-such-port", "--json")
    assert result.exit_code == 3
    said = json.loads(result.stdout)
    assert said["silence"] == "may_play"
    assert "no such port" in said["cause"]
    assert invoke("stop", URL).stdout.splitlines()[-1] == f"Next: era amp clear '{URL}'"


def test_stop_needs_no_trace(tmp_path: Path) -> None:
    """With a trace file that cannot be written it stops, while other commands do nothing."""
    options = ("--trace", str(tmp_path / "missing" / "trace.txt"))
    assert isinstance(invoke("clear", URL, *options).exception, CommandError)
    assert invoke("stop", URL, *options).exit_code == 0


def test_tones_are_measured_by_hand() -> None:
    """Sensors with unit and channel; a reading of two tones at each, of a plate at rest."""
    sensors = result_of("sensors", URL)["sensors"]
    assert [one["channel"] for one in sensors] == [0, 1, 2, 3]
    assert {(one["measures"], one["unit"]) for one in sensors} == {("acceleration", "m/s²")}
    tones = ["--frequency", "110", "--frequency", "150", "--window", "0.1"]
    reading = result_of("measure", URL, *tones)
    assert (reading["state"], reading["token"]) == ("COMPLETE", 0)
    for one in reading["sensors"]:
        assert [tone["frequency_hz"] for tone in one["tones"]] == [110.0, 150.0]
        assert [tone["amplitude"] for tone in one["tones"]] == [0.0, 0.0]


def test_tones_too_close_are_an_error_of_the_command() -> None:
    """Exit status 2 of the program, by the error's class."""
    tones = ["--frequency", "110", "--frequency", "112", "--window", "0.1"]
    assert isinstance(invoke("measure", URL, *tones).exception, CommandError)


def test_conformance_reads_first_and_reports_what_is_left() -> None:
    """All reading checks of a serial line pass; driving ones are not run, and named as next."""
    report = result_of("conformance", URL)
    assert (report["overall"], report["failed"], report["level"]) == ("incomplete", 0, 0.0)
    assert report["not_run"] > 40
    assert {row["result"] for row in report["checks"]} <= {"passed", "skipped"}
    shown = invoke("conformance", URL)
    assert shown.exit_code == 0, shown.output
    assert shown.stdout.splitlines()[-1] == f"Next: era amp conformance '{URL}' --write"


@pytest.mark.real_time
async def test_conformance_stops_after_a_failed_reading_check() -> None:
    """An amplifier that is armed already: exit status 1, and nothing is driven."""
    async with WORD_WIRES["serial"](1) as far:
        far.amplifiers[1].handle("Arm", {"session": 5, "watchdog": 2000}, monotonic())
        arguments = ("conformance", far.url(1), "--write", "--json")
        result = await asyncio.to_thread(invoke, *arguments)
        assert result.exit_code == 1, result.output
        report = json.loads(result.stdout)
        assert report["overall"] == "failed"
        assert report["not_run"] > 40
        rows = {row["name"]: row for row in report["checks"]}
        assert rows["starts_disarmed"]["result"] == "failed"


def test_discover_reports_why_a_port_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason stands with the port."""
    port = ListPortInfo("/dev/no-such-port")
    monkeypatch.setattr("drivers.discovery.places.comports", lambda: [port])
    result = invoke("discover")
    assert result.exit_code == 0, result.output
    assert "no such port" in result.stdout


def test_discover_lists_amplifiers_of_urls() -> None:
    """Each with its identity."""
    (found,) = result_of("discover", URL, "--no-probe")["amplifiers"]
    assert (found["url"], found["serial_number"]) == (URL, "SIM-main")


@pytest.mark.parametrize(("url", "status"), [("foo", 2), ("serial:///dev/no-such-port", 3)])
def test_discover_fails_where_a_named_url_has_no_amplifier(url: str, status: int) -> None:
    """Exit status 2 for one that is none, 3 for one that cannot be reached; others are listed."""
    result = invoke("discover", url, URL, "--no-probe")
    assert result.exit_code == status
    assert f"{url}: " in result.stdout
    assert "SIM-main" in result.stdout
    listed = invoke("discover", url, URL, "--no-probe", "--json")
    assert listed.exit_code == status
    assert [each["url"] for each in json.loads(listed.stdout)["amplifiers"]] == [URL]


def test_what_is_unknown_is_not_shown() -> None:
    """A stop that is confirmed has no time for which it may play."""
    result = invoke("stop", URL)
    assert result.exit_code == 0, result.output
    assert "confirmed_silent" in result.stdout
    assert "None" not in result.stdout
