"""Avoidance of long garbage collections while amplifiers are armed.

A full collection visits every loaded object: 80 ms with the numerical and CAN libraries, and on a
busy machine longer than an amplifier's watchdog.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def no_long_collections() -> Iterator[None]:
    """Exclude all present objects from garbage collection while the context lasts.

    Objects created within it are collected as usual. Enter it once everything is set up.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
