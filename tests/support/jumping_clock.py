"""`era` on a machine whose wall clock jumps: `python tests/support/jumping_clock.py daemon ...`.

Every SIGVTALRM sets it to the next of `JUMPS`. Only what Python reads as the time of day jumps, not
what the kernel and CLOCK_MONOTONIC tell, as when an administrator or NTP sets the clock. It waits
for a busy machine.
"""

import itertools
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from controller.cli.main import main
from patient_daemon import wait_long

JUMPS = (86_400.0, -86_400.0, 0.4, -0.4, 3e8, -1.7e9, 0.0)
"""How far [s] it is from the real one: days, less than a lease, another decade, near 1970."""


def _jumping() -> None:
    offset = 0.0
    jumps = itertools.cycle(JUMPS)
    real, real_ns = time.time, time.time_ns

    def jump(number: int, frame: object) -> None:
        nonlocal offset
        offset = next(jumps)

    def from_now(of: Callable[[float], Any]) -> Callable[..., Any]:
        return lambda seconds=None: of(time.time() if seconds is None else seconds)

    signal.signal(signal.SIGVTALRM, jump)
    time.time = lambda: real() + offset
    time.time_ns = lambda: real_ns() + round(offset * 1e9)
    time.gmtime = from_now(time.gmtime)  # type: ignore[assignment]
    time.localtime = from_now(time.localtime)  # type: ignore[assignment]


if __name__ == "__main__":
    wait_long(pytest.MonkeyPatch())
    _jumping()
    sys.exit(main())
