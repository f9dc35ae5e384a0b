"""What a bench needs of a simulated amplifier, of whichever version of the protocol."""

from collections.abc import Callable
from typing import Any, Protocol

from sim.amplifier.summary import AmplifierSummary
from sim.bench.sensing import Sensing
from sim.waveform import Output


class BenchAmplifier(Protocol):
    """An amplifier whose channels drive ERAs; times [s] of any one clock.

    Requests, replies, events, states and faults are those of its protocol.
    """

    identity: Any
    capabilities: Any
    state: Any
    fault: Any
    listeners: list[Callable[[Any, float], None]]

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The output of each channel from now on, without further events."""

    @property
    def next_event(self) -> float:
        """Time of the next event [s], up to which `outputs` holds."""

    @property
    def is_derated(self) -> bool:
        """Whether its levels are reduced, until a tick finds it cool again."""

    @property
    def token(self) -> int:
        """Token of the set since arming from whose commit t counts; 0: none."""

    @property
    def committed_at(self) -> float:
        """Time of that commit [s]."""

    @property
    def handle(self) -> Callable[..., Any]:
        """Called with a request and the time [s]; returns the reply."""

    def status(self, now: float) -> Any:
        """Status at a time [s] up to which it has been ticked."""

    def summary(self, now: float) -> AmplifierSummary:
        """What it does at such a time; reports nothing."""

    def tick(self, now: float) -> None:
        """Process the events due by now, in order."""

    def attach(self, sensing: Sensing) -> None:
        """Give it sensors."""

    def trip(self, fault: Any, moment: float) -> None:
        """Enter a fault."""

    def set_interlock(self, moment: float, *, is_open: bool) -> None:
        """Open or close the interlock, with its consequences."""

    def set_temperature(self, temperature: float, moment: float) -> None:
        """Set the temperature [°C], with its consequences."""

    def restart(self, moment: float) -> None:
        """Power-cycle."""


class AmplifierMaker(Protocol):
    """A kind of amplifier."""

    def __call__(self, name: str, *, channels: int, is_output: bool) -> BenchAmplifier:
        """Make one; is_output: full level is an output, else the stroke of a motion."""
