"""Blocking work in daemon threads, which delay neither a cancellation nor the end of the program.

A program waits for the threads of asyncio's own pool before it ends, which may take indefinitely if
a connection or a disk hangs.
"""

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import TypeVar

CLOSE_TIMEOUT = 0.7
"""Longest time [s] to close a device; a remote one takes 0.4 s, a program has 1 s to end."""

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


async def in_thread(
    work: Callable[[], _T], *, name: str, undo: Callable[[_T], None] | None = None
) -> _T:
    """Run work in a thread of this name and return its result.

    undo: called, in a thread too, with the result of work that was cancelled, to close what it
    opened.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[_T] = loop.create_future()

    def give(result: _T) -> None:
        if done.cancelled():
            _undo(result)
        else:
            done.set_result(result)

    def fail(error: Exception) -> None:
        if not done.cancelled():
            done.set_exception(error)

    def _undo(result: _T) -> None:
        if undo is not None:
            threading.Thread(target=undo, args=(result,), name=name, daemon=True).start()

    def run() -> None:
        try:
            result = work()
        except Exception as error:
            _post(loop, fail, error)
        else:
            if not _post(loop, give, result) and undo is not None:
                undo(result)

    threading.Thread(target=run, name=name, daemon=True).start()
    try:
        return await done
    except asyncio.CancelledError:
        if (
            not done.cancelled() and done.exception() is None
        ):  # finished at the moment of the cancellation
            _undo(done.result())
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


def _post(loop: asyncio.AbstractEventLoop, callback: Callable[[_T], None], argument: _T) -> bool:
    """Call back in the loop; returns whether it is still open."""
    try:
        loop.call_soon_threadsafe(callback, argument)
    except RuntimeError:
        return False
    return True
