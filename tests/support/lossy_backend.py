"""A backend over a simulated amplifier in this process that loses requests and replies."""

import asyncio
from collections.abc import Callable
from enum import Enum, auto

from drivers import clock
from drivers.backend import Backend
from drivers.errors import LinkError, LinkTimeout
from drivers.protocol.messages import Broadcast, Reply, Request
from sim.amplifier.amplifier import SimulatedAmplifier

DELAY = 0.002  # s; of a request on its way


class Fate(Enum):
    """What becomes of an exchange; CUT: the wire reports its loss."""

    DELIVERED = auto()
    REQUEST_LOST = auto()
    REPLY_LOST = auto()
    CUT = auto()


class LossyBackend(Backend):
    """Carries requests to a simulated amplifier; `fate` decides about each."""

    def __init__(self, amplifier: SimulatedAmplifier) -> None:
        self.amplifier = amplifier
        self.fate: Callable[[Request], Fate] = lambda request: Fate.DELIVERED
        self.sent: list[Request] = []
        self.is_open = False
        self._sent_at = 0.0

    async def open(self) -> None:
        self.is_open = True

    async def close(self) -> None:
        self.is_open = False

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Deliver a request after DELAY, unless its fate is another."""
        if not self.is_open:
            raise LinkError("the wire is closed")
        self.sent.append(request)
        self._sent_at = clock.now()
        fate = self.fate(request)
        if fate is Fate.CUT:
            raise LinkError("the wire is cut")
        if fate is Fate.REQUEST_LOST:
            await asyncio.sleep(timeout)
            raise LinkTimeout("no reply")
        # On its way it arrives even if the host gives up.
        arriving = asyncio.get_running_loop().create_future()
        asyncio.get_running_loop().call_later(DELAY, self._deliver, request, arriving)
        reply: Reply = await asyncio.shield(arriving)
        if fate is Fate.REPLY_LOST:
            await asyncio.sleep(timeout - DELAY)
            raise LinkTimeout("no reply")
        return reply

    def _deliver(self, request: Request, arriving: "asyncio.Future[Reply]") -> None:
        arriving.set_result(self.amplifier.handle(request, clock.now()))

    async def broadcast(self, request: Broadcast) -> None:
        await self.exchange(request, timeout=0.03)

    @property
    def last_sent_at(self) -> float:
        return self._sent_at
