"""What conformance expects of statuses, its reports, and the texts of its checks."""

import math
import re
from contextlib import nullcontext
from pathlib import Path

import pytest

import era_haptics
from drivers.protocol.sets import Command, LayerSet, pack_layers
from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.checks import state_checks
from era_haptics.lab.conformance.conformance_report import CheckResult, ConformanceReport, Result
from era_haptics.lab.conformance.contract import CHECKS
from era_haptics.lab.conformance.judge import Judge
from era_haptics.lab.conformance.outcomes import ContractViolation
from era_haptics.lab.expectations.tolerances import Interval
from sim.amplifier.readings import capabilities

DOCS = Path(era_haptics.__file__).parents[1] / "docs"

# Expected statuses

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
def test_fault_may_occur_while_a_status_is_on_its_way(age: int) -> None:
    """It was requested at 0.09 s and came at 0.105 s; the watchdog of 0.1 s tripped in between."""
    judge = armed(100)
    judge.check({**ARMED, "watchdog_left": 5}, Interval(0.09, 0.105))
    judge.check({**OFF, "state": 7, "fault": 1, "latch": 8}, Interval(0.105, 0.106))
    faults = {"faults": [{"fault": 1, "channel": 255, "age": age}]}

    with nullcontext() if age == 70 else pytest.raises(ContractViolation, match="listed faults"):
        judge.granted("GetFaults", {}, faults, Interval(0.17, 0.17))


RISE = LayerSet(0, 100, 0, (Command(0, 2200, 5000, 0),))
"""To half of full level along 100 ms."""
PART = {"token": 1, "now": 1, "index": 0, "parts": 1, "missing": 0, "exact": 1}


def check_level(moment: float, level: float) -> None:
    """Check a status with a level a time [s] after RISE was played.

    Raises ContractViolation.
    """
    judge = armed(1000)
    part = {**PART, "session": 1, "stream": pack_layers([RISE])}
    judge.sets.sent(part)
    judge.granted("Set", part, {**PART, "staged": 0, "played": 1}, Interval(0.0, 0.0))
    status = {
        **ARMED,
        "watchdog_left": round(1000 - 1000 * moment),
        "token": 1,
        "levels": [round(10_000 * level), 0, 0, 0],
        "tokens": [1, *[0] * 7],
    }
    judge.check(status, Interval(moment, moment))


# A raised cosine has risen by (1 - cos 45 degrees)/2 after a quarter, by half after half.
@pytest.mark.parametrize(("moment", "level"), [(0.025, 0.07322), (0.05, 0.25), (0.15, 0.5)])
def test_levels_along_a_ramp_are_those_of_the_page(moment: float, level: float) -> None:
    """By hand: a set may begin 2 ms late and no more, and a step of rounding is no violation."""
    late = level
    if moment < 0.1:
        late = 0.25 * (1 - math.cos(math.pi * (moment - 0.0018) / 0.1))

    for valid in (level, level + 0.001, late):
        check_level(moment, valid)

    for wrong in (level + 0.02, level - 0.03):
        with pytest.raises(ContractViolation, match="level of channel 0"):
            check_level(moment, wrong)


# Reports


def failed_with(check: ConformanceCheck, reason: str) -> CheckResult:
    """Return a check that failed for a reason."""
    return CheckResult(check, 1, Result.FAILED, reason)


PASSED = CheckResult(state_checks.stop, 2, Result.PASSED)


@pytest.mark.parametrize(
    ("results", "not_seen", "overall"),
    [
        ((failed_with(CHECKS[0], "latch"), PASSED), 0, "failed"),
        ((PASSED,), 1, "incomplete"),
        ((PASSED,), 0, "passed"),
    ],
    ids=["failed", "incomplete", "passed"],
)
def test_report_has_the_worst_verdict(
    results: tuple[CheckResult, ...], not_seen: int, overall: str
) -> None:
    """A failed check makes the report fail."""
    report = ConformanceReport("x", 0.2, results, not_seen)

    assert report.overall == overall
    assert report.to_json()["passed"] == 1
    assert "driven at up to 20%" in report.summary


def test_report_names_first_a_value_that_several_checks_found_wrong() -> None:
    """A latch that two checks report, with its rule; not a token of a single check."""
    first, second, third, *_ = CHECKS
    results = (
        failed_with(first, "latch after Stop must be 2, got 0"),
        failed_with(second, "latch after Clear must be 3, got 1"),
        failed_with(third, "token after Arm must be 0, got 1"),
    )

    report = ConformanceReport("x", 0.2, results, 0)

    assert report.fix_first == ["latch in 2 checks (protocol.md#states)"]


def test_failure_has_the_remedy_of_the_violated_rule() -> None:
    """That of the check, but that of the watchdog if a check of Stop found it wrong."""
    stop = failed_with(state_checks.stop, "latch after Stop must be 2, got 0")
    watchdog = failed_with(state_checks.stop, "watchdog_left after Arm must be 0.5, got 0.6")

    assert stop.advice == (state_checks.stop.place, state_checks.stop.remedy)
    place, remedy = watchdog.advice
    assert place == "protocol.md#sessions-and-the-watchdog"
    assert remedy != state_checks.stop.remedy
    assert watchdog.to_json()["remedy"] == remedy


# Checks


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_check_has_a_title_a_remedy_and_a_rule(check: ConformanceCheck) -> None:
    """The title is a stimulus, a colon and a reaction; the rule is a heading of a page."""
    page, anchor = check.place.split("#")
    text = (DOCS / "reference" / page).read_text("utf-8").lower()
    anchors = []
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        letters = re.sub(r"[^a-z0-9 -]", "", heading)
        anchors.append(letters.replace(" ", "-"))

    assert re.fullmatch(r"[^:]+: [^.]+", check.title)
    assert len(check.title) <= 90
    assert check.remedy.endswith(".")
    assert anchor in anchors
