"""A day of one amplifier on every kind of wire, of which the witness finds nothing."""

import asyncio
import contextlib
import random

import pytest

from drivers.contents import Layer, Shape, Tone
from drivers.errors import CommandRefused, Preempted
from drivers.host.group import Group
from drivers.host.jobs import Priority
from listened_line import ListenedLine, witness_of
from virtual_loop import run_virtual
from words_line import KINDS

SWELL = Shape(0.01, (0.1 + 0j, 0.3 + 0j, 0.1 + 0j))
SLOW = Shape(0.04, (0.05 + 0j,))


class Day:
    """An armed amplifier, which is fed as long as its loop runs."""

    def __init__(self, line: ListenedLine) -> None:
        self.line = line
        self.host = line.hosts["a"]
        self.group = Group(line.hosts, draw=random.Random(1).randint)
        self.is_stalled = False

    async def run(self) -> None:
        """Go through the day, sensed and fed."""
        await self.group.open()
        await self.group.arm()
        background = [asyncio.ensure_future(self.line.keep_sensing())]
        background.append(asyncio.ensure_future(self._keep_beating()))
        try:
            for part in (self.plays, self.stops, self.trips, self.stalls):
                await part()
        finally:
            for each in background:
                each.cancel()

    async def plays(self) -> None:
        """A tone is renewed, read back and ends by itself; another swells, anew and
        before what waits for its onset, and fades beside it."""
        tones = (Tone(0, 100.0, 0.5), Tone(1, 100.0, 0.3, 90.0))
        await self.apply(Layer(0, tones, 0.01, 0.3), rest=0.2)
        await self.apply(Layer(0, (), 0.01, 0.3, renew=True), rest=0.15)
        await self.host.request("GetAchieved", {"layer": 0}, Priority.OTHER)
        swelling = Tone(0, 150.0, 0.2, onset=SWELL, ending=SWELL)
        await self.apply(Layer(1, (swelling,), 0.005), rest=0.1)
        await self.apply(Layer(1, (Tone(0, 150.0, 0.2, onset=SLOW),), 0.005), rest=0.02)
        waiting = (Tone(0, 150.0, 0.2, ending=SWELL), Tone(1, 100.0, 0.3))
        await self.apply(Layer(1, waiting, 0.005, after=True), rest=0.2)
        await self.apply(Layer(1, (), 0.005), rest=0.2)

    async def stops(self) -> None:
        """It is silenced, disarmed and stopped amid a tone each, cleared and armed."""
        await self.apply(Layer(0, (Tone(0, 100.0, 0.5),), 0.01), rest=0.05)
        await self.group.silence(0.01)
        await asyncio.sleep(0.05)
        await self.apply(Layer(0, (Tone(0, 100.0, 0.5),), 0.01), rest=0.05)
        await self.group.disarm()
        await self.group.arm()
        await self.apply(Layer(0, (Tone(0, 100.0, 0.5),), 0.01), rest=0.05)
        await self.group.stop()
        await self.again()

    async def trips(self) -> None:
        """It has an arc amid a tone and is asked for its faults."""
        await self.apply(Layer(0, (Tone(0, 100.0, 0.5),), 0.01), rest=0.07)
        far = self.line.far["a"]
        far.tick(self.line.loop.time())
        far.trip("ARC", self.line.loop.time(), channel=0)
        await self.host.read_status()
        await asyncio.sleep(0.02)
        await self.host.read_status()
        await self.host.request("GetFaults", {}, Priority.OTHER)
        await self.group.stop()
        await self.again()

    async def stalls(self) -> None:
        """The loop stalls amid a tone, while its status is read: the watchdog must expire."""
        await self.apply(Layer(0, (Tone(0, 100.0, 0.5),), 0.01), rest=0.05)
        self.is_stalled = True
        self.line.witness.set_stalled(self.line.loop.time())
        for _ in range(40):
            await asyncio.sleep(0.01)
            with contextlib.suppress(CommandRefused):
                await self.host.read_status()

    async def apply(self, layer: Layer, *, rest: float) -> None:
        """Play a layer, then rest for a time [s]."""
        await self.group.apply({"a": [layer]})
        await asyncio.sleep(rest)

    async def again(self) -> None:
        """Clear and arm again."""
        await self.group.clear()
        await self.group.arm()

    async def _keep_beating(self) -> None:
        while not self.is_stalled:
            if self.group.is_armed:
                with contextlib.suppress(CommandRefused):
                    await self.group.beat()
            await asyncio.sleep(0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_witness_finds_nothing_in_a_day(kind: str) -> None:
    """It plays, is stopped, has a fault, and hangs."""
    witness = witness_of({"line": (kind, ("a",))}, slew_per_s=400)

    problems: list[str] = []

    async def run() -> None:
        try:
            await Day(ListenedLine(witness, "line", kind, "a")).run()
        except (CommandRefused, Preempted) as problem:
            problems.append(str(problem))

    run_virtual(run())
    assert not witness.finish(), str(witness.finish()[0])
    assert not problems
    assert witness.frames > 100
