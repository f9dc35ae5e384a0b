"""Calls of observers, apart from what they observe."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable

_DELAY = 0.001  # s; the actions of a transition have begun by then
_MAX_PENDING = 256

_logger = logging.getLogger(__name__)


class DeferredCalls:
    """Calls callbacks a moment later, in order, each after a moment of its own.

    An exception of one is logged and affects no other. Of more pending calls than a bound the
    oldest are dropped.
    """

    def __init__(self) -> None:
        self._pending: deque[Callable[[], object]] = deque(maxlen=_MAX_PENDING)

    def add(self, callback: Callable[[], object]) -> None:
        """Call back a moment later."""
        self._pending.append(callback)
        pause = _DELAY * len(self._pending)
        asyncio.get_running_loop().call_later(pause, self._call_next)

    def flush(self) -> None:
        """Make all pending calls now."""
        while self._pending:
            self._call_next()

    def _call_next(self) -> None:
        if self._pending:  # else they were flushed, or dropped
            call_guarded(self._pending.popleft())


def call_guarded(callback: Callable[[], object]) -> None:
    """Call an observer; its exception is only logged."""
    try:
        callback()
    except Exception:
        _logger.exception("observer failed")
