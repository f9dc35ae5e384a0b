"""Conformance checks of an amplifier on a line in memory, in virtual time.

The amplifier is simulated, or the far end of a line that a test makes: firmware or an example.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import TypeAlias

from era_haptics.lab.conformance.conformance_report import CheckResult
from era_haptics.lab.conformance.connection import CLIENTS as BY_PROTOCOL
from era_haptics.lab.conformance.contract import CHECKS, of_kind
from era_haptics.lab.conformance.session import DEFAULT_LEVEL, CheckSession
from kit.clock import KINDS, FarEnd, VirtualLoop
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers

PROTOCOLS = {"serial": "serial", "rtu": "Modbus RTU", "tcp": "Modbus TCP", "can": "CAN"}
JUDGED_LINE_KINDS = tuple(PROTOCOLS)
CLIENTS = {kind: BY_PROTOCOL[protocol] for kind, protocol in PROTOCOLS.items()}
"""Clients of the kinds of wires."""
DELAY = 0.0002  # s; of bytes on their way
_APART = 1e-9  # s; between what is sent at once
_TURN = 0.0005  # s; between looks at what is due

Judged: TypeAlias = SimulatedAmplifier | Callable[[Callable[[bytes], None]], FarEnd]
"""A simulated amplifier, or what makes the far end of a wire of the function that it sends by."""


class JudgedLine:
    """A line to an amplifier at address 1 and its neighbors; its client writes to it."""

    def __init__(
        self, kind: str, far: Judged, neighbors: Mapping[int, SimulatedAmplifier] | None = None
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.client = CLIENTS[kind](1)
        self.client.transmit = self.write
        self.due = self._arrival = 0.0
        self._ticked: list[SimulatedAmplifier | FarEnd] = []
        if isinstance(far, SimulatedAmplifier):
            known = {1: far, **(neighbors or {})}
            self._ticked += known.values()
            self._end = KINDS[kind].far_end(known, self.send)
        else:
            self._end = far(self.send)
        self._ticked.append(self._end)
        if isinstance(self._end, CanAmplifiers):
            self._end.start(self._loop.time())
        self._ticking = self._loop.create_task(self._tick())

    def write(self, data: bytes) -> None:
        """Send bytes to the amplifier."""
        self._arrival = max(self._loop.time() + DELAY, self._arrival + _APART)  # in their order
        self._loop.call_at(self._arrival, lambda: self._end.receive(data, self._loop.time()))

    def close(self) -> None:
        """End what is due by itself."""
        self._ticking.cancel()

    def send(self, data: bytes) -> None:
        """Send bytes of the amplifier to the client."""
        self.due = max(self._loop.time() + DELAY, self.due + _APART)  # in their order
        self._loop.call_at(self.due, self.client.received, data)

    async def _tick(self) -> None:
        """Let happen what is due by itself."""
        while True:
            for each in self._ticked:
                each.tick(self._loop.time())
            await asyncio.sleep(_TURN)


def plain() -> SimulatedAmplifier:
    """An amplifier with all that the table allows."""
    return SimulatedAmplifier("plain", channels=4)


def varied(channels: int = 4) -> SimulatedAmplifier:
    """An amplifier whose channels and ranges differ, from those of the table too."""
    far = SimulatedAmplifier("varied", channels=channels)
    far.capabilities.update(ramp_max=800, watchdog_min=150, watchdog_max=1500, set_words=600)
    far.capabilities.update(envelope_step_min=20, envelope_step_max=800, knots=30, layers=6)
    far.capabilities["limits"][1].update(frequency_min=300, frequency_max=8000, level_max=9000)
    far.capabilities["limits"][2].update(level_max=9500)
    return far


_OF_EVERY_WIRE = {
    *("achieved", "addresses", "broadcasts", "damaged_frames", "doubled_frames", "identity"),
    *("lengths", "max_set", "parts_of_sets", "parts_that_are_dropped", "sessions"),
}


def short_checks(kind: str) -> list[str]:
    """Checks that `make test` makes on a kind of line, by name: all on a serial line.

    On another one it makes those that a serial line lacks, and some that each wire carries in a way
    of its own.
    """
    names, serial = ([check.name for _, check in of_kind(each)] for each in (kind, "serial"))
    if kind == "serial":
        return names
    return [name for name in names if name not in serial or name in _OF_EVERY_WIRE]


def judged(
    kind: str,
    names: Sequence[str] = (),
    *,
    level: float = DEFAULT_LEVEL,
    far: Judged | None = None,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    neighbors: Mapping[int, SimulatedAmplifier] | None = None,
) -> list[CheckResult]:
    """Results of checks by name, all without names, in virtual time.

    far: the amplifier, a `varied` one if none is given.
    """
    unknown = set(names) - {check.name for check in CHECKS}
    assert not unknown, unknown
    checks = [
        (number, check) for number, check in of_kind(kind) if not names or check.name in names
    ]

    async def connected() -> JudgedLine:
        return JudgedLine(kind, far or varied(), neighbors)

    with (
        asyncio.Runner(loop_factory=VirtualLoop) as runner,
        closing(runner.run(connected())) as line,
    ):
        session = CheckSession(checks, line.client, runner.run, level=level, on_result=on_result)
        session.run()
        return session.results
