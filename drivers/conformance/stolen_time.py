"""Time that a host of virtual machines has taken from this one's processors."""

import contextlib
import os
from pathlib import Path

from drivers import clock

_STATISTICS = Path("/proc/stat")
_FIRST_LINE = 256  # bytes that hold it
_STEAL = 8  # column: user, nice, system, idle, iowait, irq, softirq, steal
_APART = 0.01  # s; between two looks, a tick of the kernel's statistics
_STALL = 0.02  # s; less is made up for by an amplifier on this machine


class StolenTime:
    """How long processors stood still, without any program being ready to run, by Linux.

    A process on such a processor counts as running, so that its own statistics do not show it.
    statistics: as /proc/stat. Used as a context, since it keeps the file open.
    """

    def __init__(self, statistics: Path = _STATISTICS) -> None:
        self._descriptor: int | None = None
        with contextlib.suppress(OSError):  # not Linux
            self._descriptor = os.open(statistics, os.O_RDONLY | os.O_CLOEXEC)
        self._looked_at, self._total = clock.now(), 0.0
        self._ticks = self._read()

    def __enter__(self) -> "StolenTime":
        return self

    def __exit__(self, *_: object) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def total(self) -> float:
        """Return the time [s] of stalls so far."""
        if clock.now() >= self._looked_at + _APART:
            self._looked_at, before = clock.now(), self._ticks
            self._ticks = self._read()
            stolen = (self._ticks - before) / os.sysconf("SC_CLK_TCK")
            self._total += stolen if stolen >= _STALL else 0.0
        return self._total

    def _read(self) -> int:
        if self._descriptor is None:
            return 0
        try:
            return int(os.pread(self._descriptor, _FIRST_LINE, 0).split(b"\n")[0].split()[_STEAL])
        except (OSError, IndexError, ValueError):
            return 0
