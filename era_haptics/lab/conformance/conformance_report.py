"""Results of checks and the report of a run."""

import textwrap
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.outcomes import CheckOutcome, TooLate
from era_haptics.lab.conformance.shared_values import SHARED_VALUES

_WIDTH = 91  # characters of a line of a remedy


class Result(StrEnum):
    """Result of a check.

    skipped: the check needs an optional feature that the amplifier lacks, or there is no verdict.
    not_run: an earlier failure prevents the check.
    """

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    NOT_RUN = "not_run"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check, with the reason unless it passed."""

    check: ConformanceCheck
    number: int
    result: Result
    reason: str = ""
    outcome: CheckOutcome = field(default_factory=CheckOutcome)
    seconds: float = 0.0
    attempts: int = 1

    @property
    def has_no_verdict(self) -> bool:
        """Whether this machine was too late for a verdict."""
        return isinstance(self.outcome, TooLate)

    @property
    def advice(self) -> tuple[str, str]:
        """Page and heading of the violated rule, and the remedy.

        They belong to the check, unless a value failed that is the subject of other checks.
        """
        anchor = self.check.place.partition("#")[2]
        for value in SHARED_VALUES:
            if value.is_in(self.reason) and anchor not in value.anchors:
                return value.place, value.remedy
        return self.check.place, self.check.remedy

    @property
    def details(self) -> list[str]:
        """Lines that explain the result."""
        lines = []
        if self.reason:
            lines.append(self.reason)
        if self.result is Result.FAILED:
            place, remedy = self.advice
            lines.append(f"rule: docs/reference/{place} (check {self.check.name})")
            lines += textwrap.wrap(f"remedy: {remedy}", _WIDTH)
        if self.outcome.last_set:
            lines.append(f"last set sent: {self.outcome.last_set}")
        if self.outcome.last_bytes:
            lines.append(f"last bytes received: {self.outcome.last_bytes}")
        return lines

    def to_json(self) -> dict[str, Any]:
        """Return a row with stable keys."""
        is_failed = self.result is Result.FAILED
        return {
            "number": self.number,
            "name": self.check.name,
            "requirement": self.check.title,
            "place": self.check.place,
            "result": self.result.value,
            "reason": self.reason,
            "seen": self.outcome.actual,
            "expected": self.outcome.expected,
            "seconds": round(self.seconds, 3),
            "attempts": self.attempts,
            "sent": self.outcome.last_set,
            "came": self.outcome.last_bytes,
            "remedy": self.advice[1] if is_failed else "",
        }


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of an amplifier's checks.

    level: highest level at which channels may be driven. remaining: number of checks left out.
    """

    url: str
    level: float
    results: tuple[CheckResult, ...]
    remaining: int

    @property
    def driven(self) -> float:
        """Highest level at which channels were driven, 0 if none were."""
        for result in self.results:
            if result.check.drives and result.result is not Result.NOT_RUN:
                return self.level
        return 0.0

    @property
    def not_run(self) -> int:
        """Number of checks that were not run."""
        return self.remaining + self._counts()["not_run"]

    @property
    def overall(self) -> str:
        """Overall result: failed, incomplete or passed."""
        if self._counts()["failed"]:
            return "failed"
        is_incomplete = self.not_run or self._without_verdict()
        return "incomplete" if is_incomplete else "passed"

    @property
    def summary(self) -> str:
        """Number of checks with each result, as a sentence."""
        counts = self._counts()
        text = "{passed} passed, {failed} failed, {skipped} skipped".format(**counts)
        without_verdict = self._without_verdict()
        if without_verdict:
            text += f" ({without_verdict} without a verdict; run again)"
        if self.not_run:
            text += f", {self.not_run} not run"
        if self.driven:
            text += f", driven at up to {self.driven:.0%} of full level"
        return text

    @property
    def fix_first(self) -> list[str]:
        """Values that made several checks fail, the most frequent first, with rule and remedy."""
        reasons = [result.reason for result in self.results if result.result is Result.FAILED]
        counts = {value: sum(map(value.is_in, reasons)) for value in SHARED_VALUES}
        shared = [value for value in SHARED_VALUES if counts[value] > 1]
        shared.sort(key=lambda value: counts[value], reverse=True)
        return [f"{value.name} in {counts[value]} checks ({value.place})" for value in shared]

    def to_json(self) -> dict[str, Any]:
        """Return an object with stable keys."""
        return {
            "url": self.url,
            "overall": self.overall,
            "level": self.driven,
            **self._counts(),
            "not_run": self.not_run,
            "seconds": round(sum(result.seconds for result in self.results), 3),
            "checks": [result.to_json() for result in self.results],
        }

    def _counts(self) -> dict[str, int]:
        results = [result.result for result in self.results]
        return {result.value: results.count(result) for result in Result}

    def _without_verdict(self) -> int:
        return sum(result.has_no_verdict for result in self.results)
