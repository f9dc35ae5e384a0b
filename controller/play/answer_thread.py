"""Threads for answers that take longer than the control loop may.

An answer that hangs cannot be ended, only left behind: its thread holds up neither the next answer
nor the end of the process, and what it returns at last is dropped.
"""

import asyncio
import logging
from collections.abc import Callable
from typing import Generic, TypeVar

from registry.threads import DaemonThreads

T = TypeVar("T")

TIME_LIMIT = 1.0
"""Time [s] after which an answer is given up; it takes some tens of milliseconds."""

MAX_LATE = 2
"""Answers that may still be computed after they were given up; until one ends none is begun."""

_logger = logging.getLogger(__name__)


class AnswerThread(Generic[T]):
    """Answers one question at a time, each in a thread, until it has come or is given up.

    arrived: called in the loop when there is something to `take`; freed: when an answer that was
    given up has ended, before that.
    """

    def __init__(self, arrived: Callable[[], None], freed: Callable[[], None]) -> None:
        self._arrived, self._freed = arrived, freed
        self._threads = DaemonThreads()
        self.is_busy = False
        """Whether an answer is computed, or not taken yet: one at a time is asked of the table."""
        self._answer: asyncio.Future[T] | None = None
        self._late = set[asyncio.Future[T]]()  # given up, and still computed

    @property
    def is_blocked(self) -> bool:
        """Whether too many answers that were given up are still computed."""
        return len(self._late) >= MAX_LATE

    def compute(self, question: Callable[[], T], *, instead: T) -> None:
        """Compute in a thread, if neither busy nor blocked; instead: taken if that is late."""
        loop = asyncio.get_running_loop()
        self._answer, self.is_busy = loop.run_in_executor(self._threads, question), True
        self._answer.add_done_callback(self._note)
        loop.call_later(TIME_LIMIT, self._give_up, self._answer, instead)

    def take(self) -> T | None:
        """Return the answer that was not taken yet; None without any; raises its error."""
        answer = self._answer
        if answer is None or not answer.done():
            return None
        self._answer, self.is_busy = None, False
        return None if answer.cancelled() else answer.result()

    def _give_up(self, answer: "asyncio.Future[T]", instead: T) -> None:
        if not answer.done():
            _logger.warning("loop: answer given up, still computed after %g s", TIME_LIMIT)
            self._late.add(answer)
            self._answer = asyncio.get_running_loop().create_future()
            self._answer.set_result(instead)
            self._arrived()

    def _note(self, answer: "asyncio.Future[T]") -> None:
        if answer in self._late:
            self._late.remove(answer)
            answer.exception()  # of no interest any more
            self._freed()
        self._arrived()
