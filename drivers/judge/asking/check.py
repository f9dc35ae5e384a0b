"""Checks, their execution until this machine was in time, and the report of a run."""

from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from inspect import isawaitable
from typing import Any, TypeAlias

from drivers.errors import CommandError
from drivers.judge.asking.client import (
    Armed,
    Client,
    Late,
    Optional,
    Unusable,
    Violation,
    expect,
    read_as,
)
from drivers.judge.asking.material import FULL, Rows
from drivers.judge.asking.sent import in_words
from drivers.judge.asking.stated import STATED, Capabilities
from drivers.judge.asking.subject import Subject
from drivers.protocol.table import MESSAGES, VERSION
from registry import clock

_MAX_TIME = 180.0  # s; after which a run begins no other check
_RETRIED = 2.0  # s; in which silence is tried again, or identification

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
    """What a check found; skipped: there is nothing to check, as the contract allows.

    Not run: what failed before leaves it nothing to try.
    """

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    NOT_RUN = "not_run"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check; reason, seen, expected: of a violation, or why it was skipped.

    sent: the last set before a violation, in words and hexadecimal; came: the last bytes.
    has_verdict: unless this machine or the line was always too slow for it. is_armed: the
    amplifier is armed, so that nothing may be driven.
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
    sent: str = ""
    came: str = ""
    is_armed: bool = False

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
            "sent": self.sent,
            "came": self.came,
        }


@dataclass(frozen=True, slots=True)
class Report:
    """Results of checks on one amplifier; level: the highest at which channels were driven.

    left: number of checks that were not chosen.
    """

    url: str
    level: float
    results: tuple[CheckResult, ...]
    left: int

    @property
    def not_run(self) -> int:
        """The number of checks that were not tried."""
        return self.left + self._counts()["not_run"]

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
        counted = [f"{count} {name}" for name, count in [*self._counts().items()][:-1]]
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
    versions, client.reply_words = identity["versions"], {}
    expect(bool(versions >> VERSION & 1), "versions", expected="bit 3 set", seen=versions)
    answer = await client.exchange(MESSAGES["GetCaps"].number, ())
    expect(not answer.code, "GetCaps", expected="carried out", seen=answer.code)
    can = read_as("reply to GetCaps", STATED.unpack, answer.words, is_strict=False)
    return Subject(client, identity, Capabilities(can), level)


async def run_checks(
    checks: Sequence[tuple[int, Check]],
    client: Client,
    *,
    level: float,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    before: Sequence[CheckResult] = (),
) -> Iterable[CheckResult]:
    """Run checks in turn, each with its number, on one amplifier; return their results.

    before: results of checks that were run already. Nothing is run, and each says so, once the
    amplifier cannot be identified or silenced; nothing is driven without what is required. One for
    which this machine or the line is always too slow has no verdict. Raises LinkError for a line
    that is lost, CommandError for a level below a step.
    """
    results: list[CheckResult] = []
    began = clock.now()
    why_none = next((each.reason for each in before if each.result is Result.NOT_RUN), "")
    for number, check in checks:
        if (took := clock.now() - began) > _MAX_TIME:
            why_none = why_none or f"not run: the checks before took {took:.0f} s"
        is_barred = check.drives and any(each.is_armed for each in (*before, *results))
        if why := "not run: it is armed, perhaps by another host" if is_barred else why_none:
            result = CheckResult(check, number, Result.NOT_RUN, why)
        else:
            result, why_none = await _run(number, check, client, level)
        results.append(result)
        on_result(result)
    return results


async def _run(number: int, check: Check, client: Client, level: float) -> tuple[CheckResult, str]:
    began, is_again, why = clock.now(), True, ""
    finding: Exception | None = None
    with client.watching():
        while is_again:
            since = clock.now()
            finding, why = await _attempt(check, client, level)
            is_late = isinstance(finding, Late)
            is_again = is_late and not why and client.was_late(since)
    reason = "" if finding is None else str(finding)
    kinds = {Optional: Result.SKIPPED, Late: Result.SKIPPED, Unusable: Result.NOT_RUN}
    if is_late:
        late = f"this machine was late by {1e3 * client.lag:.0f} ms"
        reason = (
            f"no verdict in {client.attempts or 1} attempts: {reason}; {client.slow_reply or late}"
        )
    if isinstance(finding, Unusable):
        reason = f"not run: {reason}"
    result = CheckResult(
        check=check,
        number=number,
        result=kinds.get(type(finding), Result.FAILED) if finding else Result.PASSED,
        reason=reason,
        seen=getattr(finding, "seen", ""),
        expected=getattr(finding, "expected", ""),
        seconds=clock.now() - began,
        attempts=client.attempts + (not is_late),
        has_verdict=not is_late,
        sent=getattr(finding, "sent", ""),
        came=getattr(finding, "came", ""),
        is_armed=isinstance(finding, Armed),
    )
    return result, why and f"not run: after {check.name} {why}"


async def _attempt(check: Check, client: Client, level: float) -> tuple[Exception | None, str]:
    """Run the steps once; return what they found, and why nothing more can be run, or ""."""
    finding: Exception | None = None
    subject: Subject | None = None
    client.heard.clear()
    client.events.clear()
    try:
        subject = await identified(client, level)
        if check.drives:
            step = subject.can["level_step"] / FULL
            if level < step:
                raise CommandError(f"level must be at least {step:g}, its step, got {level:g}")
            await subject.rest()
        else:
            await subject.watch()
        rows = check.run(subject)
        await (rows if isawaitable(rows) else subject.run(rows))
        expect(
            not client.heard,
            "messages that were not asked for",
            expected="none",
            seen=client.heard[:1],
        )
    except (Violation, Optional, Late, Unusable) as found:
        finding = found
    if isinstance(finding, Violation):
        finding.came = client.came.hex(" ")
        finding.sent = in_words(subject.sent_set) if subject else ""
    left = await _left(check, client, subject, level)
    finding = left if left and not isinstance(finding, Violation) else finding
    return finding, str(left or "")


async def _left(
    check: Check, client: Client, subject: Subject | None, level: float
) -> Violation | None:
    """Leave it silent, or identified where it was not; returns why it is not, after a few tries."""
    due = clock.now() + _RETRIED
    while subject is None or check.drives:
        try:
            with suppress(Unusable):  # it is silent, but cannot be judged
                await (subject.rest() if subject else identified(client, level))
            break
        except Violation as found:
            if clock.now() > due:
                return found
    return None
