"""Exit on signals while Python still loads, before anything needs an orderly shutdown.

A callback can swallow a KeyboardInterrupt at that time, or Python prints a traceback.
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
    former_handlers = {}
    for number in numbers:
        former_handlers[number] = signal.signal(number, lambda *_: os._exit(_INTERRUPTED))
    try:
        yield
    finally:
        for number, handler in former_handlers.items():
            signal.signal(number, handler)
