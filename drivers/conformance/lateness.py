"""Delays of this program, and of an emulated amplifier that shares its processors."""

import asyncio
from pathlib import Path

from drivers import clock

_PERIOD = 0.002  # s

STALL = 0.004
"""Lateness [s] from which an attempt counts as disturbed."""


class Lateness:
    """Measures the lateness of the running event loop while its context lasts.

    worst [s]: the largest delay of a timer.
    process: number of a process on this machine that is the amplifier; its threads are late while
    they wait for a processor.
    """

    def __init__(self, process: int | None = None) -> None:
        self._process = process
        self._waited = waited_for_processor(process)
        self.worst = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0

    def __enter__(self) -> "Lateness":
        self._schedule()
        return self

    def __exit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._note()

    def _schedule(self) -> None:
        self._due = clock.now() + _PERIOD
        self._timer = asyncio.get_running_loop().call_at(self._due, self._fired)

    def _fired(self) -> None:
        self._note()
        self._schedule()

    def _note(self) -> None:
        before, self._waited = self._waited, waited_for_processor(self._process)
        late = max(clock.now() - self._due, self._waited - before)
        self.worst = max(self.worst, late)


def waited_for_processor(process: int | None) -> float:
    """Return how long [s] the threads of a process were ready to run and did not.

    By Linux's statistics of its scheduler; 0 for no process, or one that has ended.
    """
    if process is None or not (tasks := Path(f"/proc/{process}/task")).is_dir():
        return 0.0
    total = 0
    for task in tasks.iterdir():
        try:
            _, waited, _ = (task / "schedstat").read_text("ascii").split()
        except OSError:  # a thread that has just ended
            continue
        total += int(waited)
    return total * 1e-9
