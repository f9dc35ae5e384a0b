"""What else the machine did meanwhile, so that figures of a machine that was not idle show it."""

import os
import time
from collections.abc import Callable
from pathlib import Path

_STAT = Path("/proc/stat")
_IDLE, _WAITING, _STOLEN = 3, 4, 7  # columns of /proc/stat's line of all processors, proc(5)


class Others:
    """How busy everybody else keeps the processors, from when it is made.

    own: processor time [s] so far of those who belong to it.
    """

    def __init__(self, own: Callable[[], float]) -> None:
        self._own = own
        self._begin = time.monotonic()
        self._before = self._busy()

    def processors(self) -> float:
        """How many processors others kept busy on average, the kernel's own work among them.

        Also those of another machine, where this one is a guest; 0 where the system does not say.
        """
        lasted = max(time.monotonic() - self._begin, 1e-9)
        return max(0.0, self._busy() - self._before) / lasted

    def _busy(self) -> float:
        """Processor time [s] of all others since the system has started."""
        return busy_time() - self._own()


def busy_time() -> float:
    """Processor time [s] that is neither idle nor waiting for a disk, of all, so far."""
    if not _STAT.exists():
        return 0.0
    return busy_ticks(_STAT.read_text("ascii").splitlines()[0]) / os.sysconf("SC_CLK_TCK")


def busy_ticks(line: str) -> int:
    """The same from /proc/stat's line of all processors, in the system's ticks."""
    ticks = [int(word) for word in line.split()[1:]]
    # What guests of this machine use stands in the first columns already.
    return sum(ticks[: _STOLEN + 1]) - ticks[_IDLE] - ticks[_WAITING]
