"""One check of the contract, its attempts, and its result."""

from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeAlias

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.conformance.bench import LEVEL, Bench
from drivers.conformance.findings import (
    ContractViolation,
    Inconclusive,
    LinkGone,
    MeasuredNotApplicable,
    NotApplicable,
)
from drivers.conformance.lateness import STALL, Lateness
from drivers.conformance.raw.line import RawLine
from drivers.conformance.reopening import reopened
from drivers.errors import DriverError, LinkError

MAX_ATTEMPTS = 10
"""Attempts of a check of which this host, or the wire, disturbed all before."""

_FINDINGS = (ContractViolation, Inconclusive, NotApplicable, DriverError)

Steps: TypeAlias = Callable[[Bench], Coroutine[Any, Any, None]]


class Result(Enum):
    """Result of a check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class Check:
    """A requirement: its name, what it requires, and where; drives: whether outputs are driven.

    places: page and heading, as wire-protocol.md#watchdog, of each page that says so.
    """

    name: str
    requirement: str
    places: tuple[str, ...]
    drives: bool
    run: Steps

    def place(self, raw: RawLine | None) -> str:
        """Return the place on the page of this wire, or the first."""
        pages = [place for place in self.places if raw and place.startswith(raw.page)]
        return (*pages, *self.places)[0]


@dataclass(frozen=True)
class CheckResult:
    """Result of a check, with its reason unless it passed.

    place: of the requirement; seen, expected: of a violation; seconds: of all attempts; attempts:
    their number.
    """

    check: Check
    place: str
    result: Result
    reason: str = ""
    seen: str = ""
    expected: str = ""
    seconds: float = 0.0
    attempts: int = 1

    @property
    def problem(self) -> str | None:
        """Why it must not count as fulfilled; None if it passed, or has nothing to check."""
        return self.reason if self.result in (Result.FAILED, Result.INCONCLUSIVE) else None

    def to_json(self) -> dict[str, Any]:
        """Make a row with stable keys."""
        return {
            "name": self.check.name,
            "requirement": self.check.requirement,
            "place": self.place,
            "result": self.result.value,
            "reason": self.reason,
            "seen": self.seen,
            "expected": self.expected,
            "seconds": round(self.seconds, 3),
            "attempts": self.attempts,
        }


@dataclass(frozen=True)
class _Attempt:
    """What one attempt found; lateness, delay [s]: of this program and of replies, at most.

    missed: number of replies that did not come.
    """

    finding: Exception | None
    lateness: float
    delay: float
    missed: int

    @property
    def is_doubtful(self) -> bool:
        """Whether it must be made again."""
        if self.finding is None:
            return False
        if isinstance(self.finding, MeasuredNotApplicable):
            return self._is_disturbed
        if isinstance(self.finding, NotApplicable):
            return False
        if isinstance(self.finding, ContractViolation):
            return self._is_disturbed and not self.finding.is_certain
        return isinstance(self.finding, Inconclusive) or self._is_disturbed

    @property
    def reason(self) -> str:
        """Why it did not pass, with what disturbed it."""
        if not self.is_doubtful or not self._is_disturbed:
            return str(self.finding or "")
        disturbed = [
            f"this program was {self.lateness * 1e3:.0f} ms late" if self.lateness > STALL else "",
            f"a reply was {self.delay * 1e3:.0f} ms late" if self.delay > STALL else "",
            f"{self.missed} replies did not come" if self.missed else "",
        ]
        return f"{self.finding} ({', '.join(one for one in disturbed if one)})"

    @property
    def _is_disturbed(self) -> bool:
        return max(self.lateness, self.delay) > STALL or self.missed > 0


def reading(*places: str) -> Callable[[Steps], Check]:
    """Make a check that only reads of its steps, whose docstring begins with 'It'."""
    return lambda steps: _check(steps, places, drives=False)


def driving(*places: str) -> Callable[[Steps], Check]:
    """Make a check that arms the amplifier and drives its outputs."""
    return lambda steps: _check(steps, places, drives=True)


def _check(steps: Steps, places: tuple[str, ...], *, drives: bool) -> Check:
    requirement = (steps.__doc__ or "").partition("\n")[0].removeprefix("It ").removesuffix(".")
    return Check(steps.__name__, requirement, places, drives, steps)


async def run_check(
    check: Check,
    amplifier: Amplifier,
    raw: RawLine | None = None,
    *,
    url: str = "",
    level: float = LEVEL,
) -> CheckResult:
    """Run a check on an open, disarmed amplifier, and leave it disarmed.

    A violation while this program or the wire was delayed does not count, nor does too little
    evidence: the check is repeated, and inconclusive if that does not end. It has failed if every
    attempt failed and this program was not late in one, or at once if no delay can explain it. It
    is skipped only if no attempt failed. raw: access to the line, url: of the amplifier; checks
    that need them are skipped without. level: of driven channels, at most.
    """
    start, place = clock.now(), check.place(raw)
    attempts: list[_Attempt] = []
    while len(attempts) < MAX_ATTEMPTS:
        attempt = await _attempt(check, Bench(amplifier, raw, url=url, level=level))
        attempts.append(attempt)
        if not attempt.is_doubtful or isinstance(attempt.finding, LinkGone):
            break
    finding, reason, took = attempt.finding, attempt.reason, clock.now() - start
    if finding is None:
        result = Result.PASSED
    elif isinstance(finding, NotApplicable):
        is_skipped = not attempt.is_doubtful and not any(map(_has_failed, attempts))
        result = Result.SKIPPED if is_skipped else Result.INCONCLUSIVE
    elif attempt.is_doubtful and not _all_failed(attempts):
        result = Result.INCONCLUSIVE
    else:
        result = Result.FAILED
    violation = finding if isinstance(finding, ContractViolation) else None
    return CheckResult(
        check,
        place,
        result,
        reason,
        seen=violation.seen if violation else reason,
        expected=violation.expected if violation else check.requirement,
        seconds=took,
        attempts=len(attempts),
    )


def _all_failed(attempts: Sequence[_Attempt]) -> bool:
    """Whether every attempt failed, and several not for want of a reply, one without a delay."""
    failed = [one for one in attempts if _has_failed(one) and not _is_mute(one)]
    is_unclear = any(isinstance(one.finding, Inconclusive | NotApplicable) for one in attempts)
    return not is_unclear and len(failed) > 1 and any(one.lateness <= STALL for one in failed)


def _has_failed(attempt: _Attempt) -> bool:
    return not isinstance(attempt.finding, type(None) | Inconclusive | NotApplicable)


def _is_mute(attempt: _Attempt) -> bool:
    return isinstance(attempt.finding, LinkError)


async def _attempt(check: Check, bench: Bench) -> _Attempt:
    """Run the steps once."""
    with Lateness() as lateness:
        bench.delayed_since = lateness.since
        finding = await _finding(check, bench)
    return _Attempt(finding, lateness.worst, bench.max_delay, bench.missed_replies)


async def _finding(check: Check, bench: Bench) -> Exception | None:
    """Return what the steps found, None if all is as required."""
    finding: Exception | None = None
    if loss := await reopened(bench.amplifier):
        return LinkGone(f"the link was lost: {loss}")
    try:
        await bench.prepare(drives=check.drives)
        await check.run(bench)
    except _FINDINGS as found:
        finding = found
    if check.drives:
        try:
            await bench.rest()
        except _FINDINGS as found:
            finding = finding or found
    return finding
