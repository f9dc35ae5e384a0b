"""An amplifier of a bench, as served by far ends, with injected faults."""

import asyncio
import math
from collections.abc import Callable
from functools import partial
from typing import Literal, TypeAlias

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import is_last
from registry import threads
from sim.amplifier.thermal_state import AMBIENT, DERATE_ABOVE, FAULT_ABOVE
from sim.bench.bench import Bench
from sim.faults import Faults, FaultWindow

_Edge: TypeAlias = Literal["begin", "half", "end"]
_TEMPERATURES: dict[_Edge, float] = {
    "begin": DERATE_ABOVE + 1,
    "half": FAULT_ABOVE + 1,
    "end": AMBIENT,
}


class AmplifierDevice:
    """An amplifier of a bench on a wire, with its injected faults.

    It serves requests like a `SimulatedAmplifier`; they advance the bench and move its plate. The
    fault `nak_storm` rejects all requests except Hello. Faults happen by the time of the running
    event loop.

    address: on its wire, from 1. plug_listeners: called when the wire is unplugged (False) or
    plugged in again (True). boot_listeners: called when its supply is back. listeners: called with
    the values of every Event, and its time [s].
    """

    def __init__(
        self, bench: Bench, name: str, *, address: int = 1, faults: Faults | None = None
    ) -> None:
        self.name = name
        self.address = address
        self.faults = Faults() if faults is None else faults
        self._bench = bench
        self._amplifier = bench.amplifiers[name]
        self.identity = self._amplifier.identity
        self.listeners = self._amplifier.listeners
        self.plug_listeners: list[Callable[[bool], None]] = []
        self.boot_listeners: list[Callable[[], None]] = []
        self._unplugged = 0  # active unplug faults
        self._timers: list[asyncio.TimerHandle] = []

    @property
    def is_answering(self) -> bool:
        """Whether it replies at all: neither hung nor without supply."""
        now = threads.now()
        return not (self.faults.now("hang", now) or self.faults.now("reboot", now))

    @property
    def is_plugged(self) -> bool:
        """Whether its wire is plugged in."""
        return self._unplugged == 0

    @property
    def state(self) -> str:
        """Name of its state."""
        return self._amplifier.state

    @property
    def fault(self) -> str:
        """Name of its fault."""
        return self._amplifier.fault

    @property
    def next_event(self) -> float:
        """Time of its next event [s]."""
        return self._amplifier.next_event

    def tick(self, now: float) -> None:
        """Advance the bench to a time [s]."""
        self._bench.advance(now)

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Return the values of the reply to a request at a time [s], if any; raises Refusal."""
        has_reply = name != "Set" or is_last(values)
        if has_reply and self.faults.now("nak_storm", now):
            raise Refusal("it refuses everything", "BUSY")
        return self._bench.exchange(self.name, name, values, now=now)

    def withdraw_status(self) -> None:
        """Withdraw the last status, as after a broadcast."""
        self._amplifier.withdraw_status()

    def restart(self, moment: float) -> None:
        """Power-cycle it at a time [s]."""
        self._bench.change(moment, partial(self._amplifier.restart, moment))

    def start(self) -> None:
        """Schedule the fault windows, in the running event loop."""
        for window in self.faults.windows:
            self._schedule(window)

    def inject_fault(self, window: FaultWindow) -> None:
        """Add a fault that starts now, ignoring its `at`."""
        now = threads.now()
        window = window.model_copy(update={"at": now - self.faults.begin})
        self.faults.windows = (*self.faults.windows, window)
        self._schedule(window)

    def recover(self) -> None:
        """End all active faults, and cancel the scheduled ones."""
        self.close()
        over = threads.now() - self.faults.begin
        active = [window for window in self.faults.windows if window.at <= over < window.end]
        self.faults.windows = ()
        for window in active:
            self._handle_edge(window, "end")

    def close(self) -> None:
        """Cancel the scheduled faults."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()

    def _schedule(self, window: FaultWindow) -> None:
        """Schedule the start, middle and end of a fault window."""
        begin = self.faults.begin + window.at - threads.now()
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

    def _handle_edge(self, window: FaultWindow, edge: _Edge) -> None:
        """Apply an edge (begin, half, end) of a fault window now."""
        now = threads.now()
        self._bench.change(now, partial(self._apply_edge, window.fault, edge, now))

    def _apply_edge(self, fault: str, edge: _Edge, now: float) -> None:
        """Change the wire or the amplifier according to an edge of a fault at a time [s]."""
        match fault, edge:
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
            case "reboot", "end":
                for on_boot in self.boot_listeners:
                    on_boot()
            case (("over_voltage" | "arc" | "over_current" | "channel"), "begin"):
                self._amplifier.trip(fault.upper(), now)
            case "interlock", "begin" | "end":
                self._amplifier.set_interlock(now, is_open=edge == "begin")
            case "over_temperature", _:
                self._amplifier.set_temperature(_TEMPERATURES[edge], now)

    def _plug(self, *, is_plugged: bool) -> None:
        for on_plug in [*self.plug_listeners]:
            on_plug(is_plugged)
