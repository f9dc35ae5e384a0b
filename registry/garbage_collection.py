"""Avoidance of long garbage collections while amplifiers are armed.

A full collection visits every loaded object: 80 ms with the numerical and CAN libraries, and on a
busy machine longer than an amplifier's watchdog.
"""

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_MANY = 10_000  # objects; a collection of fewer takes about a millisecond
_building = threading.RLock()


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


@contextmanager
def without_collections() -> Iterator[None]:
    """Create objects, as in a thread: no collection visits them, nor afterwards if they are many.

    Few are collected as usual: excluded garbage is never freed.
    """
    with _building:
        is_outermost = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if gc.get_count()[0] > _MANY:
                gc.freeze()
            if is_outermost:
                gc.enable()
