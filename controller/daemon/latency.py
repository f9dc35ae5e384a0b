"""Touch-to-wire latency: a histogram since the start and percentiles of the last ten thousand."""

from bisect import bisect_left

import numpy as np

from controller.api.schema import LatencySummary

BUCKETS_MS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0, 50.0, 100.0)
_WINDOW = 10_000


class LatencyStatistics:
    """Accumulates latencies [s]."""

    def __init__(self) -> None:
        self._counts = [0] * len(BUCKETS_MS)
        self._recent_ms = np.zeros(_WINDOW)
        self._count = 0

    def add(self, latency: float) -> None:
        """Add one latency [s]."""
        milliseconds = 1e3 * latency
        self._counts[min(bisect_left(BUCKETS_MS, milliseconds), len(BUCKETS_MS) - 1)] += 1
        self._recent_ms[self._count % _WINDOW] = milliseconds
        self._count += 1

    def summary(self) -> LatencySummary:
        """Return count, percentiles [ms] and histogram."""
        quantiles: list[float | None] = [None, None, None]
        if self._count:
            recent = self._recent_ms[: self._count]
            # inverted_cdf returns a value that occurred
            found = np.quantile(recent, [0.5, 0.99, 0.999], method="inverted_cdf")
            quantiles = [float(value) for value in found]
        median, p99, p999 = quantiles
        return LatencySummary(
            count=self._count,
            median=median,
            p99=p99,
            p999=p999,
            histogram=list(zip(BUCKETS_MS, self._counts, strict=True)),
        )
