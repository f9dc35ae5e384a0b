"""Bus arbitration between amplifiers that share a half-duplex line.

Each amplifier arbitrates its own requests in `drivers.link`. A stop-class request for one amplifier
outranks the requests of all others, which are retried after preemption.
"""

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar, final

from drivers.link.turns import SUPERSEDED, Preempted, RequestPriority, Turns
from drivers.protocol.messages import Apply, Disarm, Request, Stop

_T = TypeVar("_T")


def priority_on_line(request: Request) -> RequestPriority:
    """Return the priority of a request among amplifiers; sets of different ones never supersede."""
    if isinstance(request, Stop):
        return RequestPriority.STOP
    is_silent_set = isinstance(request, Apply) and request.command_set.is_silent
    return (
        RequestPriority.SILENCE
        if is_silent_set or isinstance(request, Disarm)
        else RequestPriority.ORDINARY
    )


@final
class LineTurns:
    """Arbitrates a line between amplifiers, identified by their addresses."""

    def __init__(self) -> None:
        self._turns = Turns(lambda: self._current in self._unsent)
        self._current: int | None = None
        self._unsent: set[int] = set()

    @property
    def is_in_use(self) -> bool:
        """Whether an exchange is on the line."""
        return self._turns.is_in_use

    def is_unsent(self, address: int) -> bool:
        """Whether an exchange of this amplifier is pending and nothing of it is on the wire yet."""
        return address in self._unsent

    def mark_sent(self) -> None:
        """Note that the current request is on the wire."""
        if self._current is not None:
            self._unsent.discard(self._current)

    @contextmanager
    def silencing(self, request: Request, address: int) -> Iterator[None]:
        """See `Backend.silencing`; the reservation also holds between retries of the request."""
        priority = priority_on_line(request)
        self._turns.reserve(address, priority)
        try:
            yield
        finally:
            self._turns.release_reservation(address, priority)

    async def carry_out(
        self,
        priority: RequestPriority,
        exchange: Callable[[], Awaitable[_T]],
        *,
        address: int | None,
    ) -> _T:
        """Run an exchange once it has access to the line. Retry after preemption.

        Retries are safe: a token is played once, and other requests are idempotent. address: of the
        amplifier, None for a broadcast. Raises Preempted before a start if a stop-class request of
        the same amplifier is pending: it waits for this call to end, so waiting would deadlock.
        """
        while True:
            if self._turns.has_own_reservation(address, priority):
                raise Preempted(SUPERSEDED)
            if address is not None:
                self._unsent.add(address)
            try:
                async with self._turns.take(priority):
                    self._current = address
                    return await exchange()
            except Preempted:
                continue
            finally:
                if address is not None:
                    self._unsent.discard(address)
