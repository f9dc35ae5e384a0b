"""The clock of links and far ends: that of the event loop.

It is time.monotonic() on asyncio's own loops, and virtual time on a loop with a virtual clock.
"""

import asyncio
import time


def now() -> float:
    """Return the time [s] of the running event loop, or time.monotonic() if none runs."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()
