"""A thread for answers that take longer than the control loop may."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")

_TIME_LIMIT = 1.0  # s; an answer takes some tens of milliseconds


class AnswerThread(Generic[T]):
    """One thread, in which the newest question wins: one that waits is replaced by the next.

    arrived: called in the loop when there is something to `take`, or an answer is 1 s late.
    """

    def __init__(self, arrived: Callable[[], None]) -> None:
        self._arrived = arrived
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="answers")
        self._running: asyncio.Future[T] | None = None
        self._limit: asyncio.TimerHandle | None = None
        self._is_late = False
        self._next: Callable[[], T] | None = None
        self._answered: asyncio.Future[T] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a question is being answered, so that no other must use the table."""
        return self._running is not None

    def compute(self, question: Callable[[], T]) -> None:
        """Compute in the thread, after what is being computed."""
        self._next = question
        if not self.is_busy:
            self._start()

    def take(self) -> T | None:
        """Return the newest answer that was not taken yet; None without any; raises its error.

        Raises TimeoutError while an answer has been computed for more than 1 s.
        """
        if self._is_late:
            raise TimeoutError(f"answer must take less than {_TIME_LIMIT:g} s, is still computed")
        answered, self._answered = self._answered, None
        return None if answered is None else answered.result()

    def _start(self) -> None:
        question, self._next = self._next, None
        if question is not None:
            loop = asyncio.get_running_loop()
            self._running = loop.run_in_executor(self._pool, question)
            self._running.add_done_callback(self._done)
            self._limit = loop.call_later(_TIME_LIMIT, self._late)

    def _late(self) -> None:
        self._is_late = True
        self._arrived()

    def _done(self, answered: "asyncio.Future[T]") -> None:
        self._running, self._is_late = None, False
        if self._limit is not None:
            self._limit.cancel()
        if not answered.cancelled():
            self._answered = answered
        self._start()
        self._arrived()
