"""Checks and their results: one attempt after the other until this machine was in time."""

from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeAlias

from drivers import clock
from drivers.conformance.client import Client
from drivers.conformance.findings import Late, Optional, Violation
from drivers.conformance.subject import MAX_ATTEMPTS, Subject
from drivers.errors import LinkError

Steps: TypeAlias = Callable[[Subject], Awaitable[None]]


class Result(StrEnum):
    """What a check found; skipped: there is nothing to check, as the contract allows."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class Check:
    """A rule of the contract: its name, what it requires, and the place that says so.

    drives: whether it arms the amplifier. kinds: of wires on which it can be tried, empty for all.
    """

    name: str
    requirement: str
    place: str
    drives: bool
    kinds: tuple[str, ...]
    run: Steps


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check; reason, seen, expected: of a violation, or why it was skipped."""

    check: Check
    number: int
    result: Result
    reason: str = ""
    seen: str = ""
    expected: str = ""
    seconds: float = 0.0
    attempts: int = 1

    def to_json(self) -> dict[str, Any]:
        """Make a row with stable keys."""
        return {
            "number": self.number,
            "name": self.check.name,
            "requirement": self.check.requirement,
            "place": self.check.place,
            "result": self.result.value,
            "reason": self.reason,
            "seen": self.seen,
            "expected": self.expected,
            "seconds": round(self.seconds, 3),
            "attempts": self.attempts,
        }


@dataclass(frozen=True, slots=True)
class Report:
    """Results of checks on one amplifier; level: the highest at which channels were driven.

    not_run: number of checks that were not tried.
    """

    url: str
    level: float
    results: tuple[CheckResult, ...]
    not_run: int

    @property
    def overall(self) -> str:
        """The worst result: failed, incomplete or passed."""
        if any(each.result is Result.FAILED for each in self.results):
            return "failed"
        return "incomplete" if self.not_run else "passed"

    @property
    def summary(self) -> str:
        """The number of checks with each result."""
        counted = [f"{count} {name}" for name, count in self._counts().items()]
        driven = f", driven at up to {self.level:.0%} of full level" if self.level else ""
        left = f", {self.not_run} not run" if self.not_run else ""
        return f"{', '.join(counted)}{left}{driven}"

    def to_json(self) -> dict[str, Any]:
        """Make an object with stable keys."""
        return {
            "url": self.url,
            "overall": self.overall,
            "level": self.level,
            **self._counts(),
            "not_run": self.not_run,
            "seconds": round(sum(each.seconds for each in self.results), 3),
            "checks": [each.to_json() for each in self.results],
        }

    def _counts(self) -> dict[str, int]:
        results = [each.result for each in self.results]
        return {result.value: results.count(result) for result in Result}


def reading(place: str, *kinds: str) -> Callable[[Steps], Check]:
    """Make a check that only reads of its steps, whose docstring begins with 'It'."""
    return lambda steps: _check(steps, place, kinds, drives=False)


def driving(place: str, *kinds: str) -> Callable[[Steps], Check]:
    """Make a check that arms the amplifier and drives its channels."""
    return lambda steps: _check(steps, place, kinds, drives=True)


def _check(steps: Steps, place: str, kinds: tuple[str, ...], *, drives: bool) -> Check:
    requirement = " ".join((steps.__doc__ or "").split("\n\n")[0].split())
    requirement = requirement.removeprefix("It ").removesuffix(".")
    return Check(getattr(steps, "__name__", ""), requirement, place, drives, kinds, steps)


async def identified(client: Client, level: float) -> Subject:
    """Identify the amplifier at the far end of a client; raises Violation."""
    identity = await client.hello()
    client.reply_words = {}
    answer = await client.exchange(2, ())
    if answer.code:
        raise Violation("GetCaps", expected="carried out", seen=answer.code)
    can = Subject.read(_UNIDENTIFIED, "GetCaps", answer).values
    return Subject(client, identity, can, level)


class _Unidentified(Subject):
    """An amplifier of which nothing is known yet."""

    def __init__(self) -> None:
        self.channels = self.layers = range(0)


_UNIDENTIFIED = _Unidentified()


async def run_checks(
    checks: Sequence[tuple[int, Check]],
    client: Client,
    *,
    level: float,
    on_result: Callable[[CheckResult], None] = lambda result: None,
) -> Iterable[CheckResult]:
    """Run checks in turn, each with its number, on one amplifier; return their results.

    Nothing is run after a check that the amplifier leaves without silence. Raises LinkError for a
    line that is lost, or where this machine is always late.
    """
    results: list[CheckResult] = []
    for number, check in checks:
        result, is_at_rest = await _run(number, check, client, level)
        results.append(result)
        on_result(result)
        if not is_at_rest:
            break
    return results


async def _run(number: int, check: Check, client: Client, level: float) -> tuple[CheckResult, bool]:
    began = clock.now()
    for attempt in range(1, MAX_ATTEMPTS + 1):
        finding, is_at_rest = await _attempt(check, client, level)
        if isinstance(finding, Late):
            continue
        took = clock.now() - began
        if finding is None:
            result = CheckResult(check, number, Result.PASSED, seconds=took, attempts=attempt)
        elif isinstance(finding, Optional):
            result = CheckResult(
                *(check, number, Result.SKIPPED, str(finding)), seconds=took, attempts=attempt
            )
        else:
            assert isinstance(finding, Violation)  # noqa: S101
            texts = str(finding), finding.seen, finding.expected
            result = CheckResult(check, number, Result.FAILED, *texts, took, attempt)
        return result, is_at_rest
    raise LinkError(
        f"check {check.name}: this machine was late {MAX_ATTEMPTS} times ({finding}); "
        "run it on one that is less busy"
    )


async def _attempt(check: Check, client: Client, level: float) -> tuple[Exception | None, bool]:
    """Run the steps once; return what they found, and whether the amplifier is at rest."""
    finding: Exception | None = None
    subject: Subject | None = None
    client.heard.clear()
    client.events.clear()
    try:
        subject = await identified(client, level)
        if check.drives:
            await subject.rest()
        await check.run(subject)
        if client.heard:
            what = "messages that were not asked for"
            raise Violation(what, expected="none", seen=client.heard[0])
    except (Violation, Optional, Late) as found:
        finding = found
    try:
        if check.drives and subject is not None:
            await subject.rest()
    except Violation as found:
        return (finding if isinstance(finding, Violation) else found), False
    return finding, subject is not None
