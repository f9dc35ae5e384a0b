"""Whose turn it is on a line that several amplifiers share, where only one may be asked at a time.

Each amplifier has turns of its own (`drivers.link`); these are between amplifiers. What silences
one of them goes before all that others wait for, and what was on the line meanwhile is sent again.
"""

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar, final

from drivers.link.turns import SUPERSEDED, Preempted, RequestPriority, Turns
from drivers.protocol.messages import Apply, Disarm, Request, Stop

_T = TypeVar("_T")


def kind_on_line(request: Request) -> RequestPriority:
    """How a request stands to those for others; no set takes the place of another's."""
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
    """The turns of a line; amplifiers are known by their addresses."""

    def __init__(self) -> None:
        self._turns = Turns(lambda: self._present in self._unsent)
        self._present: int | None = None
        self._unsent: set[int] = set()

    @property
    def is_taken(self) -> bool:
        """Whether an exchange is on the line."""
        return self._turns.is_taken

    def is_unsent(self, address: int) -> bool:
        """Whether an amplifier's exchange is here and nothing of it has gone out yet."""
        return address in self._unsent

    def sent(self) -> None:
        """What has the turn has gone out; to be called then."""
        if self._present is not None:
            self._unsent.discard(self._present)

    @contextmanager
    def silencing(self, request: Request, address: int) -> Iterator[None]:
        """See `Backend.silencing`; also between two attempts at what silences."""
        kind = kind_on_line(request)
        self._turns.keep_free(address, kind)
        try:
            yield
        finally:
            self._turns.release(address, kind)

    async def carry_out(
        self, kind: RequestPriority, exchange: Callable[[], Awaitable[_T]], *, address: int | None
    ) -> _T:
        """Do an exchange when it has its turn, and again where it had to give way.

        Repeating is safe: a token is played once, and the other requests may be repeated anyway.
        address: whose it is; None for one to all. Raises Preempted instead of beginning where this
        amplifier itself is being silenced: what silences it waits for this to end, so that this
        must not wait for the line.
        """
        while True:
            if self._turns.is_kept_from_own(address, kind):
                raise Preempted(SUPERSEDED)
            if address is not None:
                self._unsent.add(address)
            try:
                async with self._turns.take(kind):
                    self._present = address
                    return await exchange()
            except Preempted:
                continue
            finally:
                if address is not None:
                    self._unsent.discard(address)
