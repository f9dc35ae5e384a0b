"""Checks in turn on one amplifier, whose link may be lost on the way."""

from collections.abc import Callable, Iterable

from drivers.amplifier import Amplifier
from drivers.conformance.bench import LEVEL
from drivers.conformance.check import Check, CheckResult, Result, run_check
from drivers.conformance.raw.line import RawLine
from drivers.conformance.reopening import reopened

_MAX_LOSSES = 3


async def run_checks(
    checks: Iterable[Check],
    amplifier: Amplifier,
    raw: RawLine | None = None,
    *,
    url: str = "",
    level: float = LEVEL,
    on_result: Callable[[CheckResult], None] = lambda result: None,
) -> tuple[CheckResult, ...]:
    """Run checks on an open, disarmed amplifier; on_result is called with each result.

    A link that was lost is opened again before the next check. Once it could not be before several
    in turn, all that are left are inconclusive. raw, url, level: see `run_check`.
    """
    results: list[CheckResult] = []
    loss, losses = "", 0  # why it could not be opened; before how many checks in turn
    for check in checks:
        if losses < _MAX_LOSSES:
            loss = await reopened(amplifier)
            losses = losses + 1 if loss else 0
        if loss:
            results.append(not_started(check, raw, loss))
        else:
            results.append(await run_check(check, amplifier, raw, url=url, level=level))
        on_result(results[-1])
    return tuple(results)


def not_started(check: Check, raw: RawLine | None, loss: str) -> CheckResult:
    """Make the result of a check before which the link was lost, and why."""
    reason = f"the link was lost before it: {loss}"
    return CheckResult(
        check,
        check.place(raw),
        Result.INCONCLUSIVE,
        reason,
        seen=reason,
        expected=check.requirement,
        attempts=0,
    )
