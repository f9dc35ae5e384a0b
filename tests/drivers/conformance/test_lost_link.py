"""A link that is lost while conformance runs, on every wire: results, never an exception."""

import asyncio
import json
from collections.abc import Callable

import pytest

from conformance_bench import ALL
from drivers import clock
from drivers.amp_actions import conform
from drivers.conformance import CHECKS, CheckResult, Result
from drivers.conformance.bench import Bench
from drivers.conformance.check import Check
from drivers.conformance.findings import Inconclusive
from drivers.conformance.report import ConformanceReport
from drivers.errors import LinkError
from memory_machine import live_in_memory
from model.rig.rig import Rig
from sim.faults.fault_window import FaultWindow
from virtual_loop import run_virtual
from wires import WIRES, FarSide, far_side, patient

RAW = ("invalid_frames", "invalid_frames_do_not_feed", "tolerated_frames", "broadcasts", "events")
_NOTICED = 0.1  # s; until an idle line is lost


def report_of(
    wire: str, rig: Rig, checks: Callable[[FarSide], tuple[Check, ...]], *, again: bool = False
) -> ConformanceReport:
    """The report of checks on an amplifier that they may unplug; again: continued afterwards."""
    shown: list[CheckResult] = []

    async def run() -> ConformanceReport:
        live_in_memory()
        async with far_side(WIRES[wire], rig) as far:
            url = patient(far.url)
            report = await conform(url, checks(far), shown.append)
            return await conform(url, CHECKS, shown.append, before=report) if again else report

    report = run_virtual(run())
    assert tuple(shown) == report.results
    return report


def unplugging(far: FarSide, *, lasts: float = 1e9, after: float = 0.0) -> Check:
    """A check that passes, and unplugs the wire for a time [s], at once or later."""

    async def unplugged(bench: Bench) -> None:
        now = clock.now() - far.device.faults.begin
        far.device.inject_fault(FaultWindow("unplug", at=now + after, lasts=lasts))
        if not after:
            await asyncio.sleep(_NOTICED)

    return Check("unplugged", "is unplugged", ("wire-protocol.md#hello",), False, unplugged)


def named(*names: str) -> tuple[Check, ...]:
    """Checks by their names."""
    return tuple(check for check in CHECKS if check.name in names)


@pytest.mark.parametrize("wire", ALL)
def test_checks_after_a_loss_are_inconclusive(wire: str, coarse_rig: Rig) -> None:
    """With the reason; the report is complete, and its problems make the exit status 1."""
    report = report_of(wire, coarse_rig, lambda far: (unplugging(far), *CHECKS))
    results = [one.result for one in report.results]
    assert results == [Result.PASSED] + [Result.INCONCLUSIVE] * len(CHECKS)
    assert all("the link was lost before it" in one.reason for one in report.results[1:])
    assert report.problems == len(CHECKS)
    row = json.loads(json.dumps(report.to_json()))
    assert (row["overall"], row["inconclusive"]) == ("inconclusive", len(CHECKS))
    assert {len(one) for one in row["checks"]} == {9}


@pytest.mark.parametrize("wire", ALL)
def test_checks_after_a_short_loss_are_run(wire: str, coarse_rig: Rig) -> None:
    """The link is opened again before the next one."""
    report = report_of(
        wire, coarse_rig, lambda far: (unplugging(far, lasts=0.5), *named("identity", "disarm"))
    )
    assert [one.result for one in report.results] == [Result.PASSED] * 3


@pytest.mark.parametrize("wire", ALL)
def test_checks_after_a_longer_loss_are_run_once_it_is_back(wire: str, coarse_rig: Rig) -> None:
    """One that finds no link is inconclusive; the next finds it again."""
    report = report_of(
        wire, coarse_rig, lambda far: (unplugging(far, lasts=3.0), *named("identity", "disarm"))
    )
    assert [one.result for one in report.results] == [
        Result.PASSED,
        Result.INCONCLUSIVE,
        Result.PASSED,
    ]


@pytest.mark.parametrize(("lasts", "result"), [(1.0, Result.PASSED), (1e9, Result.INCONCLUSIVE)])
@pytest.mark.parametrize("wire", ALL)
def test_check_is_repeated_once_the_link_is_back(
    wire: str, lasts: float, result: Result, coarse_rig: Rig
) -> None:
    """A port that cannot be opened at once, as while its old one closes, is no failure."""
    tries = []

    def flaky(far: FarSide) -> tuple[Check, ...]:
        async def steps(bench: Bench) -> None:
            tries.append(clock.now())
            if len(tries) == 1:
                await unplugging(far, lasts=lasts).run(bench)
                raise Inconclusive("nothing was seen")

        return (Check("flaky", "is repeated", ("wire-protocol.md#hello",), False, steps),)

    (found,) = report_of(wire, coarse_rig, flaky).results
    assert (found.result, found.attempts) == (result, 2)
    assert len(tries) == (2 if result is Result.PASSED else 1)


@pytest.mark.parametrize("after", [0.03, 0.31, 0.72])
@pytest.mark.parametrize("wire", ALL)
def test_loss_amid_raw_frames_is_a_result(wire: str, after: float, coarse_rig: Rig) -> None:
    """The check amid which the line went has a result as well, and it is not passed."""
    report = report_of(
        wire, coarse_rig, lambda far: (unplugging(far, after=after), *named(*RAW), *named("events"))
    )
    assert len(report.results) == len(RAW) + 2
    assert report.results[-1].result in (Result.FAILED, Result.INCONCLUSIVE)


@pytest.mark.parametrize("wire", ALL)
def test_later_part_of_a_report_survives_a_loss(wire: str, coarse_rig: Rig) -> None:
    """As of an amplifier that vanishes while the user is asked whether outputs may be driven."""
    report = report_of(wire, coarse_rig, lambda far: (unplugging(far),), again=True)
    assert len(report.results) == 1 + len(CHECKS)
    assert report.amplifier_class == "A"
    assert report.overall == "inconclusive"


def test_amplifier_that_never_replied_has_no_report(coarse_rig: Rig) -> None:
    """Nothing is known of it: a LinkError, exit status 3."""

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES["serial"], coarse_rig) as far:
            far.device.inject_fault(FaultWindow("unplug"))
            await conform(far.url, CHECKS, lambda result: None)

    with pytest.raises(LinkError):
        run_virtual(run())
