"""Threads for answers that take longer than the control loop may.

An answer that hangs cannot be ended, only left behind: its thread holds up neither the next answer
nor the end of the process, and what it returns at last is dropped.
"""

import asyncio
from collections.abc import Callable
from typing import Generic, TypeVar

from drivers.threads import WorkerThread

T = TypeVar("T")

TIME_LIMIT = 1.0
"""Time [s] after which an answer is given up; it takes some tens of milliseconds."""

MAX_LATE = 2
"""Answers that may still be computed after they were given up; until one ends none is begun."""


class AnswerThread(Generic[T]):
    """A thread that answers one question at a time, another one after an answer that was given up.

    arrived: called in the loop when `take` has something to return or to raise; freed: before it,
    when an answer that was given up has ended.
    """

    def __init__(self, arrived: Callable[[], None], freed: Callable[[], None]) -> None:
        self._arrived, self._freed = arrived, freed
        self._worker = WorkerThread("answers")
        self._answer: asyncio.Future[T] | None = None
        self._limit: asyncio.TimerHandle | None = None
        self._is_late = False
        self._late = 0  # given up, and still computed

    @property
    def is_busy(self) -> bool:
        """Whether an answer is computed, or not taken yet: one at a time is asked of the table."""
        return self._answer is not None

    @property
    def is_blocked(self) -> bool:
        """Whether too many answers that were given up are still computed."""
        return self._late >= MAX_LATE

    def compute(self, question: Callable[[], T]) -> None:
        """Compute in the thread, which must be neither busy nor blocked."""
        loop = asyncio.get_running_loop()
        self._answer = loop.run_in_executor(self._worker, question)
        self._answer.add_done_callback(self._done)
        self._limit = loop.call_later(TIME_LIMIT, self._note_late)

    def take(self) -> T | None:
        """Return the answer that was not taken yet; None without any; raises its error.

        Raises TimeoutError, once, for an answer that has been computed for more than 1 s: it is
        given up.
        """
        answer = self._answer
        if answer is None or not (self._is_late or answer.done()):
            return None
        self._answer, self._is_late = None, False
        if self._limit is not None:
            self._limit.cancel()
        if not answer.done():
            self._late += 1
            self._worker = WorkerThread("answers")
            raise TimeoutError
        return None if answer.cancelled() else answer.result()

    def _note_late(self) -> None:
        self._is_late = True
        self._arrived()

    def _done(self, answer: "asyncio.Future[T]") -> None:
        if answer is not self._answer:
            self._late -= 1
            if not answer.cancelled():
                answer.exception()  # of no interest any more
            self._freed()
        self._arrived()
