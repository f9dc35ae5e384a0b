"""Attempts and results of conformance checks: delays of this program do not count."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from functools import partial

import pytest

from conformance_bench import results_on
from drivers import clock
from drivers.conformance import CHECKS, CheckResult, Result
from drivers.conformance.bench import Bench, Sample
from drivers.conformance.check import MAX_ATTEMPTS, Check
from drivers.conformance.findings import (
    Inconclusive,
    MeasuredNotApplicable,
    NotApplicable,
    expect,
)
from drivers.conformance.report import ConformanceReport
from drivers.guard.channel_state import Interval
from model.rig.rig import Rig
from virtual_loop import VirtualLoop

Steps = Callable[[Bench], Coroutine[None, None, None]]


def stall(duration: float) -> None:
    """Let this program not run for a time [s]."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.now += duration


def result_of(steps: Steps, rig: Rig) -> CheckResult:
    """The result of a check with these steps, on a sound amplifier."""
    check = Check("named", "does as told", ("wire-protocol.md#watchdog",), drives=True, run=steps)
    (result,) = results_on("serial", rig, [check])
    return result


def test_violation_fails_at_once(coarse_rig: Rig) -> None:
    """With what was seen and expected, and the place on the page."""

    async def steps(bench: Bench) -> None:
        expect(False, "level", expected="0.2", seen="0.1")

    found = result_of(steps, coarse_rig)
    assert found.result is Result.FAILED
    assert found.attempts == 1
    row = found.to_json()
    assert (row["expected"], row["seen"]) == ("0.2", "level: 0.1")
    assert row["place"] == "wire-protocol.md#watchdog"


async def disturbed_at_first(tries: list[float], bench: Bench) -> None:
    """Violate the contract amid a stall at the first of these tries."""
    tries.append(clock.now())
    if len(tries) == 1:
        stall(0.05)
        await bench.sample()
        expect(False, "level", expected="0.2", seen="0.1")


def test_violation_amid_a_stall_is_looked_at_again(coarse_rig: Rig) -> None:
    """The second attempt, undisturbed, passes."""
    tries: list[float] = []
    found = result_of(partial(disturbed_at_first, tries), coarse_rig)
    assert found.result is Result.PASSED
    assert found.attempts == 2


@pytest.mark.parametrize("is_violation", [True, False])
def test_check_that_is_always_disturbed_is_inconclusive(
    is_violation: bool, coarse_rig: Rig
) -> None:
    """After a bounded number of attempts, and never passed."""

    async def steps(bench: Bench) -> None:
        stall(0.05)
        await bench.sample()
        expect(not is_violation, "level", expected="0.2", seen="0.1")
        raise Inconclusive("nothing was seen")

    found = result_of(steps, coarse_rig)
    assert found.result is Result.INCONCLUSIVE
    assert found.attempts == MAX_ATTEMPTS
    assert found.problem


def test_check_without_object_is_skipped(coarse_rig: Rig) -> None:
    """It is no problem, and has a reason."""

    async def steps(bench: Bench) -> None:
        raise NotApplicable("it has no envelopes")

    found = result_of(steps, coarse_rig)
    assert (found.result, found.problem, found.reason) == (
        Result.SKIPPED,
        None,
        "it has no envelopes",
    )
    report = ConformanceReport("serial:///dev/null", "A", (found,)).to_json()
    assert (report["overall"], report["class"], report["level"]) == ("incomplete", "A", 0.0)
    assert (report["passed"], report["skipped"]) == (0, 1)
    assert report["not_run"] == len(CHECKS) - 1


@pytest.mark.parametrize("level", [0.2, 0.5])
def test_level_of_driven_channels_is_as_given(level: float, coarse_rig: Rig) -> None:
    """On the far end, and in the report of what was tried."""
    seen = []

    async def steps(bench: Bench) -> None:
        await bench.arm()
        await bench.play(1.0)
        seen.append((await bench.levels())[0])

    check = Check("named", "does as told", ("wire-protocol.md#watchdog",), drives=True, run=steps)
    (found,) = results_on("serial", coarse_rig, [check], level=level)
    assert (found.result, seen) == (Result.PASSED, [level])
    reading = ConformanceReport("serial:///dev/null", "A", ())
    driving = ConformanceReport("serial:///dev/null", "A", (found,), level)
    assert reading.followed_by(driving).to_json()["level"] == level


def test_skip_after_a_failure_is_no_skip(coarse_rig: Rig) -> None:
    """An attempt that failed amid a stall is not forgotten by one that found nothing to check."""
    tries: list[float] = []

    async def steps(bench: Bench) -> None:
        await disturbed_at_first(tries, bench)
        raise NotApplicable("the wire is too slow")

    found = result_of(steps, coarse_rig)
    assert found.result is Result.INCONCLUSIVE
    assert found.problem


def test_skip_as_measured_amid_stalls_is_no_skip(coarse_rig: Rig) -> None:
    """A wire that was slow while this program was late may be fast."""

    async def steps(bench: Bench) -> None:
        stall(0.05)
        await bench.sample()
        raise MeasuredNotApplicable("the wire is too slow")

    found = result_of(steps, coarse_rig)
    assert (found.result, found.attempts) == (Result.INCONCLUSIVE, MAX_ATTEMPTS)


@pytest.mark.parametrize(
    ("excess", "result", "attempts"),
    [(0.2, Result.FAILED, 1), (0.03, Result.INCONCLUSIVE, MAX_ATTEMPTS)],
)
def test_what_no_delay_explains_fails_at_once(
    excess: float, result: Result, attempts: int, coarse_rig: Rig
) -> None:
    """A watchdog that is left by more than the program was late, and one by less."""

    async def steps(bench: Bench) -> None:
        await bench.arm()
        stall(0.05)
        sample = await bench.sample()
        left = sample.status.watchdog_left + excess
        bench.expect_not_fed(Sample(sample.when, replace(sample.status, watchdog_left=left)), by="")

    found = result_of(steps, coarse_rig)
    assert (found.result, found.attempts) == (result, attempts)


@pytest.mark.parametrize(
    ("earliest", "latest", "result"),
    [
        (0.100, 0.104, Result.PASSED),
        (0.090, 0.097, Result.FAILED),  # certainly before 100 ms
        (0.109, 0.112, Result.FAILED),  # certainly after 105 ms
        (0.060, 0.103, Result.INCONCLUSIVE),  # perhaps long before
        (0.101, 0.150, Result.INCONCLUSIVE),
        (0.105, 0.1105, Result.INCONCLUSIVE),  # perhaps 10 ms late
    ],
)
def test_times_are_judged_by_what_is_certain(
    earliest: float, latest: float, result: Result, coarse_rig: Rig
) -> None:
    """An event between two looks is early or late only if it is for certain."""

    async def steps(bench: Bench) -> None:
        bench.expect_time("trip", Interval(earliest, latest), low=0.1, high=0.105)

    assert result_of(steps, coarse_rig).result is result
