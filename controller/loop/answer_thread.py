"""A thread for answers that take longer than the control loop may."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class AnswerThread(Generic[T]):
    """One thread, in which the newest question wins: one that waits is replaced by the next.

    arrived: called in the loop when there is something to `take`.
    """

    def __init__(self, arrived: Callable[[], None]) -> None:
        self._arrived = arrived
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="answers")
        self._running: asyncio.Future[T] | None = None
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
        """Return the newest answer that was not taken yet; None without any; raises its error."""
        answered, self._answered = self._answered, None
        return None if answered is None else answered.result()

    def _start(self) -> None:
        question, self._next = self._next, None
        if question is not None:
            self._running = asyncio.get_running_loop().run_in_executor(self._pool, question)
            self._running.add_done_callback(self._done)

    def _done(self, answered: "asyncio.Future[T]") -> None:
        self._running = None
        if not answered.cancelled():
            self._answered = answered
        self._start()
        self._arrived()
