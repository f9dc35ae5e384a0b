"""Call observers after the work that they observe, and guard that work against their errors."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable

_DELAY = 0.001  # s; the actions of a transition have begun by then
_MAX_PENDING = 256

_logger = logging.getLogger(__name__)


class DeferredCalls:
    """Calls callbacks in order, one per iteration of the event loop.

    An exception in a callback is logged and does not affect others. Above 256 pending calls, the
    oldest are dropped.
    """

    def __init__(self) -> None:
        self._pending: deque[Callable[[], object]] = deque(maxlen=_MAX_PENDING)
        self._handle: asyncio.Handle | None = None

    def add(self, callback: Callable[[], object]) -> None:
        """Call back a moment later; never raises."""
        self._pending.append(callback)
        if self._handle is None:
            call_guarded(self._schedule)

    def flush(self) -> None:
        """Make all pending calls now."""
        while self._pending:
            call_guarded(self._pending.popleft())
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _schedule(self) -> None:
        self._handle = asyncio.get_running_loop().call_later(_DELAY, self._call_next)

    def _call_next(self) -> None:
        callback = self._pending.popleft()
        self._handle = None
        if self._pending:
            self._handle = asyncio.get_running_loop().call_soon(self._call_next)
        call_guarded(callback)


def call_guarded(callback: Callable[[], object]) -> None:
    """Call an observer; log its exception instead of raising it."""
    try:
        callback()
    except Exception:
        _logger.exception("observer failed")
