"""How a far end is told to end before it has anything to end in order.

While Python still loads, the usual KeyboardInterrupt may be raised inside a callback that swallows
it, or show as a traceback. Nothing is open yet, so the process may simply be gone.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_INTERRUPTED = 130


@contextmanager
def gone_when_told() -> Iterator[None]:
    """SIGTERM and SIGINT end the process at once, with exit status 130, unless others take over."""
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: os._exit(_INTERRUPTED)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
