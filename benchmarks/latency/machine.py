"""Load of the machine by other programs during a measurement."""

import os
import time
from collections.abc import Callable
from pathlib import Path

_STAT = Path("/proc/stat")
_IDLE, _WAITING, _STOLEN = 3, 4, 7  # columns of /proc/stat's line of all processors, proc(5)


class Others:
    """Measures how busy other programs keep the processors, from construction on.

    own: returns the processor time [s] used by the benchmark so far.
    """

    def __init__(self, own: Callable[[], float]) -> None:
        self._own = own
        self._begin = time.monotonic()
        self._before = self._busy()

    def processors(self) -> float:
        """Average number of processors kept busy by others, including the kernel.

        Includes time stolen by other guests of the host; 0 where the system does not report it.
        """
        lasted = max(time.monotonic() - self._begin, 1e-9)
        return max(0.0, self._busy() - self._before) / lasted

    def _busy(self) -> float:
        """Processor time [s] of all others since the system started."""
        return busy_time() - self._own()


def busy_time() -> float:
    """Processor time [s] of all processors so far, neither idle nor waiting for a disk."""
    if not _STAT.exists():
        return 0.0
    return busy_ticks(_STAT.read_text("ascii").splitlines()[0]) / os.sysconf("SC_CLK_TCK")


def busy_ticks(line: str) -> int:
    """The same in ticks, from the first line of /proc/stat."""
    ticks = [int(word) for word in line.split()[1:]]
    # The time of guests is included in the first columns.
    return sum(ticks[: _STOLEN + 1]) - ticks[_IDLE] - ticks[_WAITING]
