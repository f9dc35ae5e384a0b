"""One simulated amplifier as every far end sees it: requests in, replies out, and its faults.

A far end turns the telegrams of its wire into requests; here is decided, for all wires alike,
whether the amplifier answers at all.
"""

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
    Identity,
    Nak,
    NakCode,
    Reply,
    Request,
    Status,
)
from sim.amplifier.heat import AMBIENT, DERATE_ABOVE, FAULT_ABOVE
from sim.bench.bench import Bench
from sim.faults.fault_window import Faults, FaultWindow

_FAILS = {
    "over_voltage": Fault.OVER_VOLTAGE,
    "arc": Fault.ARC,
    "channel": Fault.CHANNEL,
}


class SimulatedDevice:
    """An amplifier of a bench by its name; number: its address on a wire, 1 or more.

    Simulated time is the event loop's, by default time.monotonic(), the same in all processes of a
    machine.
    """

    def __init__(
        self, bench: Bench, name: str, *, number: int = 1, faults: Faults | None = None
    ) -> None:
        self.name = name
        self.number = number
        self.faults = Faults() if faults is None else faults
        self._bench = bench
        self._amplifier = bench.amplifiers[name]
        self._on_plug: list[Callable[[bool], None]] = []
        self._pulled_out = 0  # how many faults hold the wire out now
        self._expected: list[asyncio.TimerHandle] = []

    @property
    def identity(self) -> Identity:
        """Who it is."""
        return self._amplifier.identity

    @property
    def capabilities(self) -> Capabilities:
        """What it can play."""
        return self._amplifier.capabilities

    @property
    def is_answering(self) -> bool:
        """Whether it does anything at all now: a far end keeps still as long as it does not."""
        now = clock.now()
        return not (self.faults.now("hang", now) or self.faults.now("reboot", now))

    def on_plug(self, on_plug: Callable[[bool], None]) -> None:
        """Be told False when the wire is pulled out and True when it is back."""
        self._on_plug.append(on_plug)

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Be told when state or fault changes."""
        self._amplifier.listeners.append(lambda event, _: on_event(event))

    def status(self) -> Status:
        """How it is now; for what a wire sends by itself."""
        self._bench.advance(clock.now())
        return self._amplifier.status(self._bench.time)

    def exchange(self, request: Request) -> Reply | None:
        """Its answer to a request that arrives now; None if it keeps still."""
        now = clock.now()
        if not self.is_answering:
            return None
        if self.faults.now("nak_storm", now):
            return Nak(NakCode.BUSY)
        return self._bench.exchange(self.name, request, now=now)

    def broadcast(self, request: Broadcast) -> None:
        """Carry out what was said to all; nobody hears the answer."""
        self.exchange(request)

    def restart(self) -> None:
        """Lose the supply for a moment, as when it is told to start anew."""
        now = clock.now()
        self._bench.advance(now)
        self._amplifier.restart(now)
        self._bench.advance(now)

    def start(self) -> None:
        """Let the faults that are due later come, in the running event loop."""
        for window in self.faults.windows:
            self._expect(window)

    def inject_fault(self, window: FaultWindow) -> None:
        """One more fault, from now on: its `at` is not looked at."""
        now = clock.now()
        window = replace(window, at=now - self.faults.begin)
        self.faults.windows = (*self.faults.windows, window)
        self._expect(window)

    def recover(self) -> None:
        """Every fault that is on ends now, and none comes any more."""
        self.close()
        over = clock.now() - self.faults.begin
        for window in self.faults.windows:
            if window.at <= over < window.end:
                self._pass(replace(window, lasts=over - window.at), "end")
        self.faults.windows = ()

    def close(self) -> None:
        """No more faults come."""
        for timer in self._expected:
            timer.cancel()
        self._expected.clear()

    def _expect(self, window: FaultWindow) -> None:
        """Bring about, when they are due, those faults that nobody needs to ask for."""
        begin = self.faults.begin + window.at - clock.now()
        edges: dict[_Edge, float] = {
            "begin": begin,
            "half": begin + window.lasts / 2,
            "end": begin + window.lasts,
        }
        loop = asyncio.get_running_loop()
        for edge, delay in edges.items():
            if edge == "begin" and delay <= 0:
                self._pass(window, edge)
            elif delay < math.inf:
                self._expected.append(loop.call_later(delay, self._pass, window, edge))

    def _pass(self, window: FaultWindow, edge: "_Edge") -> None:
        """An window begins, is half over or ends."""
        now = clock.now()
        self._bench.advance(now)
        match window.fault, edge:
            case "unplug", "begin":
                self._pulled_out += 1
                if self._pulled_out == 1:
                    self._plug(is_plugged=False)
            case "unplug", "end":
                self._pulled_out -= 1
                if self._pulled_out == 0:
                    self._plug(is_plugged=True)
            case "reboot", "begin":
                self._amplifier.restart(now)
            case ("over_voltage" | "arc" | "channel") as fault, "begin":
                self._amplifier.trip(_FAILS[fault], now)
            case "over_temperature", _:
                self._amplifier.set_temperature(_WARMTH[edge], now)
        self._bench.advance(now)

    def _plug(self, *, is_plugged: bool) -> None:
        for on_plug in self._on_plug:
            on_plug(is_plugged)


_Edge: TypeAlias = Literal["begin", "half", "end"]
_WARMTH: dict[_Edge, float] = {"begin": DERATE_ABOVE + 1, "half": FAULT_ABOVE + 1, "end": AMBIENT}
