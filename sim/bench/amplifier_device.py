"""A simulated amplifier as its far ends serve it: on a bench, with faults."""

from collections.abc import Callable

from drivers.protocol.records import Refusal, Values
from sim.bench.faulted_device import FaultedDevice


class AmplifierDevice(FaultedDevice):
    """An amplifier of a bench by name, as `sim.amplifier.contract.AmplifierPort`.

    Requests advance the bench, and what they change moves its plate. In a storm of Naks it refuses
    all of them but Hello.
    """

    @property
    def identity(self) -> Values:
        """Values of its identity."""
        return self._amplifier.identity

    @property
    def capabilities(self) -> Values:
        """Values of its capabilities."""
        return self._amplifier.capabilities

    @property
    def state(self) -> str:
        """Name of its state."""
        return self._amplifier.state

    @property
    def fault(self) -> str:
        """Name of its fault."""
        return self._amplifier.fault

    @property
    def listeners(self) -> list[Callable[[Values, float], None]]:
        """Called with the values of every Event, and its time [s]."""
        return self._amplifier.listeners

    @property
    def next_event(self) -> float:
        """Time of its next event [s]."""
        return self._amplifier.next_event

    def tick(self, now: float) -> None:
        """Advance the bench to a time [s]."""
        self._bench.advance(now)

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Return the values of the reply to a request at a time [s]; raises Refusal."""
        if self.faults.now("nak_storm", now):
            raise Refusal("it refuses everything", "BUSY")
        return self._bench.exchange(self.name, name, values, now=now)

    def restart(self, moment: float) -> None:
        """Power-cycle it at a time [s]."""
        self._bench.advance(moment)
        self._amplifier.restart(moment)
        self._bench.advance(moment)
