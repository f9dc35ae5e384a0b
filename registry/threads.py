"""Threads, garbage collection and time for programs that control amplifiers.

- Blocking work runs in daemon threads, so that neither a cancellation nor an exit waits for it.
  asyncio's own thread pool would delay the end of a program, forever if a connection hangs.
- Garbage collections are kept short while amplifiers are armed. A full collection takes 80 ms with
  the numerical and CAN libraries loaded, and on a busy machine longer than an amplifier's watchdog.
- `now` is the time of the event loop, which can be virtual.
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
from typing import Any, ParamSpec, Protocol, TypeVar

CLOSE_TIMEOUT = 0.7
"""Maximum time to close a device [s]. A remote device takes 0.4 s; a program has 1 s to end."""

_logger = logging.getLogger(__name__)
_running: set[Future[Any]] = set()  # results of running work
_P = ParamSpec("_P")
_T = TypeVar("_T")


async def in_thread(
    work: Callable[[], _T], *, name: str, undo: Callable[[_T], object] | None = None
) -> _T:
    """Run work in a thread with this name; return its result, or raise its exception.

    undo: called in a thread with the result of work that was cancelled, to close a resource that it
    opened. Raises RuntimeError if the system cannot start a thread.
    """
    future: Future[_T] = Future()
    thread = threading.Thread(target=_run, args=(work, future, undo), name=name, daemon=True)
    _running.add(future)
    try:
        thread.start()
    except RuntimeError:  # the system has no more threads
        _running.discard(future)
        raise
    try:
        return await asyncio.wrap_future(future)
    except asyncio.CancelledError:
        # The work ended just before the cancellation.
        if undo is not None and not future.cancelled() and future.exception() is None:
            threading.Thread(target=undo, args=(future.result(),), name=name, daemon=True).start()
        raise


def _run(
    work: Callable[[], _T], future: "Future[_T]", undo: Callable[[_T], object] | None = None
) -> None:
    """Do work in the current thread; count it as running until its result is stored."""
    try:
        _store_result(work, future, undo)
    finally:
        _running.discard(future)


def _store_result(
    work: Callable[[], _T], future: "Future[_T]", undo: Callable[[_T], object] | None
) -> None:
    """Store the result of work, or its error; undo: called with the result of cancelled work.

    An attempt to end the program, such as sys.exit(), becomes a RuntimeError.
    """
    try:
        result = work()
    except Exception as error:
        _store_error(error, future)
        return
    except BaseException as error:
        failure = RuntimeError(f"work in a thread must return or fail, got {error!r}")
        failure.__cause__ = error
        _store_error(failure, future)
        return
    try:
        future.set_result(result)
    except InvalidStateError:  # cancelled
        if undo is not None:
            undo(result)


def _store_error(error: Exception, future: "Future[_T]") -> None:
    """Store the error of work unless it was cancelled."""
    with suppress(InvalidStateError):
        future.set_exception(error)


def are_at_work() -> bool:
    """Whether work is running in a thread, or its result is not stored yet."""
    return bool(_running)


def leave_work() -> None:
    """End the process immediately, with status 0, if work is running in a thread.

    Call this last, after everything else is closed. If a program ends in the usual way, a library
    can wait forever for its own threads.
    """
    if _running:
        for stream in (sys.stdout, sys.stderr):
            print(end="", file=stream, flush=True)  # unlike stream.flush(), accepts None
        os._exit(0)


class DaemonThreads(ThreadPoolExecutor):
    """Executor for event loops that starts a daemon thread for each work item."""

    def submit(self, work: Callable[_P, _T], /, *args: _P.args, **named: _P.kwargs) -> "Future[_T]":
        """Start work immediately; raises RuntimeError if the system cannot start a thread."""
        future: Future[_T] = Future()
        _running.add(future)
        try:
            # `threading` would wait until the thread runs, a millisecond on a busy machine.
            _thread.start_new_thread(_run, (partial(work, *args, **named), future))
        except RuntimeError:  # the system has no more threads
            _running.discard(future)
            raise
        return future


async def close_in_thread(close: Callable[[], object], *, name: str) -> None:
    """Close a device in a thread with this name; wait at most CLOSE_TIMEOUT for it.

    Exceptions of `close` are raised here.
    """
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT):
            await in_thread(close, name=name)
    except TimeoutError:
        _logger.warning("%s: still closing after %g s, continuing without it", name, CLOSE_TIMEOUT)


class LoopRunner(Protocol):
    """Runs coroutines in an event loop that lives in another thread."""

    @property
    def is_open(self) -> bool:
        """Whether it runs coroutines."""

    def run(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Run a coroutine and wait for its result; cancel it on Ctrl-C."""

    def close(self) -> None:
        """End the thread."""


class LoopThread:
    """Event loop in a named daemon thread; it ends with `close`, or with this object."""

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
        """Whether the thread still runs."""
        return self._end.alive

    def run(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Run a coroutine in the thread and wait for its result; cancel it on Ctrl-C."""
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


_MANY_OBJECTS = 10_000  # a collection of fewer objects takes about a millisecond
_building = threading.RLock()


@contextmanager
def no_long_collections() -> Iterator[None]:
    """Exclude all existing objects from garbage collection during a `with` block.

    Objects created in the block are collected as usual. Enter it when everything is set up.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def without_collections() -> Iterator[None]:
    """Turn off garbage collection during a `with` block that creates objects in a thread.

    If they are many, later collections skip them. If they are few, they are collected as usual,
    because garbage that is skipped is never freed.
    """
    with _building:
        is_outermost = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if gc.get_count()[0] > _MANY_OBJECTS:
                gc.freeze()
            if is_outermost:
                gc.enable()


async def stop_accepting(server: asyncio.Server) -> None:
    """Close a server's listening sockets; connections that it has accepted stay open.

    Before Python 3.12, `close` alone drops connections that are being opened.
    """
    loop = asyncio.get_running_loop()
    for socket in server.sockets:
        loop.remove_reader(socket)
    for _ in range(3):  # iterations of the loop in which accepted connections are opened
        await asyncio.sleep(0)
    server.close()


def now() -> float:
    """Return the time [s] of the running event loop, or time.monotonic() if none runs."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()
