"""Admission of clients to the API server, with connections in reserve for methods that silence.

However many clients there are, another one can connect and `stop`. A client that has sent nothing
yet is evicted first, then an idle subscriber, then any idle client; never one that holds the arming
lease or waits for a response. The reserve is shared among processes: a client of the one with the
most there is evicted, silent ones first, but none whose first bytes have arrived unread.
"""

from collections import Counter
from collections.abc import Callable

from controller.api.connection import Connection

MAX_CONNECTIONS = 32  # for all methods
RESERVE = 8  # further ones, for the methods in reserve alone
IDLE_TIMEOUT = 1.0  # s; without a request, after which a client may be evicted
SILENT_TIMEOUT = 0.1  # s; the same for one that has sent nothing yet


class Admission:
    """The connected clients; holds_lease, is_subscribed: whether a client does or is."""

    def __init__(
        self,
        *,
        holds_lease: Callable[[Connection], bool],
        is_subscribed: Callable[[Connection], bool],
        clock: Callable[[], float],
    ) -> None:
        self.admitted: set[Connection] = set()
        self._holds_lease = holds_lease
        self._is_subscribed = is_subscribed
        self._clock = clock

    def admit(self, new: Connection) -> None:
        """Admit a new client, if necessary in place of another, or close it."""
        new.is_reserve = not self._has_room()
        if new.is_reserve:
            reserve = [each for each in self.admitted if each.is_reserve]
            if len(reserve) >= RESERVE:
                evicted = _evictable(reserve, new)
                if evicted is None:
                    new.abort()
                    return
                self._drop(evicted)
        self.admitted.add(new)

    def promote(self, one: Connection) -> bool:
        """Whether a client is now served all methods."""
        if one.is_reserve and self._has_room():
            one.is_reserve = False
        return not one.is_reserve

    def _has_room(self) -> bool:
        full = [each for each in self.admitted if not each.is_reserve]
        if len(full) < MAX_CONNECTIONS:
            return True
        candidates = [each for each in full if not each.pending and not self._holds_lease(each)]
        now, timeout = self._clock(), SILENT_TIMEOUT
        idle = [each for each in candidates if not each.has_spoken]
        if not idle:
            timeout = IDLE_TIMEOUT
            expired = [each for each in candidates if now - each.received_at >= timeout]
            idle = [each for each in expired if self._is_subscribed(each)] or expired
        evictable = min(idle, key=lambda each: each.received_at, default=None)
        if evictable is None or now - evictable.received_at < timeout:
            return False
        self._drop(evictable)
        return True

    def _drop(self, one: Connection) -> None:
        self.admitted.discard(one)
        one.abort()


def _evictable(reserve: list[Connection], new: Connection) -> Connection | None:
    """The client in reserve that a new one replaces, or None.

    Of its own process, or of one with more clients there.
    """
    counts = Counter(each.process for each in reserve)
    candidates = [
        each
        for each in reserve
        if not each.pending
        and (each.process == new.process or counts[each.process] > counts[new.process])
        and not each.is_unread
    ]
    return min(
        candidates,
        key=lambda each: (-counts[each.process], each.has_spoken, each.received_at),
        default=None,
    )
