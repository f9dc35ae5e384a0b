"""A simulated amplifier on any wire: requests in, replies out, with injected faults."""

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, TypeAlias

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
from sim.amplifier.thermal_model import AMBIENT, DERATE_ABOVE, FAULT_ABOVE
from sim.bench.bench import Bench
from sim.faults.fault_window import Faults, FaultWindow

_FAULTS = {
    "over_voltage": Fault.OVER_VOLTAGE,
    "arc": Fault.ARC,
    "over_current": Fault.OVER_CURRENT,
    "channel": Fault.CHANNEL,
}


class SimulatedDevice:
    """An amplifier of a bench by name; address: on its wire, from 1.

    Its time is that of the running event loop. time: of a request that arrives [s]; replaced by a
    wire on which several receive one frame.
    """

    def __init__(
        self, bench: Bench, name: str, *, address: int = 1, faults: Faults | None = None
    ) -> None:
        self.name = name
        self.address = address
        self.time = clock.now
        self.faults = Faults() if faults is None else faults
        self._bench = bench
        self._amplifier = bench.amplifiers[name]
        self._on_plug: list[Callable[[bool], None]] = []
        self._unplugged = 0  # active unplug faults
        self._timers: list[asyncio.TimerHandle] = []

    @property
    def identity(self) -> Identity:
        """Its identity."""
        return self._amplifier.identity

    @property
    def capabilities(self) -> Capabilities:
        """Its capabilities."""
        return self._amplifier.capabilities

    @property
    def is_answering(self) -> bool:
        """Whether it replies at all: neither hung nor without supply."""
        now = clock.now()
        return not (self.faults.now("hang", now) or self.faults.now("reboot", now))

    def on_plug(self, on_plug: Callable[[bool], None]) -> None:
        """Register a callback for the wire unplugged (False) and plugged in again (True)."""
        self._on_plug.append(on_plug)

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Register a callback for changes of state or fault."""
        self._amplifier.listeners.append(lambda event, _: on_event(event))

    def status(self) -> Status:
        """Its present status."""
        self._bench.advance(clock.now())
        return self._amplifier.status(self._bench.time)

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
        return self._bench.exchange(self.name, request, now=now)

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

    def start(self) -> None:
        """Schedule the fault windows, in the running event loop."""
        for window in self.faults.windows:
            self._schedule(window)

    def inject_fault(self, window: FaultWindow) -> None:
        """Add a fault that begins now, whatever its `at`."""
        now = clock.now()
        window = replace(window, at=now - self.faults.begin)
        self.faults.windows = (*self.faults.windows, window)
        self._schedule(window)

    def recover(self) -> None:
        """End all active faults, and cancel the scheduled ones."""
        self.close()
        over = clock.now() - self.faults.begin
        for window in self.faults.windows:
            if window.at <= over < window.end:
                self._handle_edge(replace(window, lasts=over - window.at), "end")
        self.faults.windows = ()

    def close(self) -> None:
        """Cancel the scheduled faults."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()

    def _schedule(self, window: FaultWindow) -> None:
        """Schedule the start, middle and end of a fault window."""
        begin = self.faults.begin + window.at - clock.now()
        edges: dict[_Edge, float] = {
            "begin": begin,
            "half": begin + window.lasts / 2,
            "end": begin + window.lasts,
        }
        loop = asyncio.get_running_loop()
        for edge, delay in edges.items():
            if edge == "begin" and delay <= 0:
                self._handle_edge(window, edge)
            elif delay < math.inf:
                self._timers.append(loop.call_later(delay, self._handle_edge, window, edge))

    def _handle_edge(self, window: FaultWindow, edge: "_Edge") -> None:
        """Apply an edge (begin, half, end) of a fault window."""
        now = clock.now()
        self._bench.advance(now)
        match window.fault, edge:
            case "unplug", "begin":
                self._unplugged += 1
                if self._unplugged == 1:
                    self._plug(is_plugged=False)
            case "unplug", "end":
                self._unplugged -= 1
                if self._unplugged == 0:
                    self._plug(is_plugged=True)
            case "reboot", "begin":
                self._amplifier.restart(now)
            case ("over_voltage" | "arc" | "over_current" | "channel") as fault, "begin":
                self._amplifier.trip(_FAULTS[fault], now)
            case "interlock", "begin" | "end":
                self._amplifier.set_interlock(now, is_open=edge == "begin")
            case "over_temperature", _:
                self._amplifier.set_temperature(_TEMPERATURES[edge], now)
        self._bench.advance(now)

    def _plug(self, *, is_plugged: bool) -> None:
        for on_plug in self._on_plug:
            on_plug(is_plugged)


_Edge: TypeAlias = Literal["begin", "half", "end"]
_TEMPERATURES: dict[_Edge, float] = {
    "begin": DERATE_ABOVE + 1,
    "half": FAULT_ABOVE + 1,
    "end": AMBIENT,
}
