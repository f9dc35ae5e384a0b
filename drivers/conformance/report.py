"""Checks, their results, and the report that a run makes of them."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeAlias

from drivers.conformance.material import Rows
from drivers.conformance.subject import Subject

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
