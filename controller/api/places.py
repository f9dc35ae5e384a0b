"""Places of clients at the API server: some for all methods, and some in reserve to silence.

However many clients there are, `stop` finds a place. A client that has sent nothing yet is evicted
first, then an idle subscriber, then any idle client; one that holds the arming lease, or waits for
a response, never is. Among reserved places, a silent client is evicted first.
"""

from collections.abc import Callable

from controller.api.connection import Connection

MAX_CONNECTIONS = 32  # places for all methods
RESERVE = 8  # places for RESERVE_METHODS alone
RESERVE_METHODS = frozenset({"hello", "status", "stop", "disarm"})
IDLE_TIMEOUT = 1.0  # s; without a request, after which a client may be evicted
SILENT_TIMEOUT = 0.1  # s; the same for one that has sent nothing yet


class Places:
    """The connected clients; is_kept: holds the lease; is_subscribed: has subscriptions."""

    def __init__(
        self,
        *,
        is_kept: Callable[[Connection], bool],
        is_subscribed: Callable[[Connection], bool],
        clock: Callable[[], float],
    ) -> None:
        self.taken: set[Connection] = set()
        self._is_kept = is_kept
        self._is_subscribed = is_subscribed
        self._clock = clock

    def take(self, new: Connection) -> None:
        """Give a new client a place, if necessary another one's, or close it if there is none."""
        new.is_reserve = not self._has_full_place()
        if new.is_reserve:
            reserve = [each for each in self.taken if each.is_reserve]
            waiting = [each for each in reserve if not each.pending]
            if len(reserve) >= RESERVE and not waiting:
                new.abort()
                return
            if len(reserve) >= RESERVE:
                self._drop(min(waiting, key=lambda each: (each.has_spoken, each.received_at)))
        self.taken.add(new)

    def promote(self, one: Connection) -> bool:
        """Whether a client now has a place for all methods."""
        if one.is_reserve and self._has_full_place():
            one.is_reserve = False
        return not one.is_reserve

    def _has_full_place(self) -> bool:
        full = [each for each in self.taken if not each.is_reserve]
        if len(full) < MAX_CONNECTIONS:
            return True
        candidates = [each for each in full if not each.pending and not self._is_kept(each)]
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
        self.taken.discard(one)
        one.abort()
