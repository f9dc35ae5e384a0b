"""A thread for answers that take longer than the control loop may."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")

_TIME_LIMIT = 1.0  # s; an answer takes some tens of milliseconds


class AnswerThread(Generic[T]):
    """One thread that answers one question at a time.

    arrived: called in the loop when there is something to `take`, or an answer is 1 s late.
    """

    def __init__(self, arrived: Callable[[], None]) -> None:
        self._arrived = arrived
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="answers")
        self._answer: asyncio.Future[T] | None = None
        self._limit: asyncio.TimerHandle | None = None
        self._is_late = False

    @property
    def is_busy(self) -> bool:
        """Whether an answer is not taken yet: until then no other may use the table."""
        return self._answer is not None

    def compute(self, question: Callable[[], T]) -> None:
        """Compute in the thread, which must not be busy."""
        loop = asyncio.get_running_loop()
        self._answer = loop.run_in_executor(self._pool, question)
        self._answer.add_done_callback(lambda _: self._arrived())
        self._limit = loop.call_later(_TIME_LIMIT, self._late)

    def take(self) -> T | None:
        """Return the answer that was not taken yet; None without any; raises its error.

        Raises TimeoutError while an answer has been computed for more than 1 s.
        """
        answer = self._answer
        if answer is None:
            return None
        if not answer.done():
            if self._is_late:
                raise TimeoutError(
                    f"answer must take less than {_TIME_LIMIT:g} s, is still computed"
                )
            return None
        self._answer, self._is_late = None, False
        if self._limit is not None:
            self._limit.cancel()
        return None if answer.cancelled() else answer.result()

    def _late(self) -> None:
        self._is_late = True
        self._arrived()
