"""Conformance of protocol 4: sound amplifiers pass on every wire, and no verdict is missing."""

import asyncio
import math
import os
import pty
import re
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cobs import cobs

import era_haptics
from cases import shortly
from drivers.errors import CommandError, LinkError
from drivers.protocol.definition import REQUEST_NAMES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers
from drivers.trace import tracing
from drivers.wires.can_frames import unpack_frames
from drivers.wires.serial_frames import FrameReader
from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.checks import state_checks
from era_haptics.lab.conformance.conformance_report import CheckResult, ConformanceReport, Result
from era_haptics.lab.conformance.contract import CHECKS, of_kind
from era_haptics.lab.conformance.judge import Judge
from era_haptics.lab.conformance.outcomes import ContractViolation, TooLate
from era_haptics.lab.conformance.request_rows import layer
from era_haptics.lab.conformance.run import ConformanceRun
from era_haptics.lab.conformance.session import judge
from era_haptics.lab.conformance.set_text import set_text
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expectations.tolerances import Interval
from kit.clock import (
    JUDGED_LINE_KINDS,
    JudgedLine,
    in_virtual_time,
    judged,
    plain,
    short_checks,
    varied,
)
from registry import threads
from sim.amplifier.readings import capabilities
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

SKIPPED = {
    "serial": {"steps_as_stated", "limited"},
    "can": {"steps_as_stated", "limited"},
    "rtu": {"steps_as_stated", "limited", "events"},
    "tcp": {"steps_as_stated", "limited", "events"},
}
MINUTE = 60.0
PAGES = Path(era_haptics.__file__).parents[1] / "docs" / "reference"


def expect_passed(results: list[CheckResult], skipped: set[str], *, within: float = MINUTE) -> None:
    """Require that all have passed but those that are skipped, within a minute or another time."""
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed[0]
    assert {each.check.name for each in results if each.result == "skipped"} == skipped
    assert {each.attempts for each in results} == {1}
    assert sum(each.seconds for each in results) < within


def changed(
    monkeypatch: pytest.MonkeyPatch, method: str, change: Callable[[bytes], tuple[float, bytes]]
) -> None:
    """Let lines pass on by a method, after a time [s], what becomes of each message.

    write: of the host; send: of its amplifier.
    """
    pass_on = getattr(JudgedLine, method)

    def passed(line: JudgedLine, data: bytes) -> None:
        delay, sent = change(data)
        asyncio.get_running_loop().call_later(delay, pass_on, line, sent)

    monkeypatch.setattr(JudgedLine, method, passed)


@pytest.mark.parametrize("kind", shortly(JUDGED_LINE_KINDS, ["serial"]))
def test_simulated_amplifier_passes(kind: str) -> None:
    """Every check of its wire; nothing is skipped but what it has not."""
    results = judged(kind)
    assert [result.number for result in results] == [number for number, _ in of_kind(kind)]
    expect_passed(results, SKIPPED[kind])


@pytest.mark.parametrize("kind", [kind for kind in JUDGED_LINE_KINDS if kind != "serial"])
def test_simulated_amplifier_passes_what_serial_lines_lack(kind: str) -> None:
    """The checks of the wire alone, and some that it carries in a way of its own."""
    expect_passed(judged(kind, short_checks(kind)), set())


@pytest.mark.parametrize("names", shortly([[], ["limited", "voices"]], [["limited", "voices"]]))
def test_amplifier_with_the_whole_table_passes_loud(names: list[str]) -> None:
    """At 0.9 of full level, where a sum of layers is limited."""
    results = judged("serial", names, level=0.9, far=plain())
    expect_passed(results, set() if names else SKIPPED["serial"] - {"limited"})


class _Coarse(SimulatedAmplifier):
    """An amplifier that keeps its own steps, of frequency from its lowest one on, and says so."""

    def _play(self, layers: Sequence[LayerSet], token: int, now: float) -> None:
        played = [replace(one, commands=tuple(map(self._rounded, one.commands))) for one in layers]
        super()._play(played, token, now)

    def _rounded(self, tone: Command) -> Command:
        if not tone.level:
            return tone
        can, limits = self.capabilities, self.capabilities["limits"][tone.channel]
        lowest, highest = limits["frequency_min"], limits["frequency_max"]
        step = can["frequency_step"]
        steps = min(round((tone.frequency - lowest) / step), (highest - lowest) // step)
        phase = can["phase_step"] * round(tone.phase / can["phase_step"])
        return replace(
            tone,
            frequency=lowest + steps * step,
            level=can["level_step"] * round(tone.level / can["level_step"]),
            phase=(phase + 18_000) % 36_000 - 18_000,
        )

    def _take_part(self, part: Values, now: float) -> Values:
        return {**super()._take_part(part, now), "exact": 0}


OWN_STEPS = [
    {"frequency_step": 20, "level_step": 5},
    {"level_step": 40},
    {"frequency_step": 7},
    {"frequency_step": 30, "phase_step": 300},
    {"frequency_step": 60, "phase_step": 18_000},
    {"frequency_step": 65_535, "phase_step": 77},
]

ROUNDED = ["steps_as_stated", "achieved", "phases"]
"""Checks of which what is rounded is the subject."""


@pytest.mark.parametrize("names", shortly([[], ROUNDED], [ROUNDED]))
@pytest.mark.parametrize("steps", shortly(OWN_STEPS, OWN_STEPS[:1]))
def test_amplifier_that_keeps_its_own_steps_passes(steps: dict[str, int], names: list[str]) -> None:
    """Those that it states: 1 Hz, thousandths or even 0.4 % of full level, half a circle."""
    far = _Coarse("coarse", channels=2)
    far.capabilities.update(steps)
    skipped = set() if names else SKIPPED["serial"] - {"steps_as_stated"}
    expect_passed(judged("serial", names, far=far), skipped)


LEAST = ["ramps", "watchdog_ranges", "max_set", "layers_add", "every_channel", "sets_expire"]


@pytest.mark.parametrize(
    ("knots", "names"),
    [
        (0, LEAST),
        pytest.param(0, [], marks=pytest.mark.long),
        pytest.param(1, [], marks=pytest.mark.long),
    ],
)
def test_amplifier_with_the_least_of_all_passes(knots: int, names: list[str]) -> None:
    """One channel and watchdog time, short ramps, and what of its sets such an amplifier has."""
    far = SimulatedAmplifier("least", channels=1)
    least = {"knots": knots, "ramp_max": 1, "set_words": 512, "layers": 4, "voices": 8}
    times = {"watchdog_min": 500, "watchdog_max": 500, "envelope_step_min": 1000}
    far.capabilities.update(least | times)
    far.restart(0.0)
    short = {"silence_never_later", "stop_ends_all", "clear_too_early", "voices"}
    shaped = {"after", "onsets", "endings", "endings_amid", "extreme_envelopes"}
    shaped |= {"after_the_last_onset", "what_waits_for_an_onset"}
    skipped = SKIPPED["serial"] | short | (set() if knots else shaped)
    expect_passed(judged("serial", names, far=far), set() if names else skipped)


def test_session_ignores_the_users_pytest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither options and plug-ins of the environment nor a conftest.py are read."""
    (tmp_path / "conftest.py").write_text("raise RuntimeError", encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --nonsense\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTEST_ADDOPTS", "--nonsense")
    monkeypatch.setenv("PYTEST_PLUGINS", "no_such_plugin")
    (result,) = judged("serial", ["identity"])
    assert result.result is Result.PASSED


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


def test_level_below_a_step_is_refused() -> None:
    """An amplifier that has full level alone cannot be driven at a fifth of it."""
    far = _Coarse("coarse", channels=2)
    far.capabilities.update(level_step=10_000)
    with pytest.raises(CommandError, match="at least 1"):
        judged("serial", ["stop"], far=far)


class _PlaysOn(SimulatedAmplifier):
    """An amplifier that plays on after Stop."""

    def _silence(self, moment: float, *, ramp: float) -> None:
        if self.state != "OPERATION_ENABLED":
            super()._silence(moment, ramp=ramp)


def test_nothing_is_run_after_one_that_is_not_silenced() -> None:
    """The verdict comes within seconds: the checks that follow would drive it."""
    results = judged("serial", far=_PlaysOn("loud", channels=2))
    at = [each.result for each in results].index(Result.NOT_RUN)
    assert results[at - 1].result is Result.FAILED
    assert {each.result for each in results[at:]} == {Result.NOT_RUN}
    assert all(results[at - 1].check.name in each.reason for each in results[at:])
    assert sum(each.seconds for each in results) < 10


def _with_crc_reversed(data: bytes) -> bytes:
    content = cobs.decode(data[1:-1])
    stuffed: bytes = cobs.encode(content[:-4] + content[:-5:-1])
    return b"\0" + stuffed + b"\0"


# Behind a zero and a number of the stuffing comes the type: 81 of the reply to Hello.
@pytest.mark.parametrize(
    ("alter", "passed", "reason"),
    [
        (lambda data: b"", 0, r"Hello \(message 1\): no reply within 0.5 s"),
        (
            _with_crc_reversed,
            0,
            r"Hello \(message 1\): no reply within 0.5 s, but \d+ other bytes, whose CRC fits with "
            "its four bytes reversed: it goes low byte first",
        ),
        (
            lambda data: data * (data[2:3] == b"\x81"),
            1,
            r"GetCaps \(message 2\): no reply within 0.5 s",
        ),
    ],
    ids=["mute", "crc reversed", "hello alone"],
)
def test_amplifier_that_is_not_identified_fails_once(
    alter: Callable[[bytes], bytes], passed: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the message and the cause; a good Hello has passed, and what follows is not run."""
    changed(monkeypatch, "send", lambda data: (0.0, alter(data)))
    before, (failed, *others) = (found := judged("serial", far=plain()))[:passed], found[passed:]
    assert [each.result for each in before] == [Result.PASSED] * passed
    assert failed.result is Result.FAILED
    assert re.fullmatch(reason, failed.reason), failed.reason
    after = {(each.result, each.reason) for each in others}
    assert after == {(Result.NOT_RUN, f"not run because {failed.check.name} failed")}
    assert (
        ConformanceReport("x", 0.2, tuple(found), 0).to_json()["level"] == 0
    )  # nothing was driven


def _stall(duration: float) -> None:
    asyncio.get_running_loop().now += duration


async def _stalled(stalls: list[float], subject: Subject) -> None:
    """Drive it amid a stall of this program."""
    await subject.arm()
    await subject.play(layer(0, subject.tone(), ramp=100))
    if stalls:
        _stall(stalls.pop())
    await subject.follow(0.12)


def _tried(
    stalls: list[float], steps: Callable[[list[float], Subject], Any] = _stalled
) -> ConformanceCheck:
    return ConformanceCheck(
        "stalled", "passes", "", drives=True, kinds=(), steps=partial(steps, stalls)
    )


async def _wrong(stalls: list[float], subject: Subject) -> None:
    """Find what is wrong amid a stall of this program, as long as there are some."""
    if stalls:
        _stall(stalls.pop())
        await asyncio.sleep(0.02)
        raise ContractViolation("it", expected="right", actual="wrong")


@pytest.mark.parametrize(
    ("steps", "stalls", "result"),
    [
        (_stalled, [0.11, 1.45], "passed"),
        (_wrong, [0.1, 0.1], "passed"),
        (_wrong, [0.1, 0.1, 0.1], "failed"),
        (_wrong, [0.0, 0.1, 0.1], "failed"),
    ],
)
@in_virtual_time
async def test_check_is_made_again_where_this_program_was_late(
    steps: Callable[[list[float], Subject], Any], stalls: list[float], result: str
) -> None:
    """Its third attempt decides, undisturbed or not: a stall is no fault of the amplifier."""
    with closing(JudgedLine("serial", varied())) as line:
        found = await ConformanceRun(line.client, 0.2).check(1, _tried(stalls, steps))
    assert (found.result, found.attempts) == (result, 3)


@in_virtual_time
async def test_machine_that_is_always_late_has_no_verdict() -> None:
    """It is no failure of the amplifier, and not passed; what follows is checked.

    After 20 s of attempts that came too late no attempt follows, and the reason says so.
    """
    with closing(JudgedLine("serial", varied())) as line:
        run = ConformanceRun(line.client, 0.2)
        late = await run.check(1, _tried([0.11] * 20))
        good = await run.check(2, _tried([]))
        line.client.lateness.wasted = 20.0
        last = await run.check(1, _tried([0.11]))
    assert (late.result, good.result) == ("skipped", "passed")
    assert isinstance(late.outcome, TooLate)
    assert ConformanceReport("x", 0.2, (late, good), 0).overall == "incomplete"
    assert isinstance(last.outcome, TooLate)
    assert last.reason.startswith("no verdict because the time for repetitions is used up: "), (
        last.reason
    )


def obey_late(monkeypatch: pytest.MonkeyPatch, delay: float) -> None:
    """Let the amplifier of a serial line reply late [s] to all but what is only read."""

    def late(data: bytes) -> tuple[float, bytes]:
        (frame,) = FrameReader().feed(data)
        is_late = REQUEST_NAMES.get(frame.type & 0x7F) not in ("GetStatus", "GetCaps", "GetFaults")
        return is_late * delay, data

    changed(monkeypatch, "send", late)


class _LongWatchdog(SimulatedAmplifier):
    """An amplifier that takes a watchdog shorter than 120 ms as one of 1.5 s."""

    def handle(self, name: str, values: Values, now: float) -> Values:
        if name == "Arm" and values["watchdog"] < 120:
            values = {**values, "watchdog": 1500}
        return super().handle(name, values, now)


def test_shortest_watchdog_is_tried_though_it_cannot_be_fed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One of 100 ms beside replies that take 12 ms: as stated it passes, else it fails."""
    obey_late(monkeypatch, 0.012)
    found = []
    for kind in (SimulatedAmplifier, _LongWatchdog):
        far = kind("short", channels=2)
        far.capabilities.update(watchdog_min=100)
        found += judged("serial", ["watchdog_ranges"], far=far)
    assert [each.result for each in found] == ["passed", "failed"], found
    assert "watchdog" in found[1].outcome.actual


def test_amplifier_that_obeys_late_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """After 25 ms: what is only read, at once, is in time; the rest is not, with its time."""
    obey_late(monkeypatch, 0.025)
    read, obeyed = judged("serial", ["replies_in_time", "obeys_in_time"])
    assert (read.result, obeyed.result) == ("passed", "failed"), obeyed.reason
    assert float(obeyed.outcome.actual.split(": ")[1]) == pytest.approx(25, abs=0.5)  # ms


TIMED = ["obeys_in_time", "watchdog", "valid_for", "after", "ramps", "onsets", "phases", "voices"]
"""Checks that need this machine, and replies, in time."""


@pytest.mark.parametrize("names", shortly([[], TIMED], [TIMED]))
@pytest.mark.parametrize("kind", shortly(["serial", "tcp"], ["tcp"]))
def test_amplifier_that_replies_just_in_time_passes(
    kind: str, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After 9 ms, where 10 are allowed: every check has its verdict, or says what is not seen."""
    monkeypatch.setattr("kit.clock.DELAY", 0.0045)
    skipped = set() if names else SKIPPED[kind]
    twice = kind == "tcp"  # each request that changes something is a write and a read
    expect_passed(judged(kind, names), skipped, within=(1.7 if twice else 1.4) * MINUTE)


class _Unsteered(SimulatedAmplifier):
    """An amplifier whose clock ignores the rate of a Ping."""

    def handle(self, name: str, values: Values, now: float) -> Values:
        return super().handle(name, {**values, "rate": 0} if name == "Ping" else values, now)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["can", "rtu"])
def test_rate_of_a_clock_is_tried_on_a_slow_wire(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a status takes 8 ms, as at 115 200 baud: 3.3 ms a second show within 6 s."""
    monkeypatch.setattr("kit.clock.DELAY", 0.004)
    found = [
        judged(kind, ["clock_rate"], far=each("steered", channels=4))
        for each in (SimulatedAmplifier, _Unsteered)
    ]
    assert [each.result for (each,) in found] == ["passed", "failed"], found


def _hold(line: JudgedLine) -> None:
    line.due = asyncio.get_running_loop().time() + 0.1


@pytest.mark.parametrize(
    ("name", "held", "method", "hold"),
    [
        ("doubled_frames", range(22), "send", _hold),
        pytest.param("events", range(15), "send", _hold, marks=pytest.mark.long),
        # As long as a set lives
        ("parts_that_are_dropped", range(15, 45, 3), "write", lambda line: _stall(1.1)),
        ("parts_again", range(15, 35, 3), "write", lambda line: _stall(1.1)),
    ],
)
def test_message_that_is_held_is_no_violation(
    name: str,
    held: range,
    method: str,
    hold: Callable[[JudgedLine], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each in turn, and all behind it, comes 100 ms late, or is sent 1.1 s late."""
    send = getattr(JudgedLine, method)
    for at in held:
        numbers = iter(range(10_000))

        def sent(line: JudgedLine, data: bytes, at: int = at, numbers: Any = numbers) -> None:
            if next(numbers) == at:
                hold(line)
            send(line, data)

        monkeypatch.setattr(JudgedLine, method, sent)
        (result,) = judged("serial", [name])
        assert result.result is Result.PASSED, (at, result.reason)


async def test_verdict_over_a_real_port(tmp_path: Path) -> None:
    """Those that only read; the keys of the report are a contract, and all frames are traced."""
    far, near = pty.openpty()
    loop = asyncio.get_running_loop()
    end = SerialAmplifiers({1: plain()}, partial(os.write, far))
    loop.add_reader(far, lambda: end.receive(os.read(far, 4096), threads.now()))
    url = f"serial://{os.ttyname(near)}"
    with tracing(tmp_path / "trace"):
        report = await asyncio.to_thread(judge, url, may_drive=lambda count: False)
    lines = (tmp_path / "trace").read_text().splitlines()
    assert {">", "<"} <= {word for line in lines for word in line.split()}
    loop.remove_reader(far)
    os.close(far)
    os.close(near)
    shown = report.to_json()
    assert (shown["overall"], shown["failed"], shown["level"]) == ("incomplete", 0, 0.0)
    assert list(shown) == [
        "url",
        "overall",
        "level",
        "passed",
        "failed",
        "skipped",
        "not_run",
        "seconds",
        "checks",
    ]
    assert list(shown["checks"][0]) == [
        "number",
        "name",
        "requirement",
        "place",
        "result",
        "reason",
        "seen",
        "expected",
        "seconds",
        "attempts",
        "sent",
        "came",
        "remedy",
    ]
    assert shown["not_run"] == sum(check.drives for _, check in of_kind("serial"))


def test_report_says_the_worst() -> None:
    """One that failed makes all fail; a violation says what must be, and what was seen."""
    found = ContractViolation("latch", expected=3, actual=4)
    assert (str(found), found.actual) == ("latch must be 3, got 4", "latch: 4")
    for empty in ("", set[int](), b""):
        assert (
            str(ContractViolation("reply", expected=empty, actual=0)) == "reply must be none, got 0"
        )
    bad = CheckResult(CHECKS[0], 1, Result.FAILED, str(found), found)
    good = CheckResult(state_checks.stop, 2, Result.PASSED)
    assert ConformanceReport("x", 0.2, (bad, good), 0).overall == "failed"
    assert ConformanceReport("x", 0.2, (good,), 1).overall == "incomplete"
    report = ConformanceReport("x", 0.2, (good,), 0)
    assert (report.overall, report.to_json()["passed"]) == ("passed", 1)
    assert "driven at up to 20%" in report.summary


def failed_with(check: ConformanceCheck, reason: str) -> CheckResult:
    """A check that failed with a reason."""
    return CheckResult(check, 1, Result.FAILED, reason)


def test_report_names_first_a_value_that_several_checks_found_wrong() -> None:
    """A latch that two checks report, with its rule; not a token of a single check."""
    reasons = ("latch after Stop must be 2, got 0", "latch after Clear must be 3, got 1")
    failed = [*map(failed_with, CHECKS, (*reasons, "token after Arm must be 0, got 1"))]
    report = ConformanceReport("x", 0.2, tuple(failed), 0)
    assert report.fix_first == ["latch in 2 checks (protocol.md#states)"]


def test_failure_has_the_remedy_of_the_rule_that_is_violated() -> None:
    """Of the check, but of the watchdog if a check of Stop found that wrong."""
    own = failed_with(state_checks.stop, "latch after Stop must be 2, got 0")
    other = failed_with(state_checks.stop, "watchdog_left after Arm must be 0.5, got 0.6")
    assert own.advice == (state_checks.stop.place, state_checks.stop.remedy)
    assert other.advice[0] == "protocol.md#sessions-and-the-watchdog"
    assert other.to_json()["remedy"] == other.advice[1] != state_checks.stop.remedy


def test_every_check_has_a_title_a_remedy_and_a_rule() -> None:
    """Each title is a stimulus, a colon and a reaction; each rule is a heading of a page.

    The page on writing an amplifier counts all checks of a serial line.
    """
    names = [check.name for check in CHECKS]
    assert len({*names}) == len(names)
    drives = [check.drives for check in CHECKS]
    assert drives == sorted(drives), "checks that only read come first"
    for check in CHECKS:
        assert re.fullmatch(r"[^:]+: [^.]+", check.title), check.title
        assert len(check.title) <= 90, check.title
        assert check.remedy.endswith("."), check.name
    for place in {check.place for check in CHECKS}:
        page, anchor = place.split("#")
        titles = re.findall(r"^#+ (.*)$", (PAGES / page).read_text("utf-8").lower(), re.MULTILINE)
        anchors = [re.sub(r"[^a-z0-9 -]", "", title).replace(" ", "-") for title in titles]
        assert anchor in anchors, place
    page = (PAGES.parent / "how-to" / "write-an-amplifier.md").read_text("utf-8")
    (counts,) = re.findall(r"^(\d+) passed, 0 failed, (\d+) skipped", page, re.MULTILINE)
    assert sum(map(int, counts)) == len(of_kind("serial"))


RISE = LayerSet(0, 100, 0, (Command(0, 2200, 5000, 0),))
"""To half of full level along 100 ms."""

OFF = {
    "state": 1,
    "fault": 0,
    "flags": 0,
    "latch": 7,
    "temperature": 250,
    "token": 0,
    "watchdog_left": 0,
    "levels": [0] * 4,
    "tokens": [0] * 8,
    "clock": 0,
}
ARMED = {**OFF, "state": 4, "flags": 1}


def armed(watchdog: int) -> Judge:
    """Return the judge of an amplifier that is armed at 0 s with a watchdog [ms]."""
    start = Interval(0.0, 0.0)
    judge = Judge(capabilities(4), OFF, start)
    judge.granted("Arm", {"session": 1, "watchdog": watchdog, "shift": 0}, {}, start)
    return judge


@pytest.mark.parametrize("age", [70, 20, 85])
def test_fault_may_come_while_a_status_is_on_its_way(age: int) -> None:
    """It was asked for at 0.09 s and came at 0.105 s, amid which the watchdog of 0.1 s tripped."""
    judge = armed(100)
    judge.check({**ARMED, "watchdog_left": 5}, Interval(0.09, 0.105))
    judge.check({**OFF, "state": 7, "fault": 1, "latch": 8}, Interval(0.105, 0.106))
    faults = {"faults": [{"fault": 1, "channel": 255, "age": age}]}
    with nullcontext() if age == 70 else pytest.raises(ContractViolation, match="listed faults"):
        judge.granted("GetFaults", {}, faults, Interval(0.17, 0.17))


PART = {"token": 1, "now": 1, "index": 0, "parts": 1, "missing": 0, "exact": 1}


def expected_by(moment: float, level: float) -> None:
    """Compare a status that is read a time [s] after such a set was played with what is expected.

    Raises Violation.
    """
    start, when = Interval(0.0, 0.0), Interval(moment, moment)
    judge = armed(1000)
    part = {**PART, "session": 1, "stream": pack_layers([RISE])}
    judge.sets.sent(part)
    judge.granted("Set", part, {**PART, "staged": 0, "played": 1}, start)
    left = {"watchdog_left": round(1000 - 1000 * moment), "token": 1}
    played = {"levels": [round(10_000 * level), 0, 0, 0], "tokens": [1, *[0] * 7]}
    judge.check({**ARMED, **left, **played}, when)


# A raised cosine has risen by (1 - cos 45 degrees)/2 after a quarter, by half after half.
@pytest.mark.parametrize(("moment", "level"), [(0.025, 0.07322), (0.05, 0.25), (0.15, 0.5)])
def test_levels_are_those_of_the_page(moment: float, level: float) -> None:
    """By hand: a set may begin 2 ms late and no more, and a step of rounding is no violation."""
    expected_by(moment, level)
    expected_by(moment, level + 0.001)
    late = 0.25 * (1 - math.cos(math.pi * (moment - 0.0018) / 0.1)) if moment < 0.1 else level
    expected_by(moment, late)
    for wrong in (0.02, -0.03):
        with pytest.raises(ContractViolation, match="level of channel 0"):
            expected_by(moment, level + wrong)


# What goes wrong


@pytest.mark.parametrize("kind", JUDGED_LINE_KINDS)
def test_malformed_reply_fails_one_check_with_its_bytes(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tenth is cut in its middle, and its last byte is wrong; what follows passes."""
    bad: list[bytes] = []

    def alter(data: bytes) -> bytes:
        middle = len(data) // 22 * 11  # a whole frame of CAN
        bad.append(data[:middle] if kind == "can" else data[:middle] + b"\x55\0")
        return bad[0]

    count = iter(range(10_000_000))
    changed(monkeypatch, "send", lambda data: (0.0, alter(data) if next(count) == 10 else data))
    names = ["identity", "capabilities", "starts_disarmed", "replies_in_time", "stop"]
    results = judged(kind, names)
    (failed,) = (each for each in results if each.result == "failed")
    shown = b"".join(each.data for each in unpack_frames(bad[0])) if kind == "can" else bad[0]
    assert shown.hex(" ") in failed.outcome.last_bytes
    assert [each.result for each in results].count(Result.PASSED) == len(names) - 1, results


def test_failure_shows_the_set_that_was_sent() -> None:
    """The first set of the page, in words and as its words; levels are a tenth too low."""
    words = [0x2A17, 0x0102, 0x0002, 0x0004, 0x0014, 0x01F4]
    words += [0x0008, 0x0898, 0x07D0, 0x0000, 0x0018, 0x0898, 0x044C, 0xDCD8]
    words += [0x0028, 0x0898, 0x0258, 0x34BC, 0x0038, 0x0898, 0x0190, 0x0802]
    shown = set_text([words])
    assert shown.startswith("set 258, staged; layer 0, ramp 20 ms, valid for 500 ms: channel 0 ")
    assert "channel 0 110 Hz 0.2 at 0 degrees keep_phase, channel 1 110 Hz 0.11 at -90" in shown
    assert shown.endswith(
        "= 2A17 0102 0002 0004 0014 01F4 0008 0898 07D0 0000 0018 0898 044C "
        "DCD8 0028 0898 0258 34BC 0038 0898 0190 0802"
    )
    (result,) = judged("serial", ["stop"], far=_PlaysOn("loud", channels=2))
    assert result.outcome.last_set.startswith(
        "set 2, staged; layer 0, ramp 0 ms, valid for 0 ms: channel 0 "
    )


def test_one_bad_capability_is_one_failure() -> None:
    """What needs steps of envelopes is not run and says why; all else has its verdict."""
    far = varied()
    far.capabilities.update(envelope_step_min=900)
    names = ["capabilities", "replies_in_time", "stop", "watchdog", "onsets", "endings", "voices"]
    results = {each.check.name: each for each in judged("serial", names, far=far)}
    failed = [name for name, each in results.items() if each.result == "failed"]
    assert failed == ["capabilities"]
    assert "900" in results["capabilities"].outcome.expected
    not_run = {name for name, each in results.items() if each.result == "not_run"}
    assert not_run == {"onsets", "endings", "voices"}
    assert all("envelope_step_max" in results[name].reason for name in not_run)


@pytest.mark.parametrize(
    "other", [lambda clock: (clock & 0xFFFF) << 16 | clock >> 16, lambda clock: 7]
)
def test_clock_that_does_not_go_on_is_one_failure(
    other: Callable[[int], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its words exchanged, or standing still: nothing is driven then, and each check says why."""
    status = SimulatedAmplifier.status
    monkeypatch.setattr(
        SimulatedAmplifier,
        "status",
        lambda far, now: (shown := status(far, now)) | {"clock": other(shown["clock"])},
    )
    results = judged("serial")
    assert [each.check.name for each in results if each.result == "failed"] == ["clock_goes_on"]
    driven = [each for each in results if each.check.drives]
    assert {each.result for each in driven} == {Result.NOT_RUN}
    assert all("clock" in each.reason for each in driven)
