"""`era amp`, the synchronous amplifier, and how the amplifiers of a rig are reached by their URLs.

The commands run over an amplifier in the same process, the actions below them on real wires too.
`era config check` states how closely the lines keep the clocks.
"""

import asyncio
import json
import math
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any
from xml.etree import ElementTree

import pytest
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner, Result

from cases import shortly
from drivers.by_hand import actions
from drivers.by_hand.actions import BlockingAmplifier
from drivers.by_hand.cli import app
from drivers.by_hand.discovery import identify_all
from drivers.by_hand.links import Arrangement, arrangement_of, check_links
from drivers.errors import CommandError, CommandRefused, LinkError, LinkTimeout
from drivers.host.set_admission import StagedSet
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import CLOCK_UNKNOWN, FEATURES, READINGS, STATUS_FLAGS
from drivers.trace import tracing
from drivers.urls import (
    CLOCK_ERRORS,
    SIMULATED,
    UNKNOWN_KIND,
)
from drivers.wires import wire
from drivers.wires.serial_line import SerialAddress
from drivers.wires.wire import line_kind_of, with_address
from era_haptics.lab.cli import app as lab_app
from era_haptics.lab.conformance.conformance_report import ConformanceReport
from kit.wires import WORD_WIRES, WordFarSide
from model.rig.rig_file import example_rig_path
from processes.patient_daemon import LONG_WATCHDOG, wait_long
from registry.limits import GuardLimits
from sim.amplifier import simulated_amplifier
from sim.amplifier.readings import capabilities
from sim.transport.simulated_line import LINE_KINDS, PROMPT

ADDRESSED = [wire for wire in WORD_WIRES if not wire.endswith(("tcp", "server", "socketcand"))]
"""Wires whose far end lasts: the others have one for each connection, at the first addresses."""


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boards that run already: what does not reply is given up after 0.5 s instead of six."""
    for place in (
        "by_hand.actions.BOOT_TIME",
        "wires.modbus.BOOT_TIME",
        "wires.serial_line.SerialAddress.boot_time",
        "wires.can_text.SlcanAddress.boot_time",
    ):
        monkeypatch.setattr(f"drivers.{place}", 0.5)


async def leave_playing(far: WordFarSide, number: int = 1) -> None:
    """Play at half level, as a host that then ends without a word; needs `unhurried`."""
    lines = Lines()
    amplifier = await lines.amplifier(
        far.url(number), GuardLimits(20.0, 1000.0, 1.0), name="a", is_output=None
    )
    await amplifier.open()
    await amplifier.arm(77, LONG_WATCHDOG)
    await amplifier.stage(
        StagedSet([AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.0)]), 5, now=True
    )
    await lines.close()
    assert far.level(number) == pytest.approx(0.5)


def requests_in(trace: Path) -> list[str]:
    """The requests of a trace, by their names."""
    return re.findall(r" request (\w+)\(", trace.read_text("utf-8"))


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("wire", shortly(WORD_WIRES, ["serial", "modbus+tcp", "can+socketcand"]))
async def test_stop_is_sent_before_anything_is_read(wire: str, tmp_path: Path) -> None:
    """An amplifier that plays for another host is silent, confirmed; identity is read after."""
    async with WORD_WIRES[wire](1) as far:
        await leave_playing(far)
        with tracing(tmp_path / "trace"):
            result = await actions.stop(far.url(1))
        assert far.level(1) == 0.0
        assert (result["silence"], result["cause"]) == ("confirmed_silent", "")
        assert (result["state"], result["levels"]) == ("QUICK_STOP_ACTIVE", [0.0])
    first, *others = requests_in(tmp_path / "trace")
    assert first == "Stop"
    assert {"Hello", "GetCaps"} <= {*others}
    text = (tmp_path / "trace").read_text("utf-8")
    assert re.search(r" wire .* > (?:[0-9a-f]{2} )+ Stop to 1\n", text)
    assert re.search(r" wire .* < (?:[0-9a-f]{2} )+ Reply\(", text)


@pytest.mark.real_time
@pytest.mark.usefixtures("started")
async def test_stop_of_a_mute_amplifier_may_play() -> None:
    """Nothing replies at its address, so nothing confirms that it is silent."""
    async with WORD_WIRES["serial"](1) as far:
        result = await actions.stop(far.url(2))
    assert (result["silence"], result["may_play_for_s"]) == ("may_play", None)
    assert "no reply" in result["cause"]
    assert "state" not in result


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_identity_has_units_and_the_limits_of_the_wire() -> None:
    """Frames of 252 and 18 bytes for the longest part of a set: 120 and 3 words, and 12 bytes each.

    At 115 200 baud these 2700 bits are 23.4 ms, 42 sets a second.
    """
    async with WORD_WIRES["serial"](1) as far:
        rows = await actions.identify_amplifier(f"{far.url(1)}&baud=115200")
    assert (rows["serial_number"], rows["versions"], rows["channels"]) == ("SIM-1", [4], 1)
    assert (rows["watchdog_min_s"], rows["watchdog_max_s"]) == (0.1, LONG_WATCHDOG)
    assert rows["channel_limits"][0].keys() == {
        *("frequency_min_hz", "frequency_max_hz", "level_max")
    }
    assert "events" in rows["features"]
    assert rows["wire_round_trip_s"] == pytest.approx(2700 / 115_200, abs=1e-6)
    assert rows["sets_per_second_max"] == 42
    assert rows["watchdog_shortest_s"] == pytest.approx(0.15 + 2700 / 115_200, abs=1e-6)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize(
    "wire", shortly(WORD_WIRES, ["serial+tcp", "modbus+rtu server", "can+python-can virtual"])
)
async def test_status_of_what_plays_and_clear_of_a_stop(wire: str) -> None:
    """Looking changes nothing; after a stop Clear leaves it disarmed.

    What full level means is the rig's business.
    """
    async with WORD_WIRES[wire](2) as far:
        far.amplifiers[2].capabilities["features"] |= 1 << FEATURES["output"]
        await leave_playing(far, 2)
        rows = await actions.status(far.url(2))
        assert (rows["state"], rows["levels"], rows["token"]) == ("OPERATION_ENABLED", [0.5], 5)
        assert rows["layer_tokens"][:2] == [5, 0]
        assert (rows["high_voltage"], rows["interlock_open"], rows["limited"]) == (
            *(True, False, False),
        )
        assert 0 < rows["watchdog_left_s"] <= LONG_WATCHDOG
        assert rows["last_round_trip_s"] > 0
        assert 0 <= rows["clock_s"] < 60
        await actions.stop(far.url(2))
        assert (await actions.clear(far.url(2)))["state"] == "SWITCH_ON_DISABLED"


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_drive_plays_and_ends_silent_and_disarmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is achieved is what was asked for; pings feed the watchdog meanwhile.

    After a stop it names state, fault and remedy, with the URL quoted for a shell.
    """
    monkeypatch.setattr(actions, "WATCHDOG", LONG_WATCHDOG)
    async with WORD_WIRES["serial"](1) as far:
        options = {"channel": 0, "frequency": 123.45, "level": 0.3, "duration": 3.0}
        with tracing(tmp_path / "trace"):
            driving, heard = asyncio.ensure_future(actions.drive(far.url(1), **options)), set()
            while not driving.done():
                heard.add(round(far.level(1), 6))
                await asyncio.sleep(0.01)
            rows = await driving
            assert max(heard) == 0.3
        assert rows["achieved"] == [
            {"channel": 0, "frequency_hz": 123.45, "level": 0.3, "phase_deg": 0.0}
        ]
        assert (rows["state"], rows["levels"]) == ("SWITCH_ON_DISABLED", [0.0])
        await actions.stop(far.url(1))
        with pytest.raises(CommandRefused, match="QUICK_STOP_ACTIVE") as refused:
            await actions.drive(far.url(1), **options)
    assert str(refused.value).endswith(f"era amp clear '{far.url(1)}'")
    assert (requests := requests_in(tmp_path / "trace")).index("Ping") < requests.index("Disarm")


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
    """It is bad input and does not change the amplifier."""
    options = {"channel": 0, "frequency": 110.0, "level": 0.2, "duration": 0.1, **wrong}
    async with WORD_WIRES["serial"](1) as far:
        with pytest.raises(CommandError):
            await actions.drive(far.url(1) + query, **options)  # type: ignore[arg-type]
        assert far.amplifiers[1].session == 0


@pytest.mark.real_time
@pytest.mark.usefixtures("started")
@pytest.mark.parametrize("wire", shortly(ADDRESSED, ["serial", "modbus+rtu"]))
async def test_amplifier_takes_another_address(wire: str) -> None:
    """It replies there, nobody where it was, and the other amplifier where it is."""
    async with WORD_WIRES[wire](2) as far:
        with pytest.MonkeyPatch.context() as patch:
            wait_long(patch, reply_timeout=1.0)
            moved = await actions.set_address(far.url(1), 9, None)
            assert moved == {"url": with_address(far.url(1), 9), "serial_number": "SIM-1"}
            back = await actions.set_address(moved["url"], 10, "SIM-1")
            assert (await actions.identify_amplifier(back["url"]))["serial_number"] == "SIM-1"
            assert (await actions.identify_amplifier(far.url(2)))["serial_number"] == "SIM-2"
        for left in (far.url(1), moved["url"]):
            with pytest.raises(LinkTimeout):
                await actions.identify_amplifier(left)


@pytest.mark.real_time
@pytest.mark.usefixtures("started", "unhurried")
async def test_armed_amplifier_keeps_its_address() -> None:
    """So does one of another serial number; a wire without addresses has none to set."""
    async with WORD_WIRES["serial"](1) as far:
        await leave_playing(far)
        with pytest.raises(CommandRefused, match="disarm"):
            await actions.set_address(far.url(1), 9, None)
        assert far.level(1) == pytest.approx(0.5)
        with pytest.raises(LinkError):
            await actions.set_address(far.url(1), 9, "SIM-nobody")
        assert (await actions.identify_amplifier(far.url(1)))["serial_number"] == "SIM-1"
    with pytest.raises(CommandError, match="address"):
        await actions.set_address("sim://rig.yaml", 9, None)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_discovery_only_identifies(tmp_path: Path) -> None:
    """A URL without a reply is no error; what plays goes on."""
    async with WORD_WIRES["modbus+rtu"](1) as far:
        await leave_playing(far)
        with tracing(tmp_path / "trace"):
            unreached = ["serial:///dev/no-such-port", "can+socketcand://127.0.0.1:1/can0#1"]
            here, *others = (await identify_all([far.url(1), *unreached])).values()
        assert far.level(1) == pytest.approx(0.5)
    assert isinstance(here, dict)
    assert here["serial_number"] == "SIM-1"
    assert [type(other) for other in others] == [LinkError, LinkError]
    assert {*requests_in(tmp_path / "trace")} <= {"Hello", "GetCaps", "GetStatus"}


WIDE_LIMITS = GuardLimits(40.0, 500.0, 0.5)
DRAWN = f"sim://{example_rig_path()}"


def layer(channel: int, frequency: float, level: float) -> AmplifierLayer:
    """One tone at once, in a layer."""
    return AmplifierLayer(0, (AmplifierTone(channel, frequency, level),), ramp=0.0)


def loop_threads() -> list[str]:
    """Names of the running event loop threads."""
    return [each.name for each in threading.enumerate() if each.name.startswith("amplifier ")]


def test_blocking_amplifier_plays_and_ends_disarmed() -> None:
    """Arm, play, stop, clear; layers that are not given end, and nothing is left running."""
    with BlockingAmplifier(DRAWN, limits=WIDE_LIMITS) as amplifier:
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


@pytest.mark.parametrize(
    ("steps", "tones", "rejected"),
    [
        ({"phase_step": 9000}, [(0, 110.0, 0.3, 0.0), (1, 110.0, 0.3, 40.0)], "phase of channel 1"),
        ({"phase_step": 9000}, [(0, 110.0, 0.3, 30.0), (1, 110.0, 0.3, 118.0)], ""),
        ({"phase_step": 9000}, [(0, 110.0, 0.3, 0.0), (1, 150.0, 0.3, 40.0)], ""),
        ({"phase_step": 900}, [(0, 110.0, 0.3, 0.0), (1, 110.0, 0.3, 40.0)], ""),
        ({"level_step": 10_000}, [(0, 110.0, 0.3, 0.0)], "level of channel 0"),
    ],
    ids=["between steps", "a step apart", "other frequency", "fine steps", "on or off"],
)
def test_blocking_amplifier_rejects_what_its_steps_round_away(
    steps: dict[str, int],
    tones: list[tuple[int, float, float, float]],
    rejected: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps of 90 degrees put 40 degrees at 0 or 90: 40 or 50 off, and 118 - 30 only 2 off."""
    monkeypatch.setattr(
        simulated_amplifier, "capabilities", lambda *n, **k: capabilities(*n, **k) | steps
    )
    made = AmplifierLayer(0, tuple(AmplifierTone(*tone) for tone in tones), ramp=0.0)
    with BlockingAmplifier(DRAWN, limits=WIDE_LIMITS) as amplifier:
        amplifier.arm(2.0)
        if rejected:
            with pytest.raises(CommandError, match=rejected):
                amplifier.play([made], duration=0.03)
            assert amplifier.status()["levels"] == [0.0] * 4
        else:
            amplifier.play([made], duration=0.03)


def test_play_raises_when_the_watchdog_has_tripped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names fault and remedy."""
    monkeypatch.setattr("drivers.by_hand.actions.HEARTBEAT", 0.15)
    with BlockingAmplifier(DRAWN, limits=WIDE_LIMITS) as amplifier:
        amplifier.arm(0.1)
        with pytest.raises(CommandRefused, match=r"WATCHDOG.*clear"):
            amplifier.play([layer(0, 110.0, 0.2)], duration=1.0)


def test_blocking_amplifier_ends_its_thread_when_opening_fails() -> None:
    """The error reaches the script, and the loop's thread has ended."""
    with (
        pytest.raises(CommandError),
        BlockingAmplifier("sim://no-such-rig.yaml", limits=WIDE_LIMITS),
    ):
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
    return CliRunner().invoke(lab_app if args[0] == "conformance" else app, ["amp", *args])


def result_of(*args: str) -> dict[str, Any]:
    """Run `era amp` with these arguments and --json; its result."""
    result = invoke(*args, "--json")
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


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


def test_unknown_clock_error_is_shown_as_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    """65535 on the wire is no time: null in JSON, and `unknown` in the text."""
    unknown = {**capabilities(4), "clock_error": CLOCK_UNKNOWN}
    monkeypatch.setattr(simulated_amplifier, "capabilities", lambda *_, **__: unknown)
    assert result_of("identify", URL)["clock_error_s"] is None
    assert re.search(r"^clock_error_s +unknown$", invoke("identify", URL).stdout, re.MULTILINE)


def test_stop_needs_no_trace(tmp_path: Path) -> None:
    """With a trace file that cannot be written it stops, while other commands do nothing."""
    options = ("--trace", str(tmp_path / "missing" / "trace.txt"))
    assert isinstance(invoke("clear", URL, *options).exception, CommandError)
    assert invoke("stop", URL, *options).exit_code == 0


def test_conformance_reads_first_and_reports_what_is_left() -> None:
    """All reading checks of a serial line pass; driving ones are not run, and named as next."""
    report = result_of("conformance", URL)
    assert (report["overall"], report["failed"], report["level"]) == ("incomplete", 0, 0.0)
    assert report["not_run"] > 40
    assert {row["result"] for row in report["checks"]} <= {"passed", "skipped"}
    shown = invoke("conformance", URL)
    assert shown.exit_code == 0, shown.output
    assert shown.stdout.splitlines()[-1] == f"Next: era amp conformance '{URL}' --write"


def test_conformance_runs_selected_checks_and_writes_a_junit_report(tmp_path: Path) -> None:
    """Two checks match; the one that drives is left out, and skipped in the report."""
    junit_xml = tmp_path / "conformance.xml"
    options = ("-k", "identity or stop_ramps", "--junitxml", str(junit_xml))
    report = result_of("conformance", URL, *options)
    assert [(row["name"], row["result"]) for row in report["checks"]] == [("identity", "passed")]
    assert report["not_run"] == 1
    (suite,) = ElementTree.parse(junit_xml).getroot()
    cases = {case.get("name"): [child.tag for child in case] for case in suite}
    assert cases == {"identity": [], "stop_ramps": ["skipped"]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("-k", "identity or"), "-k must be an expression of check names, got 'identity or'"),
        (("-k", "idendity"), "-k must be an expression of check names, got 'idendity': no check"),
        (("--junitxml", "/no-such-folder/report.xml"), "JUnit report /no-such-folder/report.xml"),
    ],
)
def test_conformance_rejects_wrong_options_before_any_check(
    options: tuple[str, str], message: str
) -> None:
    """The message names the option and its value."""
    error = invoke("conformance", URL, *options).exception
    assert isinstance(error, CommandError)
    assert str(error).startswith(message)


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

        def judged(
            url: str, *, may_drive: Callable[[int], bool], **options: Any
        ) -> ConformanceReport:
            assert may_drive(1)
            far.amplifiers[1].handle(
                "Arm", {"session": 5, "watchdog": 2000, "shift": 0}, monotonic()
            )
            raise end

        monkeypatch.setattr("era_haptics.lab.conformance.session.judge", judged)
        result = await asyncio.to_thread(invoke, "conformance", far.url(1), "--write")
        assert result.exit_code != 0
        assert f"{far.url(1)} is left in SWITCH_ON_DISABLED" in result.stderr
        assert far.amplifiers[1].state == "SWITCH_ON_DISABLED"


def test_discover_reports_why_a_port_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason stands with the port."""
    port = ListPortInfo("/dev/no-such-port")
    monkeypatch.setattr("drivers.by_hand.discovery.comports", lambda: [port])
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


BUS = "can+socketcan://can0"
REACHING_LIMITS = GuardLimits(40.0, 250.0, 1.0)


def checked(*urls: str, channels: int = 4) -> tuple[dict[str, str], list[str]]:
    """Amplifiers a, b, ... at these URLs, with so many channels each."""
    named = dict(zip("abcd", urls, strict=False))
    return check_links(named, channels=dict.fromkeys(named, channels), limits=REACHING_LIMITS)


@pytest.mark.parametrize("frequencies", [(5.0, 250.0), (40.0, 5000.0)])
def test_check_links_warns_of_limits_beyond_the_ceilings(frequencies: tuple[float, float]) -> None:
    """10 Hz, and 65 535 steps of 1/20 Hz."""
    low, high = frequencies
    limits = replace(REACHING_LIMITS, frequency_min=low, frequency_max=high)
    _, (warning,) = check_links({}, channels={}, limits=limits)
    assert "10 to 3276.75 Hz" in warning


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("serail:///dev/ttyUSB0", r"unknown wire 'serail://'; did you mean serial://\? known:"),
        ("carrier+pigeon://coop", "known: .*modbus.tcp://, serial://, .*sim://"),
        ("serial:///dev/ttyUSB0?baud=fast", "baud must be.*'fast'"),
        ("modbus+tcp://host/999", "unit must be.*'999'"),
        (f"{BUS}#300", "node must be.*'300'"),
        # The longest part of a set, of 120 words, and its reply: 282 bytes of 11 bits and four
        # silences of 3.5 of them at 19200 baud are 170 ms, beside three heartbeats of 50 ms.
        ("modbus+rtu:///dev/ttyS1?baud=19200#1", "at least 320 ms.*got 250 ms; use a faster"),
        ("serial:///dev/ttyUSB9?baud=115200&address=2", "baud must be 921600 .*got 115200"),
    ],
)
def test_check_links_names_an_unusable_url(url: str, message: str) -> None:
    """Unknown scheme, invalid part of a URL, too slow for the watchdog, another speed of a line."""
    wrong, warnings = checked("serial:///dev/ttyUSB9", url)
    assert list(wrong) == ["b"]
    assert re.search(message, wrong["b"])
    assert warnings == []


def test_check_links_refuses_two_amplifiers_at_one_address() -> None:
    """However the URL is spelled; the error is on the second and names the first."""
    wrong, _ = checked(f"{BUS}#1", f"{BUS}#2", f"{BUS}?bitrate=500000#1")
    assert list(wrong) == ["c"]
    assert "amplifier a" in wrong["c"]


@pytest.mark.parametrize(
    ("urls", "times"),
    [
        # 282 bytes of 11 bits, four silences of 1.75 ms, 10 ms for the amplifier: twice each.
        ([f"modbus+rtu:///dev/ttyS1?baud=38400#{unit}" for unit in (1, 2)], ["441 ms"]),
        # At 115 200 baud the longest set is repeated once in 88 ms, a short one twice in 90 ms.
        ([f"modbus+rtu:///dev/ttyS1?baud=115200#{unit}" for unit in (1, 2)], ["230 ms"]),
        (["serial:///dev/ttyUSB0"], []),
        # Three times 30 ms each, after a heartbeat of 50 ms.
        (["serial:///dev/ttyUSB0?address=1", "serial:///dev/ttyUSB0?address=2"], ["230 ms"]),
        (["serial:///dev/ttyUSB0", "modbus+tcp://host/1"], []),
        (["modbus+tcp://host/1", "modbus+tcp://host/2", "modbus+tcp://host/3"], ["320 ms"]),
        ([f"{BUS}#1", f"{BUS}#5"], ["230 ms"]),
    ],
)
def test_check_links_warns_of_late_loss_detection(urls: list[str], times: list[str]) -> None:
    """Slow lines, and lines on which several amplifiers wait for each other; times by hand."""
    wrong, warnings = checked(*urls)
    assert wrong == {}
    late = [warning for warning in warnings if "later than 150 ms" in warning]
    assert [time for warning, time in zip(late, times, strict=True) if time in warning] == times


STATED = 5e-6 / math.sqrt(3)
"""5 us at most either way, all errors alike, are so much rms."""


def arranged(
    *urls: str, channels: Sequence[int] = (4,) * 4, stated: Sequence[float] = (5e-6,) * 4
) -> Arrangement | None:
    """Amplifiers a, b, ... at these URLs, with so many channels and stated errors [s]."""
    named, of_each, errors = (
        dict(zip("abcd", each, strict=False)) for each in (urls, channels, stated)
    )
    return arrangement_of(named, channels=of_each, stated=errors)


@pytest.mark.parametrize(
    ("urls", "kinds", "has_remedy"),
    [
        (["serial:///dev/ttyUSB0", "serial:///dev/ttyUSB1"], ["ftdi-low-latency"] * 2, True),
        (["serial:///dev/ttyACM0", "serial:///dev/ttyAMA0"], ["usb-full-speed", "native"], True),
        (["modbus+rtu:///dev/serial/x#1", "can+slcan:///y#1"], ["usb-full-speed", "can-usb"], True),
        (["serial:///dev/ttyS0", "can+socketcan://can0#1"], ["native", "can"], False),
        (["serial+tcp://one:5000?baud=921600", "modbus+tcp://two/1"], ["ethernet"] * 2, True),
        (
            ["serial:///dev/ttyACM0?line=usb-high-speed", "modbus+rtu:///b?line=native#1"],
            ["usb-high-speed", "native"],
            False,
        ),
        ([f"serial:///dev/ttyS0?address={each}" for each in (1, 2, 3)], ["native"] * 3, False),
        (["modbus+tcp://host/1", "modbus+tcp://host/2"], ["ethernet"] * 2, True),
        (["sim://r?amplifier=a", "sim://r?amplifier=b&line=ftdi"], [SIMULATED, "ftdi"], True),
    ],
)
def test_clocks_are_held_as_closely_as_the_line_allows(
    urls: list[str], kinds: list[str], has_remedy: bool
) -> None:
    """By separate lines of each kind, named or not, one bus, simulated; sums of squares."""
    found = arranged(*urls)
    errors = [math.hypot(STATED, CLOCK_ERRORS[each]) for each in kinds]
    assert [*found.errors.values()] == pytest.approx(errors)
    assert bool(found.remedy) == has_remedy


def test_what_would_be_better_is_not_there_already() -> None:
    """One bus of full speed is held by Marks, whatever its adapter; 0.2 ms are of the clocks."""
    found = arranged(*(f"serial:///dev/ttyACM0?address={each}" for each in (1, 2)))
    assert found.remedy == ""
    assert found.errors["a"] == pytest.approx(math.hypot(STATED, 7e-6))
    wide = arranged("serial:///dev/ttyACM0", "serial:///dev/ttyACM1", stated=[5e-6, 2e-4])
    assert "clock_error" in wide.remedy


def test_every_kind_of_line_that_is_simulated_has_an_error() -> None:
    """Under the same names: what the check says of one is measured with it."""
    assert CLOCK_ERRORS.keys() == {*LINE_KINDS, PROMPT}


def test_kind_of_line_is_stated_or_that_of_the_scheme_or_of_the_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A plug-in has no row in a table of schemes, and the kind of unknown lines."""
    assert line_kind_of("serial:///dev/ttyACM0") == "usb-full-speed"
    assert line_kind_of("can+slcan:///dev/ttyS0") == "can-usb"
    assert line_kind_of("MODBUS+TCP://host/1") == "ethernet"
    assert line_kind_of("example-unix:///run/amplifier?line=native") == "native"
    monkeypatch.setattr(wire, "address_of", SerialAddress)
    assert line_kind_of("serial:///dev/ttyS0") == "native"
    monkeypatch.setattr(SerialAddress, "SCHEMES", {})
    assert line_kind_of("serial:///dev/ttyS0") == UNKNOWN_KIND


def test_one_amplifier_with_eras_has_no_arrangement() -> None:
    """One alone, a second one without ERAs, a URL that is reported elsewhere."""
    one, other = "serial:///dev/ttyUSB0", "serial:///dev/ttyUSB1"
    assert arranged(one) is None
    assert arranged(one, other, channels=[4, 0]) is None
    assert arranged(one, "serail:///dev/ttyUSB0") is None


def test_a_clock_that_cannot_be_steered_is_held_to_nothing() -> None:
    """Whatever the line; the other one is as before."""
    found = arranged("serial:///dev/ttyS0", "serial:///dev/ttyS1", stated=[2e-6, math.inf])
    assert found.errors == {
        "a": pytest.approx(math.hypot(2e-6 / math.sqrt(3), CLOCK_ERRORS["native"])),
        "b": math.inf,
    }
