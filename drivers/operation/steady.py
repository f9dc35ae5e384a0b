"""Keeping a process from being held up while amplifiers depend on it.

A full garbage collection looks at every object that was ever loaded: with the numerical and CAN
libraries that is 80 ms of computing, and on a busy machine longer than an amplifier's watchdog.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def no_long_collections() -> Iterator[None]:
    """Leave all that is loaded by now out of garbage collections, as long as the context lasts.

    Objects made within it are collected as ever. To be entered once everything is set up.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
