"""A simulated amplifier with a clock of its own, for far ends without an event loop."""

from drivers.protocol.messages import (
    AmplifierState,
    Arm,
    Clear,
    Disarm,
    Identity,
    Reply,
    Request,
    Status,
)
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.faults.fault_window import Faults
from sim.waveform import ShapedTone

SESSION = 9


class FakeDevice:
    """An amplifier whose time passes by `pass_time`; `asked`: recent requests."""

    is_answering = True

    def __init__(self) -> None:
        self.amplifier = SimulatedAmplifier("main", channels=4)
        self.capabilities = self.amplifier.capabilities
        self.faults = Faults()
        self.now = 100.0  # s; any
        self.asked: list[Request] = []

    @property
    def identity(self) -> Identity:
        return self.amplifier.identity

    def listen(self, on_event: object) -> None:
        assert callable(on_event)
        self.amplifier.listeners.append(lambda event, _: on_event(event))

    def exchange(self, request: Request) -> Reply:
        self.asked.append(request)
        return self.amplifier.handle(request, self.now)

    broadcast = exchange

    def status(self) -> Status:
        return self.amplifier.status(self.now)

    def restart(self) -> None:
        self.amplifier.restart(self.now)

    def revive(self) -> None:
        """Arm it as SESSION, whatever it was before; another session comes first, as that ends."""
        for session in (SESSION + 1, SESSION):
            for request in (Clear(self.amplifier.latch), Disarm(0.0), Arm(2.0, session)):
                self.exchange(request)

    def pass_time(self, duration: float) -> None:
        """Let time [s] pass; AssertionError if an output is out of range, or plays disarmed."""
        self.now += duration
        self.amplifier.tick(self.now)
        can = self.capabilities
        assert all(0 <= level <= can.level_max + 1e-9 for level in self.status().levels)
        is_armed = self.amplifier.state is AmplifierState.OPERATION_ENABLED
        for tone in (tone for output in self.amplifier.outputs for tone in output):
            assert can.frequency_min <= tone.frequency <= can.frequency_max
            assert isinstance(tone, ShapedTone) or abs(tone.full) <= can.level_max + 1e-9
            assert is_armed or (not tone.is_lasting and tone.silent_from <= self.now + can.ramp_max)
