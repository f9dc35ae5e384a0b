"""The clock by which everything on a link happens.

It is the event loop's: time.monotonic() on the loops of asyncio, virtual on one that has a clock of
its own, so that drivers and far ends run in virtual time without knowing it.
"""

import asyncio
import time


def now() -> float:
    """The time [s] of the running event loop, or time.monotonic() where none runs."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()
