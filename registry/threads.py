"""Threads, event loops and time for programs in which amplifiers must not wait.

Blocking work runs in daemon threads, so that neither a cancellation nor an exit waits for it. (A
program waits for asyncio's own thread pool before it ends, possibly forever if a connection or a
disk hangs.) Garbage collections are kept short while amplifiers are armed: a full one visits every
loaded object, which takes 80 ms with the numerical and CAN libraries, and longer than an
amplifier's watchdog on a busy machine. Pauses between retries increase.

The clock of links and far ends is the event loop's: time.monotonic() on asyncio's own loops,
virtual time on a loop with a virtual clock.
"""

import _thread
import asyncio
import gc
import logging
import os
import sys
import threading
import time
import weakref
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
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
    """Run work in a thread with this name and return its result.

    undo: called in a thread with the result of cancelled work, to close the resource that it
    opened.
    """
    done: Future[_T] = Future()
    thread = threading.Thread(target=_run, args=(work, done, undo), name=name, daemon=True)
    _at_work.add(done)
    try:
        thread.start()
    except RuntimeError:  # the system has no more threads
        _at_work.discard(done)
        raise
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
    """Do work of `_at_work` and store its result or error; it counts as running until then."""
    try:
        _note_result(work, done, undo)
    finally:
        _at_work.discard(done)


def _note_result(
    work: Callable[[], _T], done: "Future[_T]", undo: Callable[[_T], object] | None
) -> None:
    """Store the result of work, or its error; undo: called with the result of cancelled work.

    An attempt to end the program, such as sys.exit(), becomes a RuntimeError.
    """
    try:
        result = work()
    except Exception as error:
        _note_error(error, done)
        return
    except BaseException as error:
        failure = RuntimeError(f"work in a thread must return or fail, got {error!r}")
        failure.__cause__ = error
        _note_error(failure, done)
        return
    try:
        done.set_result(result)
    except InvalidStateError:
        if undo is not None:
            undo(result)


def _note_error(error: Exception, done: "Future[_T]") -> None:
    """Store the error of work that was not cancelled."""
    with suppress(InvalidStateError):
        done.set_exception(error)


def are_at_work() -> bool:
    """Whether `in_thread` has running work, or a result that is not stored yet."""
    return bool(_at_work)


def leave_work() -> None:
    """End the process immediately if work is running; call this last, when everything else is
    closed.

    A library can wait forever for its own threads if a program ends while one is running.
    """
    if _at_work:
        for stream in (sys.stdout, sys.stderr):
            print(end="", file=stream, flush=True)  # a closed stream is None
        os._exit(0)


class DaemonThreads(ThreadPoolExecutor):
    """Executor for event loops with a daemon thread for each work item."""

    def submit(self, work: Callable[_P, _T], /, *args: _P.args, **named: _P.kwargs) -> "Future[_T]":
        """Start work immediately."""
        done: Future[_T] = Future()
        _at_work.add(done)
        try:
            # `threading` would wait until the thread runs, a millisecond on a busy machine.
            _thread.start_new_thread(_run, (partial(work, *args, **named), done))
        except RuntimeError:  # the system has no more threads
            _at_work.discard(done)
            raise
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
    """Event loop in a named daemon thread, until `close` or until nothing refers to it."""

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
    """Create objects in a thread without garbage collections, which skip them later if they are
    many.

    A few objects are collected as usual, since excluded garbage is never freed.
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


FIRST_PAUSE = 0.1  # s; a loose contact recovers within it
MAX_PAUSE = 5.0  # s; the longest wait after an adapter was plugged in again
GOOD_TIME = 60.0
"""Time of successful operation [s] after which pauses are reset."""


def pauses(first: float = FIRST_PAUSE, maximum: float = MAX_PAUSE) -> Iterator[float]:
    """Yield pauses [s] between attempts, each twice the previous one."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, maximum)


class Backoff:
    """Pauses [s] before restarts: each twice the previous one, reset after a good run."""

    def __init__(self, first: float, maximum: float) -> None:
        self._bounds = first, maximum
        self._pauses = pauses(*self._bounds)

    def pause(self, *, ran_for: float) -> float:
        """Return the pause before the restart of a program that ran for a time [s]."""
        if ran_for >= GOOD_TIME:
            self._pauses = pauses(*self._bounds)
        return next(self._pauses)


async def stop_accepting(server: asyncio.Server) -> None:
    """Close a server's sockets, with every connection open that was accepted.

    Before Python 3.12 a server that closes meanwhile drops them without a word.
    """
    for each in server.sockets:
        asyncio.get_running_loop().remove_reader(each)
    for _ in range(3):  # iterations in which accepted connections are opened
        await asyncio.sleep(0)
    server.close()


def now() -> float:
    """Return the time [s] of the running event loop, or time.monotonic() if none runs."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()
