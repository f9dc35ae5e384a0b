"""Keeps an estimator running in a process of its own, and hands it one pattern at a time.

Whatever happens to the process, the daemon goes on: one that dies, or does not answer in time, is
replaced after a growing pause, and after so many in a row without an answer no longer.
"""

import asyncio
import contextlib
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass

from controller.learning.messages import (
    HEAD,
    Estimate,
    Note,
    Ready,
    Refreshed,
    Reply,
    Request,
    Start,
    packed,
    unpacked,
)
from drivers import clock
from drivers.pauses import Backoff
from model.identification.settled import SettledPattern
from registry.plugins import failure_text

MAX_WAITING = 16
"""Patterns that wait for the estimator; newer ones are dropped."""

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_BUFFER = 1 << 22  # bytes; more than most messages have
_CLOSE_TIMEOUT = 0.3  # s

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EstimatorTimeouts:
    """How long an estimator may take [s], and how often it is replaced.

    start: until it takes patterns; estimate: for one pattern, of which the search for an
    explanation takes longest; pause, max_pause: before it is replaced; max_failures: in a row.
    """

    start: float = 60.0
    estimate: float = 30.0
    pause: float = 1.0
    max_pause: float = 60.0
    max_failures: int = 8


DEFAULT_TIMEOUTS = EstimatorTimeouts()


class EstimatorProcess:
    """An estimator that is replaced when it fails.

    start: what each starts from, with answers that it knows; received: called with each reply;
    failed: called with the reason when one has ended, and whether no other is started.
    """

    def __init__(
        self,
        start: Start,
        *,
        received: Callable[[Ready | Estimate | Refreshed | Note], None],
        failed: Callable[[str, bool], None],
        timeouts: EstimatorTimeouts = DEFAULT_TIMEOUTS,
    ) -> None:
        self._start, self._timeouts = start, timeouts
        self._received, self._failed = received, failed
        self._waiting: asyncio.Queue[SettledPattern] = asyncio.Queue(MAX_WAITING)
        self._replied: asyncio.Future[None] | None = None
        self._refusal = ""
        self._has_replied = False
        self._is_over = False
        self.pid: int | None = None
        """Of the process that runs now."""

    def hand(self, pattern: SettledPattern) -> bool:
        """Hand over a pattern; False where too many wait already, or none will be estimated."""
        if self._is_over:
            return False
        try:
            self._waiting.put_nowait(pattern)
        except asyncio.QueueFull:
            return False
        return True

    @property
    def waiting(self) -> int:
        """Patterns that were handed over and are still to be estimated, but for the present one."""
        return 0 if self._is_over else self._waiting.qsize()

    async def run(self) -> None:
        """Keep an estimator running until cancelled, refused, or given up; lets it end then."""
        timeouts, failures = self._timeouts, 0
        backoff = Backoff(first=timeouts.pause, maximum=timeouts.max_pause)
        while True:
            started_at, self._has_replied = clock.now(), False
            try:
                reason = await self._run_one()
            except OSError as error:
                reason = f"cannot be started: {error}"
            failures = 1 if self._has_replied else failures + 1
            is_final = bool(self._refusal) or failures >= timeouts.max_failures
            self._is_over = is_final
            self._failed(self._refusal or reason, is_final)
            if is_final:
                return
            await asyncio.sleep(backoff.pause(ran_for=clock.now() - started_at))

    async def _run_one(self) -> str:
        """Run one process to its end; why it ended."""
        process = await asyncio.create_subprocess_exec(
            # -P: do not import a folder named controller in the working directory
            *(sys.executable, "-P", "-m", "controller.daemon.child_main"),
            *(str(os.getpid()), "controller.learning.estimator"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            limit=_BUFFER,
            start_new_session=True,  # Ctrl-C is handled by the daemon
        )
        self.pid = process.pid
        receiving = asyncio.create_task(self._receive(process))
        try:
            return await self._serve(process, receiving)
        except asyncio.CancelledError:
            await _let_end(process)  # it keeps what it has learned
            raise
        finally:
            self.pid = None
            receiving.cancel()
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            await asyncio.gather(receiving, return_exceptions=True)

    async def _serve(
        self, process: asyncio.subprocess.Process, receiving: "asyncio.Task[None]"
    ) -> str:
        """Hand over what waits, one after the other; why that ended."""
        request: Request = self._start
        limit = self._timeouts.start
        while True:
            reason = await self._exchange(process, receiving, request, limit)
            if reason:
                return reason
            getting = asyncio.create_task(self._waiting.get())
            try:
                await asyncio.wait({getting, receiving}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                getting.cancel()
            if not getting.done() or getting.cancelled():
                return await _end_of(process, receiving)
            request, limit = getting.result(), self._timeouts.estimate

    async def _exchange(
        self,
        process: asyncio.subprocess.Process,
        receiving: "asyncio.Task[None]",
        request: Request,
        limit: float,
    ) -> str:
        """Send a request and wait for its reply; why there is none, or nothing."""
        assert process.stdin is not None  # noqa: S101  a pipe was requested
        self._replied = asyncio.get_running_loop().create_future()
        process.stdin.write(packed(request))
        await asyncio.wait(
            {self._replied, receiving}, timeout=limit, return_when=asyncio.FIRST_COMPLETED
        )
        if self._replied.done():
            return self._refusal
        if receiving.done():
            return await _end_of(process, receiving)
        return f"no reply within {limit:g} s"

    async def _receive(self, process: asyncio.subprocess.Process) -> None:
        """Pass on replies until the end of its output."""
        assert process.stdout is not None  # noqa: S101  a pipe was requested
        with contextlib.suppress(asyncio.IncompleteReadError):
            while True:
                head = await process.stdout.readexactly(HEAD)
                content = await process.stdout.readexactly(int.from_bytes(head, "big"))
                reply: Reply = unpacked(content)
                if isinstance(reply, Note) and reply.is_final:
                    self._refusal = reply.text
                else:
                    self._received(reply)
                if not isinstance(reply, Refreshed | Note) or self._refusal:
                    self._has_replied = self._has_replied or isinstance(reply, Estimate)
                    if self._replied is not None and not self._replied.done():
                        self._replied.set_result(None)


async def _end_of(process: asyncio.subprocess.Process, receiving: "asyncio.Task[None]") -> str:
    """How a process ended whose replies have, or why the daemon could not take one."""
    if receiving.done() and (error := receiving.exception()) is not None:
        _logger.error("plate: a reply could not be taken", exc_info=error)
        return f"a reply could not be taken: {failure_text(error)}"
    try:
        async with asyncio.timeout(_CLOSE_TIMEOUT):
            return f"exited with status {await process.wait()}"
    except TimeoutError:
        return "closed its output"


async def _let_end(process: asyncio.subprocess.Process) -> None:
    """End the input of a process, and wait a moment for its end."""
    assert process.stdin is not None  # noqa: S101  a pipe was requested
    process.stdin.close()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_CLOSE_TIMEOUT):
            await process.wait()
