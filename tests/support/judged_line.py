"""An amplifier of protocol 4 in memory, on a virtual clock, and its conformance.

It is a simulated one, or any other far end of a wire: the firmware, an example.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from era_haptics.lab.conformance.check import run_checks
from era_haptics.lab.conformance.contract import CHECKS, LEVEL, CheckResult, of_kind
from era_haptics.lab.conformance.contract import CLIENTS as BY_PROTOCOL
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.can_amplifiers import CanAmplifiers
from virtual_loop import run_virtual
from words_line import KINDS as WIRES
from words_line import FarEnd

PROTOCOLS = {"serial": "serial", "rtu": "Modbus RTU", "tcp": "Modbus TCP", "can": "CAN"}
KINDS = tuple(PROTOCOLS)
CLIENTS = {kind: BY_PROTOCOL[protocol] for kind, protocol in PROTOCOLS.items()}
"""Clients of the kinds of wires."""
DELAY = 0.0002  # s; of bytes on their way
_MOMENT = 1e-9  # s; between what is sent at once
_TURN = 0.0005  # s; between looks at what is due

Judged: TypeAlias = Amplifier | Callable[[Callable[[bytes], None]], FarEnd]
"""A simulated amplifier, or what makes the far end of a wire of the function that it sends by."""


class JudgedLine:
    """A line to an amplifier at address 1 and its neighbours; its client writes to it."""

    def __init__(
        self, kind: str, far: Judged, neighbours: Mapping[int, Amplifier] | None = None
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.client = CLIENTS[kind](1)
        self.client.transmit = self.write
        self._due = self._arrival = 0.0
        self._ticked: list[Amplifier | FarEnd] = []
        if isinstance(far, Amplifier):
            known = {1: far, **(neighbours or {})}
            self._ticked += known.values()
            self._end = WIRES[kind].far_end(known, self._send)
        else:
            self._end = far(self._send)
        self._ticked.append(self._end)
        if isinstance(self._end, CanAmplifiers):
            self._end.start(self._loop.time())
        self._ticking = self._loop.create_task(self._tick())

    def write(self, data: bytes) -> None:
        """Send bytes to the amplifier."""
        self._arrival = max(self._loop.time() + DELAY, self._arrival + _MOMENT)  # in their order
        self._loop.call_at(self._arrival, lambda: self._end.receive(data, self._loop.time()))

    def close(self) -> None:
        """End what is due by itself."""
        self._ticking.cancel()

    def _send(self, data: bytes) -> None:
        self._due = max(self._loop.time() + DELAY, self._due + _MOMENT)  # in their order
        self._loop.call_at(self._due, self.client.received, data)

    async def _tick(self) -> None:
        """Let happen what is due by itself."""
        while True:
            for each in self._ticked:
                each.tick(self._loop.time())
            await asyncio.sleep(_TURN)


def plain() -> Amplifier:
    """An amplifier with all that the table allows."""
    return Amplifier("plain", channels=4)


def varied(channels: int = 4) -> Amplifier:
    """An amplifier whose channels and ranges differ, from those of the table too."""
    far = Amplifier("varied", channels=channels)
    far.capabilities.update(ramp_max=800, watchdog_min=150, watchdog_max=1500, set_words=600)
    far.capabilities.update(envelope_step_min=20, envelope_step_max=800, knots=30, layers=6)
    far.capabilities["limits"][1].update(frequency_min=300, frequency_max=8000, level_max=9000)
    far.capabilities["limits"][2].update(level_max=9500)
    return far


async def results_of(
    kind: str,
    far: Judged,
    names: Sequence[str] = (),
    *,
    level: float = LEVEL,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    neighbours: Mapping[int, Amplifier] | None = None,
) -> list[CheckResult]:
    """Results of checks by name, all without names, on an amplifier on a kind of wire."""
    line = JudgedLine(kind, far, neighbours)
    chosen = [each for each in of_kind(kind) if not names or each[1].name in names]
    try:
        return [*await run_checks(chosen, line.client, level=level, on_result=on_result)]
    finally:
        line.close()


def judged(
    kind: str,
    names: Sequence[str] = (),
    *,
    level: float = LEVEL,
    far: Judged | None = None,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    neighbours: Mapping[int, Amplifier] | None = None,
) -> list[CheckResult]:
    """Results on an amplifier, a `varied` one if none is given, in virtual time."""
    unknown = set(names) - {check.name for check in CHECKS}
    assert not unknown, unknown
    far = far or varied()
    return run_virtual(
        results_of(kind, far, names, level=level, on_result=on_result, neighbours=neighbours)
    )
