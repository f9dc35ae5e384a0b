"""How long touches take to the wire: a histogram of all, percentiles of the last ten thousand."""

from bisect import bisect_left

import numpy as np

from controller.api.schema import LatencySummary

EDGES_MS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0, 50.0, 100.0)
_WINDOW = 10_000


class Latencies:
    """Counts latencies [s]."""

    def __init__(self) -> None:
        self._counts = [0] * len(EDGES_MS)
        self._last = np.zeros(_WINDOW)
        self._count = 0

    def note(self, latency: float) -> None:
        """Count one [s]."""
        milliseconds = 1e3 * latency
        self._counts[min(bisect_left(EDGES_MS, milliseconds), len(EDGES_MS) - 1)] += 1
        self._last[self._count % _WINDOW] = milliseconds
        self._count += 1

    def summary(self) -> LatencySummary:
        """What was counted."""
        seen = self._last[: self._count]
        quantiles: list[float | None] = [None, None, None]
        if self._count:
            # The least value that the share does not exceed: one that really was.
            found = np.quantile(seen, [0.5, 0.99, 0.999], method="inverted_cdf")
            quantiles = [float(value) for value in found]
        median, p99, p999 = quantiles
        return LatencySummary(
            count=self._count,
            median=median,
            p99=p99,
            p999=p999,
            histogram=list(zip(EDGES_MS, self._counts, strict=True)),
        )
