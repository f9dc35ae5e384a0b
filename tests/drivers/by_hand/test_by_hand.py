"""`era amp` and the synchronous amplifier.

The commands run on an amplifier in the same process, the actions that they use on real wires, too.
"""

import asyncio
import json
import re
import threading
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner, Result

from cases import shortly
from drivers.by_hand import actions
from drivers.by_hand.actions import BlockingAmplifier
from drivers.by_hand.cli import app
from drivers.by_hand.discovery import identify_all
from drivers.errors import CommandError, CommandRefused, LinkError, LinkTimeout
from drivers.host.set_admission import StagedSet
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import FEATURES, READINGS, STATUS_FLAGS
from drivers.trace import tracing
from drivers.wires.wire import with_address
from era_haptics.lab.cli import app as lab_app
from era_haptics.lab.conformance.conformance_report import ConformanceReport
from model.rig.rig_file import example_rig_path
from processes.patient_daemon import LONG_WATCHDOG, wait_long
from registry.limits import GuardLimits
from sim.amplifier import simulated_amplifier
from sim.amplifier.readings import capabilities
from tests.drivers.word_wires import WORD_WIRES, WordFarSide

ADDRESSED = [wire for wire in WORD_WIRES if not wire.endswith(("tcp", "server", "socketcand"))]
"""Wires with one far end; the others have one for each connection, at the first addresses."""


@pytest.fixture
def running_boards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give up a missing reply after 0.5 s instead of six, as from boards that have booted."""
    for name in (
        "by_hand.actions.BOOT_TIME",
        "wires.modbus.BOOT_TIME",
        "wires.serial_line.SerialAddress.boot_time",
        "wires.can_text.SlcanAddress.boot_time",
    ):
        monkeypatch.setattr(f"drivers.{name}", 0.5)


LIMITS = GuardLimits(20.0, 1000.0, 1.0)


async def leave_playing(far: WordFarSide, number: int = 1) -> None:
    """Play at half level, as a host that then ends without a stop; needs `unhurried`."""
    lines = Lines()
    amplifier = await lines.amplifier(far.url(number), LIMITS, name="a", is_output=None)
    await amplifier.open()
    await amplifier.arm(77, LONG_WATCHDOG)
    await amplifier.stage(StagedSet([layer(0, 100.0, 0.5)]), 5, now=True)
    await lines.close()
    assert far.level(number) == pytest.approx(0.5)


def requests_in(trace: Path) -> list[str]:
    """Return the names of the requests of a trace."""
    return re.findall(r" request (\w+)\(", trace.read_text("utf-8"))


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("wire", shortly(WORD_WIRES, ["serial", "modbus+tcp", "can+socketcand"]))
async def test_stop_is_sent_before_anything_is_read(wire: str, tmp_path: Path) -> None:
    """An amplifier that plays for another host becomes silent, confirmed; identity comes after."""
    trace = tmp_path / "trace"
    async with WORD_WIRES[wire](1) as far:
        await leave_playing(far)
        with tracing(trace):
            result = await actions.stop(far.url(1))
        assert far.level(1) == 0.0

    assert result["silence"] == "confirmed_silent"
    assert result["cause"] == ""
    assert result["state"] == "QUICK_STOP_ACTIVE"
    assert result["levels"] == [0.0]
    first, *later_requests = requests_in(trace)
    assert first == "Stop"
    assert {"Hello", "GetCaps"} <= set(later_requests)
    text = trace.read_text("utf-8")
    assert re.search(r" wire .* > (?:[0-9a-f]{2} )+ Stop to 1\n", text)
    assert re.search(r" wire .* < (?:[0-9a-f]{2} )+ Reply\(", text)


@pytest.mark.real_time
@pytest.mark.usefixtures("running_boards")
async def test_stop_of_a_mute_amplifier_may_play() -> None:
    """Nothing replies at its address, so nothing confirms that it is silent."""
    async with WORD_WIRES["serial"](1) as far:
        result = await actions.stop(far.url(2))

    assert result["silence"] == "may_play"
    assert result["may_play_for_s"] is None
    assert "no reply" in result["cause"]
    assert "state" not in result


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_identity_has_units_and_the_limits_of_the_wire() -> None:
    """The longest part of a set takes frames of 252 and 18 bytes, 12 of which are overhead.

    At 115 200 baud these 2700 bits are 23.4 ms, 42 sets per second.
    """
    async with WORD_WIRES["serial"](1) as far:
        rows = await actions.identify_amplifier(f"{far.url(1)}&baud=115200")

    assert rows["serial_number"] == "SIM-1"
    assert rows["versions"] == [4]
    assert rows["channels"] == 1
    assert rows["watchdog_min_s"] == 0.1
    assert rows["watchdog_max_s"] == LONG_WATCHDOG
    (channel_limits,) = rows["channel_limits"]
    assert channel_limits.keys() == {"frequency_min_hz", "frequency_max_hz", "level_max"}
    assert "events" in rows["features"]
    round_trip = 2700 / 115_200
    assert rows["wire_round_trip_s"] == pytest.approx(round_trip, abs=1e-6)
    assert rows["sets_per_second_max"] == 42
    assert rows["watchdog_shortest_s"] == pytest.approx(0.15 + round_trip, abs=1e-6)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize(
    "wire", shortly(WORD_WIRES, ["serial+tcp", "modbus+rtu server", "can+python-can virtual"])
)
async def test_status_changes_nothing_and_clear_disarms_after_a_stop(wire: str) -> None:
    """The amplifier plays on while its status is read, whatever the kind of its full level."""
    async with WORD_WIRES[wire](2) as far:
        far.amplifiers[2].capabilities["features"] |= 1 << FEATURES["output"]
        await leave_playing(far, 2)

        rows = await actions.status(far.url(2))

        assert rows["state"] == "OPERATION_ENABLED"
        assert rows["levels"] == [0.5]
        assert rows["token"] == 5
        assert rows["layer_tokens"][:2] == [5, 0]
        assert rows["high_voltage"] is True
        assert rows["interlock_open"] is rows["limited"] is False
        assert 0 < rows["watchdog_left_s"] <= LONG_WATCHDOG
        assert rows["last_round_trip_s"] > 0
        assert 0 <= rows["clock_s"] < 60
        await actions.stop(far.url(2))
        cleared = await actions.clear(far.url(2))
        assert cleared["state"] == "SWITCH_ON_DISABLED"


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_drive_plays_and_ends_silent_and_disarmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pings feed the watchdog while the requested tone plays.

    After a stop the error names state and remedy, with the URL quoted for a shell.
    """
    monkeypatch.setattr(actions, "WATCHDOG", LONG_WATCHDOG)
    options = {"channel": 0, "frequency": 123.45, "level": 0.3, "duration": 3.0}
    levels = set()
    async with WORD_WIRES["serial"](1) as far:
        with tracing(tmp_path / "trace"):
            driving = asyncio.ensure_future(actions.drive(far.url(1), **options))
            while not driving.done():
                levels.add(round(far.level(1), 6))
                await asyncio.sleep(0.01)
            rows = await driving
        await actions.stop(far.url(1))
        with pytest.raises(CommandRefused, match="QUICK_STOP_ACTIVE") as refusal:
            await actions.drive(far.url(1), **options)

    assert max(levels) == 0.3
    expected = {"channel": 0, "frequency_hz": 123.45, "level": 0.3, "phase_deg": 0.0}
    assert rows["achieved"] == [expected]
    assert rows["state"] == "SWITCH_ON_DISABLED"
    assert rows["levels"] == [0.0]
    assert str(refusal.value).endswith(f"era amp clear '{far.url(1)}'")
    requests = requests_in(tmp_path / "trace")
    assert requests.index("Ping") < requests.index("Disarm")


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("query", "wrong"),
    [
        ("", {"level": 1.1}),
        ("", {"frequency": float("nan")}),
        ("", {"channel": 1}),
        ("", {"duration": 0.0}),
        ("", {"duration": float("nan")}),
        ("&baud=4800", {}),  # too slow for three heartbeats and a round trip
    ],
)
async def test_invalid_drive_never_arms(query: str, wrong: dict[str, float]) -> None:
    """Invalid input is an error and does not change the amplifier."""
    options = {"channel": 0, "frequency": 110.0, "level": 0.2, "duration": 0.1, **wrong}
    async with WORD_WIRES["serial"](1) as far:
        with pytest.raises(CommandError):
            await actions.drive(far.url(1) + query, **options)  # type: ignore[arg-type]
        assert far.amplifiers[1].session == 0


async def serial_number_at(url: str) -> str:
    """Return the serial number of the amplifier at a URL."""
    rows = await actions.identify_amplifier(url)
    return str(rows["serial_number"])


@pytest.mark.real_time
@pytest.mark.usefixtures("running_boards")
@pytest.mark.parametrize("wire", shortly(ADDRESSED, ["serial", "modbus+rtu"]))
async def test_amplifier_takes_another_address(wire: str) -> None:
    """It replies there and no longer at the old address; the other amplifier stays where it is."""
    async with WORD_WIRES[wire](2) as far:
        with pytest.MonkeyPatch.context() as patch:
            wait_long(patch, reply_timeout=1.0)
            moved = await actions.set_address(far.url(1), 9, None)
            assert moved == {"url": with_address(far.url(1), 9), "serial_number": "SIM-1"}
            moved_again = await actions.set_address(moved["url"], 10, "SIM-1")
            assert await serial_number_at(moved_again["url"]) == "SIM-1"
            assert await serial_number_at(far.url(2)) == "SIM-2"
        for url in (far.url(1), moved["url"]):
            with pytest.raises(LinkTimeout):
                await actions.identify_amplifier(url)


@pytest.mark.real_time
@pytest.mark.usefixtures("running_boards", "unhurried")
async def test_armed_amplifier_keeps_its_address() -> None:
    """So does one with another serial number; a wire without addresses has none to set."""
    async with WORD_WIRES["serial"](1) as far:
        await leave_playing(far)
        with pytest.raises(CommandRefused, match="disarm"):
            await actions.set_address(far.url(1), 9, None)
        assert far.level(1) == pytest.approx(0.5)
        with pytest.raises(LinkError):
            await actions.set_address(far.url(1), 9, "SIM-nobody")
        assert await serial_number_at(far.url(1)) == "SIM-1"
    with pytest.raises(CommandError, match="address"):
        await actions.set_address("sim://rig.yaml", 9, None)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_discovery_only_identifies(tmp_path: Path) -> None:
    """A URL without a reply is no error, and a playing amplifier plays on."""
    missing = ["serial:///dev/no-such-port", "can+socketcand://127.0.0.1:1/can0#1"]
    async with WORD_WIRES["modbus+rtu"](1) as far:
        await leave_playing(far)
        with tracing(tmp_path / "trace"):
            results = await identify_all([far.url(1), *missing])
        assert far.level(1) == pytest.approx(0.5)

    identity = results[far.url(1)]
    assert isinstance(identity, dict)
    assert identity["serial_number"] == "SIM-1"
    assert [type(results[url]) for url in missing] == [LinkError, LinkError]
    assert set(requests_in(tmp_path / "trace")) <= {"Hello", "GetCaps", "GetStatus"}


WIDE_LIMITS = GuardLimits(40.0, 500.0, 0.5)
RIG_URL = f"sim://{example_rig_path()}"


def layer(channel: int, frequency: float, level: float) -> AmplifierLayer:
    """Return a layer of one tone that starts immediately."""
    return AmplifierLayer(0, (AmplifierTone(channel, frequency, level),), ramp=0.0)


def loop_threads() -> list[str]:
    """Return the names of the running event loop threads."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith("amplifier ")]


def test_blocking_amplifier_plays_and_ends_disarmed() -> None:
    """Arm, play, stop, clear; a set ends all other layers, and no thread is left running."""
    with BlockingAmplifier(RIG_URL, limits=WIDE_LIMITS) as amplifier:
        assert amplifier.identity["serial_number"] == "SIM-main"
        assert amplifier.capabilities["channels"] == 4
        assert amplifier.arm(2.0)["state"] == "OPERATION_ENABLED"
        played = amplifier.play([layer(0, 110.004, 0.2)], duration=0.03)
        assert played.layers[0].commands[0].frequency == 2200  # in 1/20 Hz
        applied = amplifier.apply([layer(1, 110.0, 0.3)])
        assert applied.layers[0].commands
        assert [part.commands for part in applied.layers[1:]] == [()] * 7
        status = amplifier.status()
        assert status["token"] == applied.token
        assert status["levels"] == [0.0, 0.3, 0.0, 0.0]

        amplifier.stop()

        assert amplifier.status()["state"] == "QUICK_STOP_ACTIVE"
        with pytest.raises(CommandRefused):
            amplifier.apply([layer(1, 110.0, 0.3)])
        with pytest.raises(CommandRefused):
            amplifier.heartbeat()
        assert amplifier.clear()["state"] == "SWITCH_ON_DISABLED"
        assert amplifier.faults() == []
    assert loop_threads() == []


@pytest.fixture
def steps(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate amplifiers with other steps."""

    def with_steps(*args: int, **options: int) -> dict[str, Any]:
        return {**capabilities(*args, **options), **request.param}

    monkeypatch.setattr(simulated_amplifier, "capabilities", with_steps)


@pytest.mark.parametrize(
    ("steps", "cause"),
    [({"phase_step": 9000}, "phase of channel 1"), ({"level_step": 10_000}, "level of channel 0")],
    indirect=["steps"],
)
@pytest.mark.usefixtures("steps")
def test_blocking_amplifier_rejects_a_tone_that_its_steps_round_away(cause: str) -> None:
    """Steps of 90 degrees put 40 degrees at 0 or 90, and full steps of level leave 0 or 1."""
    tones = (AmplifierTone(0, 110.0, 0.3), AmplifierTone(1, 110.0, 0.3, 40.0))
    with BlockingAmplifier(RIG_URL, limits=WIDE_LIMITS) as amplifier:
        amplifier.arm(2.0)
        with pytest.raises(CommandError, match=cause):
            amplifier.play([AmplifierLayer(0, tones, ramp=0.0)], duration=0.03)
        assert amplifier.status()["levels"] == [0.0] * 4


def test_blocking_amplifier_raises_when_the_watchdog_has_tripped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The error names fault and remedy."""
    monkeypatch.setattr("drivers.by_hand.actions.HEARTBEAT", 0.15)
    with BlockingAmplifier(RIG_URL, limits=WIDE_LIMITS) as amplifier:
        amplifier.arm(0.1)
        with pytest.raises(CommandRefused, match=r"WATCHDOG.*clear"):
            amplifier.play([layer(0, 110.0, 0.2)], duration=1.0)


def test_blocking_amplifier_ends_its_thread_when_opening_fails() -> None:
    """The error reaches the script."""
    amplifier = BlockingAmplifier("sim://no-such-rig.yaml", limits=WIDE_LIMITS)
    with pytest.raises(CommandError), amplifier:
        pass
    assert loop_threads() == []


URL = f"sim://{example_rig_path()}?exact"


def invoke(*args: str) -> Result:
    """Run `era amp` with these arguments."""
    command = lab_app if args[0] == "conformance" else app
    return CliRunner().invoke(command, ["amp", *args])


def result_of(*args: str) -> dict[str, Any]:
    """Run `era amp` with these arguments and --json; return its result."""
    result = invoke(*args, "--json")
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


STATUS_KEYS = {
    "url",
    "state",
    "fault",
    "token",
    "watchdog_left_s",
    "clock_s",
    "levels",
    "layer_tokens",
    "reports",
    *STATUS_FLAGS,
    *(reading.key for reading in READINGS),
}


@pytest.mark.parametrize(
    ("command", "further_keys"),
    [
        ("status", {"faults", "measured", "last_round_trip_s"}),
        ("clear", set()),
        ("stop", {"silence", "may_play_for_s", "cause"}),
    ],
)
def test_results_have_the_documented_keys(command: str, further_keys: set[str]) -> None:
    """The keys of docs/reference/commands.md, and of further readings of version 4."""
    assert result_of(command, URL).keys() == STATUS_KEYS | further_keys


def test_unconfirmed_stop_exits_with_status_3() -> None:
    """Nothing can be sent to a port that does not exist."""
    result = invoke("stop", "serial:///dev/no-such-port", "--json")

    assert result.exit_code == 3
    reply = json.loads(result.stdout)
    assert reply["silence"] == "may_play"
    assert "no such port" in reply["cause"]
    assert "switch it off" in reply["cause"]


def test_stop_works_with_an_unwritable_trace(tmp_path: Path) -> None:
    """Other commands do nothing if the trace file cannot be written."""
    options = ("--trace", str(tmp_path / "missing" / "trace.txt"))
    assert isinstance(invoke("clear", URL, *options).exception, CommandError)
    assert invoke("stop", URL, *options).exit_code == 0


def test_conformance_runs_selected_checks_and_writes_a_junit_report(tmp_path: Path) -> None:
    """Two checks match; the one that drives is not run, and is skipped in the report."""
    junit_xml = tmp_path / "conformance.xml"
    options = ("-k", "identity or stop_ramps", "--junitxml", str(junit_xml))

    report = result_of("conformance", URL, *options)

    assert {row["name"]: row["result"] for row in report["checks"]} == {"identity": "passed"}
    assert report["not_run"] == 1
    (suite,) = ElementTree.parse(junit_xml).getroot()
    cases = {}
    for case in suite:
        cases[case.get("name")] = [child.tag for child in case]
    assert cases == {"identity": [], "stop_ramps": ["skipped"]}


ARM = {"session": 5, "watchdog": 2000, "shift": 0}


@pytest.mark.real_time
async def test_conformance_stops_after_a_failed_reading_check() -> None:
    """An amplifier that is armed already is not driven; the exit status is 1."""
    async with WORD_WIRES["serial"](1) as far:
        far.amplifiers[1].handle("Arm", ARM, monotonic())
        arguments = ("conformance", far.url(1), "--write", "--json")
        result = await asyncio.to_thread(invoke, *arguments)

    assert result.exit_code == 1, result.output
    report = json.loads(result.stdout)
    assert report["overall"] == "failed"
    assert report["not_run"] > 40
    results = {row["name"]: row["result"] for row in report["checks"]}
    assert results["starts_disarmed"] == "failed"


@pytest.mark.real_time
@pytest.mark.parametrize("interruption", [KeyboardInterrupt(), LinkError("line was lost")])
async def test_interrupted_conformance_leaves_the_amplifier_disarmed(
    interruption: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After Ctrl-C, or a loss of the line that is over: stopped, cleared, and its state printed."""
    async with WORD_WIRES["serial"](1) as far:

        def judge(url: str, *, may_drive: Callable[[int], bool], **_: Any) -> ConformanceReport:
            assert may_drive(1)
            far.amplifiers[1].handle("Arm", ARM, monotonic())
            raise interruption

        monkeypatch.setattr("era_haptics.lab.conformance.session.judge", judge)
        result = await asyncio.to_thread(invoke, "conformance", far.url(1), "--write")

        assert result.exit_code != 0
        assert f"{far.url(1)} is left in SWITCH_ON_DISABLED" in result.stderr
        assert far.amplifiers[1].state == "SWITCH_ON_DISABLED"


@pytest.mark.parametrize(("url", "status"), [("foo", 2), ("serial:///dev/no-such-port", 3)])
def test_discover_fails_if_a_named_url_has_no_amplifier(url: str, status: int) -> None:
    """Exit status 2 for an invalid URL, 3 for one that cannot be reached; others are listed."""
    result = invoke("discover", url, URL, "--no-probe", "--json")

    assert result.exit_code == status
    (row,) = json.loads(result.stdout)["amplifiers"]
    assert row["url"] == URL
