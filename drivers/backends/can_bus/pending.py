"""Orders that are on a CAN bus, and which answer belongs to which."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from drivers.backends.hardware import number_below
from drivers.backends.waiting import reply_within
from drivers.codec.can_bus.replies import CanReply
from drivers.codec.can_bus.requests import SEQUENCE_MAX, PdoRequest, action_of
from drivers.errors import LinkError
from drivers.protocol.messages import Apply, Commit


@dataclass
class _Pending:
    """Who waits for the answer to an order, what it asked, and the token that it must name."""

    action: int
    token: int | None
    answer: asyncio.Future[CanReply]


class PendingRequests:
    """By their sequence numbers; an answer must also name the action and the token."""

    def __init__(self) -> None:
        # Not from the first, so that an answer to an earlier run is no answer to this one.
        self._sequence = number_below(SEQUENCE_MAX)
        self._pending: dict[int, _Pending] = {}

    def next_sequence(self) -> int:
        """The number of the next order: 1..255, then from 1 again."""
        self._sequence = self._sequence % SEQUENCE_MAX + 1
        return self._sequence

    async def answer_to(
        self, order: PdoRequest, *, sequence: int, send: Callable[[], None], timeout: float
    ) -> CanReply:
        """Send an order under its number and wait so long [s]; LinkError, TimeoutError."""
        token = None
        if isinstance(order, Apply):
            token = order.command_set.token
        elif isinstance(order, Commit):
            token = order.token
        answer: asyncio.Future[CanReply] = asyncio.get_running_loop().create_future()
        self._pending[sequence] = pending = _Pending(action_of(order), token, answer)
        try:
            send()
            return await reply_within(answer, timeout)
        finally:
            if self._pending.get(sequence) is pending:
                del self._pending[sequence]

    def take(self, answer: CanReply) -> bool:
        """Whether somebody waited for this answer; it is handed over then."""
        pending = self._pending.get(answer.sequence)
        if pending is None or pending.answer.done() or pending.action != answer.action:
            return False
        if answer.refusal is None and pending.token not in (None, answer.token):
            return False
        pending.answer.set_result(answer)
        return True

    def fail(self, what: str) -> None:
        """Nothing is answered any more."""
        for pending in self._pending.values():
            if not pending.answer.done():
                pending.answer.set_exception(LinkError(what))
