"""The report of a run of checks."""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

from drivers.conformance import CHECKS
from drivers.conformance.check import CheckResult, Result


@dataclass(frozen=True)
class ConformanceReport:
    """Results of checks on the amplifier at a URL.

    amplifier_class: A, B or C, by the capabilities that it states. level: the highest at which
    channels were driven; 0 if none were.
    """

    url: str
    amplifier_class: str
    results: tuple[CheckResult, ...]
    level: float = 0.0

    @property
    def not_run(self) -> int:
        """Number of checks that were not run."""
        return len(CHECKS) - len(self.results)

    @property
    def problems(self) -> int:
        """Number of checks that must not count as fulfilled."""
        return sum(one.problem is not None for one in self.results)

    def followed_by(self, other: "ConformanceReport") -> "ConformanceReport":
        """Return the report of both."""
        level = max(self.level, other.level)
        return replace(self, results=(*self.results, *other.results), level=level)

    @property
    def overall(self) -> str:
        """The worst result: failed, inconclusive, incomplete or passed."""
        found = {one.result for one in self.results}
        if Result.FAILED in found:
            return "failed"
        if Result.INCONCLUSIVE in found:
            return "inconclusive"
        return "incomplete" if self.not_run else "passed"

    @property
    def summary(self) -> str:
        """Return the number of checks with each result."""
        counts = self._counts()
        parts = [f"{count} {name}" for name, count in counts.items()]
        if self.not_run:
            parts.append(f"{self.not_run} not run")
        driven = f", driven at up to {self.level:.0%} of full stroke" if self.level else ""
        return f"class {self.amplifier_class}: {', '.join(parts)}{driven}"

    def to_json(self) -> dict[str, Any]:
        """Make an object with stable keys."""
        return {
            "url": self.url,
            "overall": self.overall,
            "class": self.amplifier_class,
            "level": self.level,
            **self._counts(),
            "not_run": self.not_run,
            "seconds": round(sum(one.seconds for one in self.results), 3),
            "checks": [one.to_json() for one in self.results],
        }

    def _counts(self) -> dict[str, int]:
        counts = Counter(one.result for one in self.results)
        return {result.value: counts[result] for result in Result}
