"""The report of a run of checks."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from drivers.conformance.check import CheckResult, Result


@dataclass(frozen=True)
class ConformanceReport:
    """Results of checks on the amplifier at a URL; left_out: number of checks that were not run."""

    url: str
    results: Sequence[CheckResult]
    left_out: int

    @property
    def overall(self) -> str:
        """The worst result: failed, inconclusive, incomplete or passed."""
        found = {one.result for one in self.results}
        if Result.FAILED in found:
            return "failed"
        if Result.INCONCLUSIVE in found:
            return "inconclusive"
        return "incomplete" if self.left_out else "passed"

    @property
    def summary(self) -> str:
        """Return the number of checks with each result."""
        counts = self._counts()
        parts = [f"{count} {name}" for name, count in counts.items()]
        if self.left_out:
            parts.append(f"{self.left_out} not run")
        return ", ".join(parts)

    def to_json(self) -> dict[str, Any]:
        """Make an object with stable keys."""
        return {
            "url": self.url,
            "overall": self.overall,
            **self._counts(),
            "left_out": self.left_out,
            "seconds": round(sum(one.seconds for one in self.results), 3),
            "checks": [one.to_json() for one in self.results],
        }

    def _counts(self) -> dict[str, int]:
        counts = Counter(one.result for one in self.results)
        return {result.value: counts[result] for result in Result}
