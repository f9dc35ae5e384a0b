"""Conformance of protocol 4: sound amplifiers pass on every wire, and no verdict is missing."""

import asyncio
import os
import pty
import re
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cobs import cobs

from cases import shortly
from drivers.errors import CommandError, LinkError
from drivers.protocol.definition import REQUEST_NAMES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet
from drivers.trace import tracing
from drivers.wires.can_frames import unpack_frames
from drivers.wires.serial_frames import FrameReader
from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.conformance_report import CheckResult, ConformanceReport
from era_haptics.lab.conformance.contract import of_kind
from era_haptics.lab.conformance.lateness import ON_THE_WAY
from era_haptics.lab.conformance.outcomes import ContractViolation, TooLate
from era_haptics.lab.conformance.request_rows import layer
from era_haptics.lab.conformance.run import ConformanceRun
from era_haptics.lab.conformance.session import judge
from era_haptics.lab.conformance.subject import Subject
from kit.clock import in_virtual_time
from kit.judged_lines import (
    JUDGED_LINE_KINDS,
    JudgedLine,
    judged,
    plain,
    short_checks,
    varied,
)
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

SKIPPED = {
    "serial": {"steps_as_stated", "limited"},
    "can": {"steps_as_stated", "limited"},
    "rtu": {"steps_as_stated", "limited", "events"},
    "tcp": {"steps_as_stated", "limited", "events"},
}
"""Checks of functions that the simulated amplifiers lack."""
MINUTE = 60.0


def names_with(results: Sequence[CheckResult], verdict: str) -> set[str]:
    """Return the names of the checks with a verdict."""
    return {result.check.name for result in results if result.result == verdict}


def verdicts_of(results: Sequence[CheckResult]) -> list[str]:
    """Return the verdicts of all checks in order."""
    return [str(result.result) for result in results]


def expect_passed(results: list[CheckResult], skipped: set[str], *, within: float = MINUTE) -> None:
    """Require that all checks pass at the first attempt, except those that are skipped."""
    failures = {result.check.name: result.reason for result in results if result.result == "failed"}
    assert failures == {}
    assert names_with(results, "skipped") == skipped
    assert {result.attempts for result in results} == {1}
    assert sum(result.seconds for result in results) < within


# Amplifiers that pass


@pytest.mark.parametrize("kind", shortly(JUDGED_LINE_KINDS, ["serial"]))
def test_simulated_amplifier_passes(kind: str) -> None:
    """Every check of its wire; only checks of functions that it lacks are skipped."""
    results = judged(kind)

    assert [result.number for result in results] == [number for number, _ in of_kind(kind)]
    expect_passed(results, SKIPPED[kind])


@pytest.mark.parametrize("kind", [kind for kind in JUDGED_LINE_KINDS if kind != "serial"])
def test_simulated_amplifier_passes_the_checks_of_other_wires(kind: str) -> None:
    """The checks of the wire alone, and some messages that it carries in a different way."""
    expect_passed(judged(kind, short_checks(kind)), set())


@pytest.mark.parametrize("names", shortly([[], ["limited", "voices"]], [["limited", "voices"]]))
def test_amplifier_passes_at_a_high_level(names: list[str]) -> None:
    """At 0.9 of full level, where a sum of layers is limited."""
    results = judged("serial", names, level=0.9, far=plain())

    expect_passed(results, set() if names else SKIPPED["serial"] - {"limited"})


class CoarseAmplifier(SimulatedAmplifier):
    """An amplifier with coarse steps, of frequency from its lowest one on, that reports them."""

    def _play(self, layers: Sequence[LayerSet], token: int, now: float) -> None:
        played = []
        for layer_set in layers:
            tones = [self._rounded(tone) if tone.level else tone for tone in layer_set.commands]
            played.append(replace(layer_set, commands=tuple(tones)))
        super()._play(played, token, now)

    def _rounded(self, tone: Command) -> Command:
        steps = self.capabilities
        limits = steps["limits"][tone.channel]
        lowest = limits["frequency_min"]
        step = steps["frequency_step"]
        highest_count = (limits["frequency_max"] - lowest) // step
        count = min(round((tone.frequency - lowest) / step), highest_count)
        phase = steps["phase_step"] * round(tone.phase / steps["phase_step"])
        level = steps["level_step"] * round(tone.level / steps["level_step"])
        wrapped = (phase + 18_000) % 36_000 - 18_000
        return replace(tone, frequency=lowest + count * step, level=level, phase=wrapped)

    def _take_part(self, part: Values, now: float) -> Values:
        return {**super()._take_part(part, now), "exact": 0}


COARSE_STEPS = [
    {"frequency_step": 20, "level_step": 5},
    {"level_step": 40},
    {"frequency_step": 7},
    {"frequency_step": 30, "phase_step": 300},
    {"frequency_step": 60, "phase_step": 18_000},
    {"frequency_step": 65_535, "phase_step": 77},
]
CHECKS_OF_STEPS = ["steps_as_stated", "achieved", "phases"]


@pytest.mark.parametrize("names", shortly([[], CHECKS_OF_STEPS], [CHECKS_OF_STEPS]))
@pytest.mark.parametrize("steps", shortly(COARSE_STEPS, COARSE_STEPS[:1]))
def test_amplifier_with_coarse_steps_passes(steps: dict[str, int], names: list[str]) -> None:
    """It states them: 1 Hz, thousandths or even 0.4 % of full level, half a circle."""
    far = CoarseAmplifier("coarse", channels=2)
    far.capabilities.update(steps)

    results = judged("serial", names, far=far)

    expect_passed(results, set() if names else SKIPPED["serial"] - {"steps_as_stated"})


def test_level_below_a_step_is_refused() -> None:
    """An amplifier that has full level alone cannot be driven at a fifth of it."""
    far = CoarseAmplifier("coarse", channels=2)
    far.capabilities.update(level_step=10_000)

    with pytest.raises(CommandError, match="at least 1"):
        judged("serial", ["stop"], far=far)


MINIMUM = {
    "ramp_max": 1,
    "set_words": 512,
    "layers": 4,
    "voices": 8,
    "watchdog_min": 500,
    "watchdog_max": 500,
    "envelope_step_min": 1000,
}
CHECKS_OF_MINIMUM = [
    "ramps",
    "watchdog_ranges",
    "max_set",
    "layers_add",
    "every_channel",
    "sets_expire",
]
CHECKS_BEYOND_MINIMUM = {"silence_never_later", "stop_ends_all", "clear_too_early", "voices"}
CHECKS_OF_ENVELOPES = {
    *("after", "onsets", "endings", "endings_amid", "extreme_envelopes"),
    *("after_the_last_onset", "what_waits_for_an_onset"),
}


@pytest.mark.parametrize(
    ("knots", "names"),
    [
        (0, CHECKS_OF_MINIMUM),
        pytest.param(0, [], marks=pytest.mark.long),
        pytest.param(1, [], marks=pytest.mark.long),
    ],
)
def test_amplifier_with_the_minimum_capabilities_passes(knots: int, names: list[str]) -> None:
    """One channel and watchdog time, short ramps, and sets as small as allowed."""
    far = SimulatedAmplifier("least", channels=1)
    far.capabilities.update(MINIMUM, knots=knots)
    far.restart(0.0)
    skipped = SKIPPED["serial"] | CHECKS_BEYOND_MINIMUM
    if not knots:
        skipped |= CHECKS_OF_ENVELOPES

    expect_passed(judged("serial", names, far=far), set() if names else skipped)


# Sessions


@pytest.mark.parametrize("error", [ZeroDivisionError(), KeyboardInterrupt(), LinkError("lost")])
def test_session_raises_errors_that_are_no_verdict(
    error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bug, an interruption and a lost line end the run; none counts as a failed check."""

    async def fail(subject: Subject) -> None:
        raise error

    monkeypatch.setattr(Subject, "watch", fail)

    with pytest.raises(type(error)):
        judged("serial", ["identity", "capabilities"])


def change_messages(
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[bytes], bytes],
    delay: Callable[[bytes], float] = lambda data: 0.0,
) -> None:
    """Change or delay [s] all messages of amplifiers to the host."""
    send = JudgedLine.send

    def send_changed(line: JudgedLine, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        loop.call_later(delay(data), send, line, change(data))

    monkeypatch.setattr(JudgedLine, "send", send_changed)


class PlayingOn(SimulatedAmplifier):
    """An amplifier that plays on after Stop."""

    def _silence(self, moment: float, *, ramp: float) -> None:
        if self.state != "OPERATION_ENABLED":
            super()._silence(moment, ramp=ramp)


def test_nothing_is_run_on_an_amplifier_that_was_not_silenced() -> None:
    """The verdict comes within seconds; the checks that follow would drive it."""
    results = judged("serial", far=PlayingOn("loud", channels=2))

    first = verdicts_of(results).index("not_run")
    failed = results[first - 1]
    assert failed.result == "failed"
    for result in results[first:]:
        assert result.result == "not_run", result.check.name
        assert failed.check.name in result.reason
    assert sum(result.seconds for result in results) < 10


def mute(data: bytes) -> bytes:
    """Return no reply."""
    return b""


def only_hello(data: bytes) -> bytes:
    """Return the reply to Hello, whose type 81 follows a zero and a number of the stuffing."""
    return data if data[2] == 0x81 else b""


def reverse_crc(data: bytes) -> bytes:
    """Return the reply with the CRC low byte first."""
    content = cobs.decode(data[1:-1])
    stuffed: bytes = cobs.encode(content[:-4] + content[:-5:-1])
    return b"\0" + stuffed + b"\0"


@pytest.mark.parametrize(
    ("change", "passed_count", "reason"),
    [
        (mute, 0, r"Hello \(message 1\): no reply within 0.5 s"),
        (
            reverse_crc,
            0,
            r"Hello \(message 1\): no reply within 0.5 s, but \d+ other bytes, whose CRC fits with "
            "its four bytes reversed: it goes low byte first",
        ),
        (only_hello, 1, r"GetCaps \(message 2\): no reply within 0.5 s"),
    ],
)
def test_amplifier_that_is_not_identified_fails_once(
    change: Callable[[bytes], bytes],
    passed_count: int,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the message and the cause; a good Hello has passed, and nothing is driven."""
    change_messages(monkeypatch, change)

    results = judged("serial", far=plain())

    failed = results[passed_count]
    skipped = results[passed_count + 1 :]
    expected = ["passed"] * passed_count + ["failed"] + ["not_run"] * len(skipped)
    assert verdicts_of(results) == expected
    assert re.fullmatch(reason, failed.reason), failed.reason
    reasons = {result.reason for result in skipped}
    assert reasons == {f"not run because {failed.check.name} failed"}
    assert ConformanceReport("x", 0.2, tuple(results), 0).to_json()["level"] == 0


@pytest.mark.parametrize("kind", JUDGED_LINE_KINDS)
def test_malformed_reply_fails_one_check_with_its_bytes(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The eleventh is cut in its middle, and its last byte is wrong; later checks pass."""
    replies: list[bytes] = []

    def damage_one(data: bytes) -> bytes:
        if len(replies) == 10:
            middle = len(data) // 22 * 11  # a whole frame of CAN
            data = data[:middle] if kind == "can" else data[:middle] + b"\x55\0"
        replies.append(data)
        return data

    change_messages(monkeypatch, damage_one)
    names = ["identity", "capabilities", "starts_disarmed", "replies_in_time", "stop"]

    results = judged(kind, names)

    assert sorted(verdicts_of(results)) == ["failed", *["passed"] * 4], results
    (failed,) = [result for result in results if result.result == "failed"]
    damaged = replies[10]
    if kind == "can":
        damaged = b"".join(frame.data for frame in unpack_frames(damaged))
    assert damaged.hex(" ") in failed.outcome.last_bytes


def test_bad_capability_is_a_single_failure() -> None:
    """Checks that need the steps of envelopes are not run; all others have their verdicts."""
    far = varied()
    far.capabilities.update(envelope_step_min=900)
    names = ["capabilities", "replies_in_time", "stop", "watchdog", "onsets", "endings", "voices"]

    results = judged("serial", names, far=far)

    by_name = {result.check.name: result for result in results}
    assert names_with(results, "failed") == {"capabilities"}
    assert "900" in by_name["capabilities"].outcome.expected
    assert names_with(results, "not_run") == {"onsets", "endings", "voices"}
    for name in ("onsets", "endings", "voices"):
        assert "envelope_step_max" in by_name[name].reason


def exchange_words(clock: int) -> int:
    """Return a clock of 32 bits with its words exchanged."""
    return (clock & 0xFFFF) << 16 | clock >> 16


def stand_still(clock: int) -> int:
    """Return one value."""
    return 7


@pytest.mark.parametrize("change", [exchange_words, stand_still])
def test_wrong_clock_is_a_single_failure(
    change: Callable[[int], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is driven then, and each check states why."""
    status = SimulatedAmplifier.status

    def status_with_clock(far: SimulatedAmplifier, now: float) -> Values:
        values = status(far, now)
        return {**values, "clock": change(values["clock"])}

    monkeypatch.setattr(SimulatedAmplifier, "status", status_with_clock)

    results = judged("serial")

    assert names_with(results, "failed") == {"clock_goes_on"}
    for result in results:
        if result.check.drives:
            assert result.result == "not_run", result.check.name
            assert "clock" in result.reason


# Delays


def stall(duration: float) -> None:
    """Let this program be late by a time [s]."""
    asyncio.get_running_loop().now += duration


async def drive(stalls: list[float], subject: Subject) -> None:
    """Drive the amplifier, with a stall of this program."""
    await subject.arm()
    await subject.play(layer(0, subject.tone(), ramp=100))
    if stalls:
        stall(stalls.pop())
    await subject.follow(0.12)


async def fail(stalls: list[float], subject: Subject) -> None:
    """Fail with a stall of this program, as long as there are some."""
    if stalls:
        stall(stalls.pop())
        await asyncio.sleep(0.02)
        raise ContractViolation("it", expected="right", actual="wrong")


Steps = Callable[[list[float], Subject], Any]


def stalling_check(stalls: list[float], steps: Steps = drive) -> ConformanceCheck:
    """Return a check whose attempts are stalled by these times [s], the last first."""
    attempt = partial(steps, stalls)
    return ConformanceCheck("stalled", "passes", "", drives=True, kinds=(), steps=attempt)


@pytest.mark.parametrize(
    ("steps", "stalls", "verdict"),
    [
        (drive, [0.11, 1.45], "passed"),
        (fail, [0.1, 0.1], "passed"),
        (fail, [0.1, 0.1, 0.1], "failed"),
        (fail, [0.0, 0.1, 0.1], "failed"),
    ],
)
@in_virtual_time
async def test_check_is_repeated_if_this_program_was_late(
    steps: Steps, stalls: list[float], verdict: str
) -> None:
    """Its third attempt decides, disturbed or not: a stall is no fault of the amplifier."""
    with closing(JudgedLine("serial", varied())) as line:
        check = stalling_check(stalls, steps)
        result = await ConformanceRun(line.client, 0.2).check(1, check)

    assert result.result == verdict
    assert result.attempts == 3


@in_virtual_time
async def test_program_that_is_always_late_has_no_verdict() -> None:
    """The amplifier neither fails nor passes; the next check is run.

    After 20 s of attempts that came too late no attempt follows, and the reason states it.
    """
    with closing(JudgedLine("serial", varied())) as line:
        run = ConformanceRun(line.client, 0.2)
        late = await run.check(1, stalling_check([0.11] * 20))
        punctual = await run.check(2, stalling_check([]))
        line.client.lateness.wasted = 20.0
        last = await run.check(1, stalling_check([0.11]))

    assert verdicts_of([late, punctual]) == ["skipped", "passed"]
    assert isinstance(late.outcome, TooLate)
    assert ConformanceReport("x", 0.2, (late, punctual), 0).overall == "incomplete"
    assert isinstance(last.outcome, TooLate)
    sentence = "no verdict because the time for repetitions is used up: "
    assert last.reason.startswith(sentence), last.reason


def obey_late(monkeypatch: pytest.MonkeyPatch, delay: float) -> None:
    """Delay [s] the replies of a serial amplifier, except to requests that only read."""

    def delay_of(data: bytes) -> float:
        (frame,) = FrameReader().feed(data)
        name = REQUEST_NAMES.get(frame.type & 0x7F)
        return 0.0 if name in ("GetStatus", "GetCaps", "GetFaults") else delay

    change_messages(monkeypatch, lambda data: data, delay_of)


class LongWatchdog(SimulatedAmplifier):
    """An amplifier that takes a watchdog shorter than 120 ms as one of 1.5 s."""

    def handle(self, name: str, values: Values, now: float) -> Values:
        if name == "Arm" and values["watchdog"] < 120:
            values = {**values, "watchdog": 1500}
        return super().handle(name, values, now)


@pytest.mark.parametrize(
    ("amplifier", "verdict"), [(SimulatedAmplifier, "passed"), (LongWatchdog, "failed")]
)
def test_shortest_watchdog_is_tried_though_it_cannot_be_fed(
    amplifier: type[SimulatedAmplifier], verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A watchdog of 100 ms with replies that take 12 ms."""
    obey_late(monkeypatch, 0.012)
    far = amplifier("short", channels=2)
    far.capabilities.update(watchdog_min=100)

    (result,) = judged("serial", ["watchdog_ranges"], far=far)

    assert result.result == verdict, result.reason
    if verdict == "failed":
        assert "watchdog" in result.outcome.actual


def test_amplifier_that_obeys_late_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """After 25 ms: replies to requests that only read are in time."""
    obey_late(monkeypatch, 0.025)

    read, obeyed = judged("serial", ["replies_in_time", "obeys_in_time"])

    assert verdicts_of([read, obeyed]) == ["passed", "failed"], obeyed.reason
    milliseconds = float(obeyed.outcome.actual.split(": ")[1])
    assert milliseconds == pytest.approx(25, abs=0.5)


CHECKS_OF_TIME = ["obeys_in_time", "watchdog", "valid_for", "after"]
CHECKS_OF_TIME += ["ramps", "onsets", "phases", "voices"]


class Unsteered(SimulatedAmplifier):
    """An amplifier whose clock ignores the rate of a Ping."""

    def handle(self, name: str, values: Values, now: float) -> Values:
        if name == "Ping":
            values = {**values, "rate": 0}
        return super().handle(name, values, now)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["can", "rtu"])
@pytest.mark.parametrize(
    ("amplifier", "verdict"), [(SimulatedAmplifier, "passed"), (Unsteered, "failed")]
)
def test_rate_of_a_clock_is_tried_on_a_slow_wire(
    kind: str,
    amplifier: type[SimulatedAmplifier],
    verdict: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where a status takes 8 ms, as at 115 200 baud: 3.3 ms a second show within 6 s."""
    monkeypatch.setattr("kit.judged_lines.DELAY", 0.004)

    results = judged(kind, ["clock_rate"], far=amplifier("steered", channels=4))

    assert verdicts_of(results) == [verdict], results


def hold(line: JudgedLine) -> None:
    """Hold back messages for 100 ms."""
    line.due = asyncio.get_running_loop().time() + 0.1


def outlive_a_set(line: JudgedLine) -> None:
    """Be late by more than the lifetime of a set."""
    stall(1.1)


@pytest.mark.parametrize(
    ("name", "positions", "method", "disturb"),
    [
        ("doubled_frames", range(22), "send", hold),
        pytest.param("events", range(15), "send", hold, marks=pytest.mark.long),
        ("parts_that_are_dropped", range(15, 45, 3), "write", outlive_a_set),
        ("parts_again", range(15, 35, 3), "write", outlive_a_set),
    ],
)
def test_late_message_is_no_violation(
    name: str,
    positions: range,
    method: str,
    disturb: Callable[[JudgedLine], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each message in turn, and all behind it, arrives 100 ms late, or is sent 1.1 s late."""
    send = getattr(JudgedLine, method)
    countdown = deque[bool]()

    def send_late(line: JudgedLine, data: bytes) -> None:
        if countdown and countdown.popleft():
            disturb(line)
        send(line, data)

    monkeypatch.setattr(JudgedLine, method, send_late)
    for position in positions:
        countdown = deque([False] * position + [True])

        (result,) = judged("serial", [name])

        assert result.result == "passed", (position, result.reason)


@in_virtual_time
async def test_reply_delayed_on_the_way_is_no_violation() -> None:
    """A Status 600 ms late, seen once without time to repeat the check: no verdict, and why."""
    with closing(JudgedLine("serial", varied())) as line:

        async def read_late(subject: Subject) -> None:
            await subject.request("GetStatus")
            line.due = asyncio.get_running_loop().time() + 0.6
            await subject.request("GetStatus")

        check = ConformanceCheck("late", "passes", "", drives=False, kinds=(), steps=read_late)
        line.client.lateness.wasted = 20.0
        result = await ConformanceRun(line.client, 0.2).check(1, check)

    assert isinstance(result.outcome, TooLate), result
    assert ON_THE_WAY in result.reason


@in_virtual_time
async def test_late_reply_on_a_late_machine_is_no_violation() -> None:
    """Every attempt gets one Status 600 ms late while this machine is late too: no verdict."""
    with closing(JudgedLine("serial", varied())) as line:

        async def read_late(subject: Subject) -> None:
            await subject.request("GetStatus")
            line.client.lateness.lag = 0.1
            line.due = asyncio.get_running_loop().time() + 0.6
            await subject.request("GetStatus")

        check = ConformanceCheck("late", "passes", "", drives=False, kinds=(), steps=read_late)
        result = await ConformanceRun(line.client, 0.2).check(1, check)

    assert isinstance(result.outcome, TooLate), result
    assert ON_THE_WAY in result.reason


@pytest.mark.parametrize("size", shortly([1, 3, 8, 64], [1, 8]))
def test_rtu_response_can_arrive_in_pieces(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tag 65535 and zeros behind it are a valid frame of unit 255 inside a response."""
    send = JudgedLine.send

    def send_pieces(line: JudgedLine, data: bytes) -> None:
        for start in range(0, len(data), size):
            send(line, data[start : start + size])

    monkeypatch.setattr(JudgedLine, "send", send_pieces)

    results = judged("rtu", ["areas", "replies_in_time"])

    expect_passed(results, set())


@pytest.mark.parametrize("kind", shortly(["rtu", "tcp"], ["rtu"]))
def test_ages_of_faults_can_change_between_two_reads(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A list with two faults, read by both functions 8 ms after each other."""
    monkeypatch.setattr("kit.judged_lines.DELAY", 0.004)
    far = plain()
    for fault in ("WATCHDOG", "ARC"):
        far.trip(fault, 0.0)

    results = judged(kind, ["areas"], far=far)

    expect_passed(results, set())


# A real port

KEYS_OF_REPORT = "url overall level passed failed skipped not_run seconds checks"
KEYS_OF_CHECK = (
    "number name requirement place result reason seen expected seconds attempts sent came remedy"
)


async def test_verdict_over_a_real_port(tmp_path: Path) -> None:
    """Checks that only read; the keys of the report are a contract, and all frames are traced."""
    far, near = pty.openpty()
    loop = asyncio.get_running_loop()
    end = SerialAmplifiers({1: plain()}, partial(os.write, far))
    loop.add_reader(far, lambda: end.receive(os.read(far, 4096), threads.now()))
    trace = tmp_path / "trace"

    with tracing(trace):
        url = f"serial://{os.ttyname(near)}"
        report = await asyncio.to_thread(judge, url, may_drive=lambda count: False)
    loop.remove_reader(far)
    os.close(far)
    os.close(near)

    assert {">", "<"} <= set(trace.read_text().split())
    fields = report.to_json()
    assert fields["overall"] == "incomplete"
    assert fields["failed"] == 0
    assert fields["level"] == 0.0
    assert list(fields) == KEYS_OF_REPORT.split()
    assert list(fields["checks"][0]) == KEYS_OF_CHECK.split()
    assert fields["not_run"] == sum(check.drives for _, check in of_kind("serial"))
