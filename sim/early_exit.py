"""Exit on signals while Python still loads, before anything needs an orderly shutdown.

A KeyboardInterrupt at that time may be swallowed by a callback or print a traceback.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_INTERRUPTED = 130


@contextmanager
def exit_on_signal() -> Iterator[None]:
    """Exit immediately with status 130 on SIGTERM and SIGINT."""
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: os._exit(_INTERRUPTED)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
