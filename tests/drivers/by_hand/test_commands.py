"""The commands `era amp` and the synchronous amplifier, over one simulated in the same process."""

import asyncio
import json
import threading
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner, Result

from drivers.by_hand.actions import BlockingAmplifier
from drivers.by_hand.cli import app as amp_app
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.playing import Layer, Tone
from drivers.protocol.definition import READINGS, STATUS_FLAGS
from era_haptics.lab.cli import app as lab_app
from era_haptics.lab.conformance.contract import Report
from model.rig.rig_file import example_rig_path
from real_wires import WORD_WIRES
from registry.limits import GuardLimits

LIMITS = GuardLimits(40.0, 500.0, 0.5)
DRAWN = f"sim://{example_rig_path()}"


def layer(channel: int, frequency: float, level: float) -> Layer:
    """One tone at once, in a layer."""
    return Layer(0, (Tone(channel, frequency, level),), ramp=0.0)


def loop_threads() -> list[str]:
    """Names of the running event loop threads."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith("amplifier ")]


def test_blocking_amplifier_plays_and_ends_disarmed() -> None:
    """Arm, play, stop, clear; layers that are not given end, and nothing is left running."""
    with BlockingAmplifier(DRAWN, limits=LIMITS) as amplifier:
        assert amplifier.identity["serial_number"] == "SIM-main"
        assert amplifier.capabilities["channels"] == 4
        assert amplifier.arm(2.0)["state"] == "OPERATION_ENABLED"
        played = amplifier.play([layer(0, 110.004, 0.2)], duration=0.03)
        assert played.layers[0].commands[0].frequency == 2200  # in 1/20 Hz
        later = amplifier.apply([layer(1, 110.0, 0.3)])
        assert [bool(each.commands) for each in later.layers] == [True] + [False] * 7
        status = amplifier.status()
        assert (status["token"], status["levels"]) == (later.token, [0.0, 0.3, 0.0, 0.0])
        amplifier.stop()
        assert amplifier.status()["state"] == "QUICK_STOP_ACTIVE"
        with pytest.raises(CommandRefused):
            amplifier.apply([layer(1, 110.0, 0.3)])
        with pytest.raises(CommandRefused):
            amplifier.heartbeat()
        assert amplifier.clear()["state"] == "SWITCH_ON_DISABLED"
        assert amplifier.faults() == []
    assert loop_threads() == []


def test_blocking_amplifier_measures_while_it_feeds_the_watchdog() -> None:
    """Over a window longer than the watchdog; the ERA that plays moves its own foot most."""
    with BlockingAmplifier(DRAWN, limits=LIMITS) as amplifier:
        amplifier.arm(1.0)
        amplifier.apply([layer(2, 110.0, 0.2)])
        reading = amplifier.measure([110.0], 1.2)
        assert amplifier.status()["state"] == "OPERATION_ENABLED"
        sensors = amplifier.sensors()
        loudest = max(range(len(sensors)), key=lambda n: reading.sensors[n].tones[0][0])
        assert sensors[loudest].channel == 2


def test_play_raises_when_the_watchdog_has_tripped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names fault and remedy."""
    monkeypatch.setattr("drivers.by_hand.actions.HEARTBEAT", 0.15)
    with BlockingAmplifier(DRAWN, limits=LIMITS) as amplifier:
        amplifier.arm(0.1)
        with pytest.raises(CommandRefused, match=r"WATCHDOG.*clear"):
            amplifier.play([layer(0, 110.0, 0.2)], duration=1.0)


def test_blocking_amplifier_ends_its_thread_when_opening_fails() -> None:
    """The error reaches the script, and the loop's thread has ended."""
    with pytest.raises(CommandError), BlockingAmplifier("sim://no-such-rig.yaml", limits=LIMITS):
        pass
    assert loop_threads() == []


URL = f"sim://{example_rig_path()}?exact"
COMMON = {
    *("url", "state", "fault", "token", "watchdog_left_s", "clock_s", "levels"),
    *("layer_tokens", "reports"),
    *(*STATUS_FLAGS, *(each.key for each in READINGS)),
}


def invoke(*args: str) -> Result:
    """Run `era amp` with these arguments."""
    return CliRunner().invoke(lab_app if args[0] == "conformance" else amp_app, ["amp", *args])


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
    """Those of docs/reference/commands.md, and what version 4 has besides."""
    assert set(result_of(command, URL)) == COMMON | more


def test_unconfirmed_stop_exits_3_and_a_confirmed_one_names_the_next_command() -> None:
    """Nothing could be sent to a port that is not there."""
    result = invoke("stop", "serial:///dev/no-such-port", "--json")
    assert result.exit_code == 3
    said = json.loads(result.stdout)
    assert said["silence"] == "may_play"
    assert "no such port" in said["cause"]
    assert "switch it off" in said["cause"]
    *rows, last = invoke("stop", URL).stdout.splitlines()
    assert last == f"Next: era amp clear '{URL}'"
    assert all(len(row.split()) > 1 for row in rows)  # no cause, as nothing went wrong


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
    """An amplifier that is armed already: exit status 1, nothing is driven, nor advised."""
    async with WORD_WIRES["serial"](1) as far:
        far.amplifiers[1].handle("Arm", {"session": 5, "watchdog": 2000, "shift": 0}, monotonic())
        arguments = ("conformance", far.url(1), "--write", "--json")
        result = await asyncio.to_thread(invoke, *arguments)
        assert result.exit_code == 1, result.output
        report = json.loads(result.stdout)
        assert report["overall"] == "failed"
        assert report["not_run"] > 40
        rows = {row["name"]: row for row in report["checks"]}
        assert rows["starts_disarmed"]["result"] == "failed"
        shown = await asyncio.to_thread(invoke, "conformance", far.url(1))
        assert (shown.exit_code, "Next: " in shown.stdout) == (1, False)


@pytest.mark.real_time
@pytest.mark.parametrize("end", [KeyboardInterrupt(), LinkError("line was lost")])
async def test_conformance_that_is_ended_leaves_it_silent_and_says_how(
    end: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By Ctrl-C, or a line that was lost and is there again: stopped, cleared, its state told."""
    async with WORD_WIRES["serial"](1) as far:

        async def judged(url: str, *, drives: bool, **others: Any) -> Report:
            if drives:
                far.amplifiers[1].handle(
                    "Arm", {"session": 5, "watchdog": 2000, "shift": 0}, monotonic()
                )
                raise end
            return Report(url, 0.0, (), 1)

        monkeypatch.setattr("era_haptics.lab.conformance.judge_client", judged)
        result = await asyncio.to_thread(invoke, "conformance", far.url(1), "--write")
        assert result.exit_code != 0
        assert f"{far.url(1)} is left in SWITCH_ON_DISABLED" in result.stderr
        assert far.amplifiers[1].state == "SWITCH_ON_DISABLED"


def test_discover_reports_why_a_port_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason stands with the port."""
    port = ListPortInfo("/dev/no-such-port")
    monkeypatch.setattr("drivers.by_hand.reaching.comports", lambda: [port])
    result = invoke("discover")
    assert result.exit_code == 0, result.output
    assert "no such port" in result.stdout


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
