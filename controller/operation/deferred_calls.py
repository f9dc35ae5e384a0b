"""Calls of observers, apart from what they observe."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable

_DELAY = 0.001  # s; the actions of a transition have begun by then
_MAX_PENDING = 256

_logger = logging.getLogger(__name__)


class DeferredCalls:
    """Calls callbacks a moment later, one per iteration of the event loop, in order.

    An exception of one is logged and affects no other. Of more pending calls than a bound the
    oldest are dropped.
    """

    def __init__(self) -> None:
        self._pending: deque[Callable[[], object]] = deque(maxlen=_MAX_PENDING)
        self._handle: asyncio.Handle | None = None

    def add(self, callback: Callable[[], object]) -> None:
        """Call back a moment later."""
        self._pending.append(callback)
        if self._handle is None:
            self._handle = asyncio.get_running_loop().call_later(_DELAY, self._call_next)

    def flush(self) -> None:
        """Make all pending calls now."""
        while self._pending:
            call_guarded(self._pending.popleft())
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _call_next(self) -> None:
        callback, self._handle = self._pending.popleft(), None
        if self._pending:
            self._handle = asyncio.get_running_loop().call_soon(self._call_next)
        call_guarded(callback)


def call_guarded(callback: Callable[[], object]) -> None:
    """Call an observer; its exception is only logged."""
    try:
        callback()
    except Exception:
        _logger.exception("observer failed")
