"""Pending requests on a CAN bus, and the matching of their replies."""

import asyncio
from dataclasses import dataclass

from drivers.backends.waiting import ReplyTimer
from drivers.codec.can_bus.replies import CanReply
from drivers.codec.can_bus.requests import SEQUENCE_MAX, PdoRequest, action_of
from drivers.errors import LinkError
from drivers.hardware import number_below
from drivers.protocol.messages import Apply, Commit


@dataclass
class _Pending:
    """Future reply to a request, with the action and token that it must carry."""

    action: int
    token: int | None
    can_reply: asyncio.Future[CanReply]


class PendingRequests:
    """Pending requests by sequence number; action and token of a reply must match too."""

    def __init__(self) -> None:
        # A random start, so that a reply to an earlier run does not match.
        self._sequence = number_below(SEQUENCE_MAX)
        self._pending: dict[int, _Pending] = {}
        self._timer = ReplyTimer()

    def next_sequence(self) -> int:
        """Return the next sequence number: 1..255, then 1 again."""
        self._sequence = self._sequence % SEQUENCE_MAX + 1
        return self._sequence

    async def reply_to(self, request: PdoRequest, *, sequence: int, timeout: float) -> CanReply:
        """Wait for the reply to a request that was just sent; LinkError, TimeoutError."""
        token = None
        if isinstance(request, Apply):
            token = request.command_set.token
        elif isinstance(request, Commit):
            token = request.token
        can_reply: asyncio.Future[CanReply] = asyncio.get_running_loop().create_future()
        self._pending[sequence] = pending = _Pending(action_of(request), token, can_reply)
        try:
            return await self._timer.wait(can_reply, timeout)
        finally:
            if self._pending.get(sequence) is pending:
                del self._pending[sequence]

    def resolve(self, can_reply: CanReply) -> bool:
        """Deliver a reply; returns whether a request was waiting for it."""
        pending = self._pending.get(can_reply.sequence)
        if pending is None or pending.can_reply.done() or pending.action != can_reply.action:
            return False
        if can_reply.refusal is None and pending.token not in (None, can_reply.token):
            return False
        pending.can_reply.set_result(can_reply)
        return True

    def fail(self, cause: str) -> None:
        """Fail all pending requests."""
        for pending in self._pending.values():
            if not pending.can_reply.done():
                pending.can_reply.set_exception(LinkError(cause))
