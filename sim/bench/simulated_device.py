"""A simulated amplifier of protocol 2 on any wire: requests in, replies out, with faults."""

from collections.abc import Callable
from typing import cast

from drivers import clock
from drivers.protocol.messages import (
    AmplifierEvent,
    Broadcast,
    Capabilities,
    Fault,
    Feature,
    Identity,
    Nak,
    NakCode,
    Reply,
    Request,
    SetAddress,
    Status,
)
from sim.bench.bench import Bench
from sim.bench.faulted_device import FaultedDevice
from sim.faults.fault_window import Faults


class SimulatedDevice(FaultedDevice):
    """An amplifier of a bench by name; address: on its wire, from 1.

    time: of a request that arrives [s]; replaced by a wire on which several receive one frame.
    """

    def __init__(
        self, bench: Bench, name: str, *, address: int = 1, faults: Faults | None = None
    ) -> None:
        super().__init__(bench, name, address=address, faults=faults)
        self.time = clock.now

    @property
    def identity(self) -> Identity:
        """Its identity."""
        return cast(Identity, self._amplifier.identity)

    @property
    def capabilities(self) -> Capabilities:
        """Its capabilities."""
        return cast(Capabilities, self._amplifier.capabilities)

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Register a callback for changes of state or fault."""
        self._amplifier.listeners.append(lambda event, _: on_event(event))

    def status(self) -> Status:
        """Its present status."""
        self._bench.advance(clock.now())
        return cast(Status, self._amplifier.status(self._bench.time))

    def exchange(self, request: Request) -> Reply | None:
        """The reply to a request that arrives now; None for no reply."""
        now = self.time()
        if not self.is_answering:
            return None
        if self.faults.now("nak_storm", now):
            return Nak(NakCode.BUSY)
        if isinstance(request, SetAddress):
            if Feature.ADDRESS not in self.capabilities.features:
                return Nak(NakCode.UNKNOWN_TYPE)
            if request.serial_number != self.identity.serial_number:
                return None  # it is for another amplifier of this address
        return cast(Reply, self._bench.exchange(self.name, request, now=now))

    def broadcast(self, request: Broadcast) -> Reply | None:
        """Execute a broadcast; what it would reply."""
        if Feature.BROADCAST in self.capabilities.features:
            return self.exchange(request)
        return None

    def restart(self) -> None:
        """Power-cycle it."""
        now = clock.now()
        self._bench.advance(now)
        self._amplifier.restart(now)
        self._bench.advance(now)

    def _fault_of(self, kind: str) -> Fault:
        return Fault[kind.upper()]
