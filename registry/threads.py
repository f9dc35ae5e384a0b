"""Blocking work and event loops in daemon threads: no cancellation and no exit waits for them.

A program waits for the threads of asyncio's own pool before it ends, which may take indefinitely if
a connection or a disk hangs.
"""

import _thread
import asyncio
import logging
import os
import sys
import threading
import weakref
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any, ParamSpec, TypeVar

CLOSE_TIMEOUT = 0.7
"""Longest time [s] to close a device; a remote one takes 0.4 s, a program has 1 s to end."""

_logger = logging.getLogger(__name__)
_at_work: set[Future[Any]] = set()
_P = ParamSpec("_P")
_T = TypeVar("_T")


async def in_thread(
    work: Callable[[], _T], *, name: str, undo: Callable[[_T], object] | None = None
) -> _T:
    """Run work in a thread of this name and return its result.

    undo: called, in a thread too, with the result of work that was cancelled, to close what it
    opened.
    """
    done: Future[_T] = Future()
    threading.Thread(target=_run, args=(work, done, undo), name=name, daemon=True).start()
    try:
        return await asyncio.wrap_future(done)
    except asyncio.CancelledError:
        # Finished at the moment of the cancellation.
        if undo is not None and not done.cancelled() and done.exception() is None:
            threading.Thread(target=undo, args=(done.result(),), name=name, daemon=True).start()
        raise


def _run(
    work: Callable[[], _T], done: "Future[_T]", undo: Callable[[_T], object] | None = None
) -> None:
    """Note the result of work, or its error; undo: called with that of work that was cancelled."""
    _at_work.add(done)
    try:
        result = work()
    except Exception as error:
        with suppress(InvalidStateError):  # cancelled
            done.set_exception(error)
        return
    finally:
        _at_work.discard(done)
    try:
        done.set_result(result)
    except InvalidStateError:
        if undo is not None:
            undo(result)


def leave_work() -> None:
    """End the process at once where work goes on; to be called when all else is closed.

    A library may wait for ever for its own threads if it ends while one is at work.
    """
    if _at_work:
        for stream in (sys.stdout, sys.stderr):
            print(end="", file=stream, flush=True)  # a closed one is None
        os._exit(0)


class DaemonThreads(ThreadPoolExecutor):
    """A pool for event loops, their own or another, with a daemon thread for each work."""

    def submit(self, work: Callable[_P, _T], /, *args: _P.args, **named: _P.kwargs) -> "Future[_T]":
        """Do work at once."""
        done: Future[_T] = Future()
        # Not by `threading`, which waits until it runs: a millisecond where that computes.
        _thread.start_new_thread(_run, (partial(work, *args, **named), done))
        return done


async def close_in_thread(close: Callable[[], object], *, name: str) -> None:
    """Close a device in a thread of this name, and wait at most CLOSE_TIMEOUT for it.

    Raises what closing raises.
    """
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT):
            await in_thread(close, name=name)
    except TimeoutError:
        _logger.warning("%s: still closing after %g s, continuing without it", name, CLOSE_TIMEOUT)


class LoopThread:
    """An event loop in a daemon thread of a name, until `close` or until nothing refers to it."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        finished = asyncio.Event()
        thread = threading.Thread(
            target=_run_until, args=[self._loop, finished], name=name, daemon=True
        )
        thread.start()
        self._end = weakref.finalize(self, _end, self._loop, finished, thread)

    @property
    def is_open(self) -> bool:
        """Whether it still runs."""
        return self._end.alive

    def run(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Run a coroutine; cancel it if waiting is interrupted."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def close(self) -> None:
        """End the thread."""
        self._end()


def _run_until(loop: asyncio.AbstractEventLoop, finished: asyncio.Event) -> None:
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(finished.wait())


def _end(
    loop: asyncio.AbstractEventLoop, finished: asyncio.Event, thread: threading.Thread
) -> None:
    loop.call_soon_threadsafe(finished.set)
    if thread is not threading.current_thread():
        thread.join()
