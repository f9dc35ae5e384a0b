"""A CAN bus as it is at its worst for a host that relies on the order of its frames.

The host's adapter transmits what waits by priority and, of one identifier, the newest first, as
controllers with several mailboxes may. Another device sends a SYNC every 10 ms.
"""

import asyncio
import heapq
import itertools

from drivers.codec.can_bus.canopen import CanFrame
from sim.far_ends.can_bus.bus import BusNodes, CanBus, Listener

SYNC, PERIOD = CanFrame(0x080, b""), 0.01  # s


class MailboxBus(CanBus):
    """The bus; given, transmitted: the host's frames in the order in which they were."""

    def __init__(self, bitrate: int | None = None) -> None:
        assert bitrate is not None, "without transmission time no frame waits"
        super().__init__(bitrate)
        self.given: list[CanFrame] = []
        self.transmitted: list[CanFrame] = []
        self._waiting: list[tuple[int, int, CanFrame, Listener]] = []
        self._numbers = itertools.count()
        self._next: asyncio.TimerHandle | None = None
        self._foreign = asyncio.get_running_loop().call_later(PERIOD, self._sync)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        if isinstance(getattr(sender, "__self__", None), BusNodes) or frame is SYNC:
            super().send(frame, sender=sender)
            return
        self.given.append(frame)
        heapq.heappush(self._waiting, (frame.id, -next(self._numbers), frame, sender))
        if self._next is None:
            self._transmit()

    def close(self) -> None:
        super().close()
        self._foreign.cancel()
        if self._next is not None:
            self._next.cancel()

    def _transmit(self) -> None:
        self._next = None
        if self._waiting:
            _, _, frame, sender = heapq.heappop(self._waiting)
            self.transmitted.append(frame)
            super().send(frame, sender=sender)
            loop = asyncio.get_running_loop()
            self._next = loop.call_at(self._free_from, self._transmit)

    def _sync(self) -> None:
        self.send(SYNC, sender=lambda frame: None)
        self._foreign = asyncio.get_running_loop().call_later(PERIOD, self._sync)
