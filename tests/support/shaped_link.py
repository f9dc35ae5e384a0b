"""Envelopes that are straight lines, and an amplifier in virtual time that plays envelopes."""

import asyncio
import cmath
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from drivers.backend import Backend
from drivers.protocol.messages import Reply, Request
from drivers.protocol.wire_times import WireTimes
from model.table.pattern import Pattern
from model.table.question import Question
from model.transients.envelope import BaseEnvelope
from sim.amplifier.amplifier import SimulatedAmplifier
from stub_wire_times import StubWireTimes


class Shapes:
    """A timing whose envelopes are straight lines: up in 21 knots, down in 8."""

    levels = None

    def __init__(self) -> None:
        self.prepared: list[float] = []
        self.largest = 1.0

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Remember them."""
        self.prepared += frequencies

    def with_envelopes(
        self, question: Question, pattern: Pattern, *, onset: bool, ending: bool
    ) -> Pattern:
        """The lines, for the ERAs that play; the largest knot of an onset can be set."""
        up = [number / 21 * self.largest for number in range(1, 21)] + [1.0]
        down = [1 - number / 8 for number in range(1, 9)]
        return replace(
            pattern,
            onset=_along(pattern, 0.0, up) if onset else pattern.onset,
            ending=_along(pattern, 1.0, down) if ending else pattern.ending,
        )

    def with_transient_measures(self, question: Question, pattern: Pattern) -> Pattern:
        """30 dB with an onset, 10 without."""
        return replace(pattern, transient_contrast_db=30.0 if pattern.onset else 10.0)


def _along(pattern: Pattern, start: float, shares: Sequence[float]) -> dict[str, BaseEnvelope]:
    tones = {
        name: (tone.frequency, cmath.rect(tone.amplitude, tone.phase))
        for name, tone in pattern.excitation.items()
    }
    return {
        name: BaseEnvelope(frequency, start * full, tuple(share * full for share in shares))
        for name, (frequency, full) in tones.items()
    }


class Link(Backend):
    """A simulated amplifier on the loop's clock that plays envelopes.

    delay [s]: until a reply comes; loading [s]: what an envelope is said to take on the wire.
    """

    def __init__(self, channels: int = 2) -> None:
        self.amplifier = SimulatedAmplifier("any", channels=channels)
        self.asked: list[tuple[float, Request]] = []
        self.delay: Callable[[Request], float] = lambda request: 0.0
        self.loading = 0.0
        self._last_sent_at = 0.0

    async def open(self) -> None:
        """Always succeeds."""

    async def close(self) -> None:
        """Nothing is to be given back."""

    @property
    def last_sent_at(self) -> float:
        """On the loop's clock [s]."""
        return self._last_sent_at

    @property
    def wire_times(self) -> WireTimes:
        """As set."""
        return StubWireTimes(envelope_takes=self.loading)

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Obey at once, answer later."""
        self._last_sent_at = asyncio.get_running_loop().time()
        self.asked.append((self._last_sent_at, request))
        reply = self.amplifier.handle(request, self._last_sent_at)
        await asyncio.sleep(self.delay(request))
        return reply

    def levels(self) -> tuple[float, ...]:
        """Of every channel, now."""
        now = asyncio.get_running_loop().time()
        self.amplifier.tick(now)
        return self.amplifier.status(now).levels

    def requests(self, *kinds: type[Any]) -> list[Any]:
        """What was asked, of some kinds."""
        return [request for _, request in self.asked if isinstance(request, kinds)]
