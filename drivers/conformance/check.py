"""Checks, their execution until this machine was in time, and the report of a run."""

from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from inspect import isawaitable
from typing import Any, TypeAlias

from drivers import clock
from drivers.conformance.client import Client, Late, Optional, Violation, read_as
from drivers.conformance.material import FULL, Rows
from drivers.conformance.subject import MAX_ATTEMPTS, Subject
from drivers.errors import CommandError
from drivers.protocol.table import MESSAGES

Steps: TypeAlias = Callable[[Subject], Awaitable[None] | Rows]
"""What a check does, or the rows that are carried out."""


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


class Result(StrEnum):
    """What a check found; skipped: there is nothing to check, as the contract allows."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check; reason, seen, expected: of a violation, or why it was skipped.

    has_verdict: unless this machine or the line was always too slow for it.
    """

    check: Check
    number: int
    result: Result
    reason: str = ""
    seen: str = ""
    expected: str = ""
    seconds: float = 0.0
    attempts: int = 1
    has_verdict: bool = True

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
        is_incomplete = self.not_run or not all(each.has_verdict for each in self.results)
        return "incomplete" if is_incomplete else "passed"

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


def reading(place: str, *kinds: str, drives: bool = False) -> Callable[[Steps], Check]:
    """Make a check that only reads of its steps, whose docstring begins with 'It'."""

    def make(steps: Steps) -> Check:
        text = " ".join((steps.__doc__ or "").split())
        requirement = text.removeprefix("It ").removesuffix(".")
        return Check(getattr(steps, "__name__", ""), requirement, place, drives, kinds, steps)

    return make


def driving(place: str, *kinds: str) -> Callable[[Steps], Check]:
    """Make a check that arms the amplifier and drives its channels."""
    return reading(place, *kinds, drives=True)


async def identified(client: Client, level: float) -> Subject:
    """Identify the amplifier at the far end of a client; raises Violation."""
    identity = await client.hello()
    client.reply_words = {}
    message = MESSAGES["GetCaps"]
    answer = await client.exchange(message.number, ())
    if answer.code:
        raise Violation("GetCaps", expected="carried out", seen=answer.code)
    can = read_as("reply to GetCaps", message.reply.unpack, answer.words, is_strict=False)
    return Subject(client, identity, can, level)


async def run_checks(
    checks: Sequence[tuple[int, Check]],
    client: Client,
    *,
    level: float,
    on_result: Callable[[CheckResult], None] = lambda result: None,
) -> Iterable[CheckResult]:
    """Run checks in turn, each with its number, on one amplifier; return their results.

    Nothing is run after a check that the amplifier leaves without silence. One for which this
    machine or the line is always too slow has no verdict. Raises LinkError for a line that is lost,
    CommandError for a level below a step.
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
    began, attempts = clock.now(), 0
    finding: Exception | None = Late("it was not tried")
    while isinstance(finding, Late) and attempts < MAX_ATTEMPTS:
        attempts += 1
        finding, is_at_rest = await _attempt(check, client, level)
    is_late, reason = isinstance(finding, Late), "" if finding is None else str(finding)
    if is_late:
        reason = f"no verdict: this machine or the line was too slow {attempts} times ({finding})"
    result = Result.SKIPPED if is_late or isinstance(finding, Optional) else Result.FAILED
    return CheckResult(
        check=check,
        number=number,
        result=Result.PASSED if finding is None else result,
        reason=reason,
        seen=getattr(finding, "seen", ""),
        expected=getattr(finding, "expected", ""),
        seconds=clock.now() - began,
        attempts=attempts,
        has_verdict=not is_late,
    ), is_at_rest


async def _attempt(check: Check, client: Client, level: float) -> tuple[Exception | None, bool]:
    """Run the steps once; return what they found, and whether the amplifier is at rest."""
    finding: Exception | None = None
    subject: Subject | None = None
    client.heard.clear()
    client.events.clear()
    try:
        subject = await identified(client, level)
        if check.drives:
            step = subject.can["level_step"] / FULL
            if subject.level < step:
                raise CommandError(f"level must be at least {step:g}, its step, got {level:g}")
            await subject.rest()
        else:
            await subject.watch()
        rows = check.run(subject)
        await (rows if isawaitable(rows) else subject.run(rows))
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
