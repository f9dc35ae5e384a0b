"""Keeps an estimator running in a process of its own, and hands it one pattern at a time.

Whatever happens to the process, the daemon goes on: one that dies, or does not answer in time, is
replaced after a growing pause, and after so many in a row without an answer no longer.
"""

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass

from controller.learning.messages import HEAD, Note, Reply, Request, Start, packed, unpacked
from controller.process.child import child_command, ended
from model.identification.settled_patterns import SettledPattern
from registry import threads
from registry.plugins import failure_text
from registry.threads import Backoff

MAX_WAITING = 16
"""Patterns that wait for the estimator; newer ones are dropped."""

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_BUFFER = 1 << 22  # bytes; more than most messages have
_CHORES = 5.0  # s; after which it is to do what else is due, and so shows that it lives
_CLOSE_TIMEOUT = 0.3  # s

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EstimatorTimeouts:
    """How long an estimator may take [s], and how often it is replaced.

    start: until it takes patterns; estimate: for one pattern, of which the search for an
    explanation takes longest; max_failures: in a row.
    """

    start: float = 60.0
    estimate: float = 30.0
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
        received: Callable[[Reply], None],
        failed: Callable[[str, bool], None],
        timeouts: EstimatorTimeouts = DEFAULT_TIMEOUTS,
    ) -> None:
        self._start, self._timeouts = start, timeouts
        self._received, self._failed = received, failed
        self._waiting: asyncio.Queue[SettledPattern] = asyncio.Queue(MAX_WAITING)
        self._has_estimated = False
        self._is_over = False
        self.pid: int | None = None
        """Of the process that runs now."""

    def hand(self, pattern: SettledPattern) -> bool:
        """Hand over a pattern; False where too many wait already, or none will be estimated."""
        if self._is_over or self._waiting.full():
            return False
        self._waiting.put_nowait(pattern)
        return True

    @property
    def waiting(self) -> int:
        """Patterns that were handed over and are still to be estimated, but for the present one."""
        return 0 if self._is_over else self._waiting.qsize()

    async def run(self) -> None:
        """Keep an estimator running until cancelled, refused, or given up; lets it end then."""
        timeouts, failures = self._timeouts, 0
        backoff = Backoff(first=1.0, maximum=60.0)
        while True:
            started_at, self._has_estimated = threads.now(), False
            try:
                reason = await self._run_one()
            except OSError as error:
                reason = f"cannot be started: {error}"
            failures = 1 if self._has_estimated else failures + 1
            self._is_over = self._is_over or failures >= timeouts.max_failures
            self._failed(reason, self._is_over)
            if self._is_over:
                return
            await asyncio.sleep(backoff.pause(ran_for=threads.now() - started_at))

    async def _run_one(self) -> str:
        """Run one process to its end; why it ended."""
        process = await asyncio.create_subprocess_exec(
            *child_command("controller.learning.estimator"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            limit=_BUFFER,
            start_new_session=True,  # Ctrl-C is handled by the daemon
        )
        self.pid, timeout = process.pid, 0.0
        try:
            return await self._serve(process)
        except asyncio.CancelledError:
            timeout = _CLOSE_TIMEOUT  # it keeps what it has learned
            raise
        finally:
            self.pid = None
            assert process.stdin is not None  # noqa: S101  a pipe was requested
            process.stdin.close()
            await ended(process, timeout)

    async def _serve(self, process: asyncio.subprocess.Process) -> str:
        """Hand over what waits, one after the other; why that ended."""
        request: Request = self._start
        chores_at = threads.now() + _CHORES
        while True:
            is_pattern = isinstance(request, SettledPattern)
            limit = self._timeouts.estimate if is_pattern else self._timeouts.start
            try:
                async with asyncio.timeout(limit):
                    content = await _exchange(process, packed(request))
                    if content is None:
                        return f"exited with status {await process.wait()}"
            except TimeoutError:
                return f"no reply within {limit:g} s"
            try:
                for reply in unpacked(content):
                    if isinstance(reply, Note) and reply.is_final:
                        self._is_over = True
                        return reply.text
                    self._received(reply)
            except Exception as error:
                _logger.exception("plate: a reply could not be taken")
                return f"a reply could not be taken: {failure_text(error)}"
            self._has_estimated = self._has_estimated or is_pattern
            request = None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.0, chores_at - threads.now())):
                    request = await self._waiting.get()
            if request is None:
                chores_at = threads.now() + _CHORES


async def _exchange(process: asyncio.subprocess.Process, request: bytes) -> bytes | None:
    """Send a request; its reply, None at the end of the output."""
    assert process.stdin is not None  # noqa: S101  pipes were requested
    assert process.stdout is not None  # noqa: S101
    process.stdin.write(request)
    try:
        head = await process.stdout.readexactly(HEAD)
        return await process.stdout.readexactly(int.from_bytes(head, "big"))
    except asyncio.IncompleteReadError:
        return None
