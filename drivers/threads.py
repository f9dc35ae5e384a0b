"""Blocking work in daemon threads, which delay neither a cancellation nor the end of the program.

A program waits for the threads of asyncio's own pool before it ends, which may take indefinitely if
a connection or a disk hangs.
"""

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from typing import TypeVar

CLOSE_TIMEOUT = 0.7
"""Longest time [s] to close a device; a remote one takes 0.4 s, a program has 1 s to end."""

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


async def in_thread(
    work: Callable[[], _T], *, name: str, undo: Callable[[_T], object] | None = None
) -> _T:
    """Run work in a thread of this name and return its result.

    undo: called, in a thread too, with the result of work that was cancelled, to close what it
    opened.
    """
    done: Future[_T] = Future()

    def run() -> None:
        try:
            result = work()
        except Exception as error:
            with suppress(InvalidStateError):  # cancelled
                done.set_exception(error)
            return
        try:
            done.set_result(result)
        except InvalidStateError:
            if undo is not None:
                undo(result)

    threading.Thread(target=run, name=name, daemon=True).start()
    try:
        return await asyncio.wrap_future(done)
    except asyncio.CancelledError:
        # Finished at the moment of the cancellation.
        if undo is not None and not done.cancelled() and done.exception() is None:
            threading.Thread(target=undo, args=(done.result(),), name=name, daemon=True).start()
        raise


async def close_in_thread(close: Callable[[], object], *, name: str) -> None:
    """Close a device in a thread of this name, and wait at most CLOSE_TIMEOUT for it.

    Raises what closing raises.
    """
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT):
            await in_thread(close, name=name)
    except TimeoutError:
        _logger.warning("%s: still closing after %g s, continuing without it", name, CLOSE_TIMEOUT)
