"""Work that blocks, in a thread that holds nobody up: neither who gives it up nor a program's end.

The threads of asyncio's own pool are waited for before a program ends: where a connection or a disk
hangs, that is seconds, or for ever.
"""

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import TypeVar

CLOSE_TIMEOUT = 0.7
"""How long [s] a device may take to be closed: one far away 0.4 s; whoever ends has a second."""

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


async def in_thread(
    work: Callable[[], _T], *, name: str, undo: Callable[[_T], None] | None = None
) -> _T:
    """What work gives, or raises; name: of its thread.

    undo: what is done, in a thread as well, with what comes of work that was given up, such as
    closing what it opened. Given up by cancelling.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[_T] = loop.create_future()

    def give(result: _T) -> None:
        if done.cancelled():
            _undo(result)
        else:
            done.set_result(result)

    def fail(problem: Exception) -> None:
        if not done.cancelled():
            done.set_exception(problem)

    def _undo(result: _T) -> None:
        if undo is not None:
            threading.Thread(target=undo, args=(result,), name=name, daemon=True).start()

    def run() -> None:
        try:
            result = work()
        except Exception as problem:
            _post(loop, fail, problem)
        else:
            if not _post(loop, give, result) and undo is not None:
                undo(result)

    threading.Thread(target=run, name=name, daemon=True).start()
    try:
        return await done
    except asyncio.CancelledError:
        if not done.cancelled() and done.exception() is None:  # it came in this very moment
            _undo(done.result())
        raise


async def close_in_thread(close: Callable[[], object], *, name: str) -> None:
    """Close something and wait for that, but not for a device that hangs: it is left to its thread.

    Raises what closing raises; name: of the thread.
    """
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT):
            await in_thread(close, name=name)
    except TimeoutError:
        _logger.warning("%s: not done after %g s, and not waited for", name, CLOSE_TIMEOUT)


def _post(loop: asyncio.AbstractEventLoop, callback: Callable[[_T], None], argument: _T) -> bool:
    """Whether the loop is there still, and calls back."""
    try:
        loop.call_soon_threadsafe(callback, argument)
    except RuntimeError:
        return False
    return True
