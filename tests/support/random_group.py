"""Random days of a group of amplifiers of protocol 3: layers, stops, faults, lost frames."""

import asyncio
import contextlib
import random
from collections.abc import Sequence
from typing import Any

from drivers.contents import Layer, Tone
from drivers.errors import CommandRefused, LinkError, Preempted
from drivers.host.group import Group
from drivers.host.jobs import Priority
from drivers.host.members import GroupState
from drivers.protocol.sets import Envelope
from drivers.protocol.table import STATES
from words_line import unaltered

_CHANNELS, _LAYERS = 2, 4
_BEAT = 0.05  # s
_FAILURES = (CommandRefused, LinkError, Preempted)


class RandomGroup:
    """A group on lines, and a random generator of what is done with it."""

    def __init__(self, lines: Sequence[Any], rng: random.Random) -> None:
        self.rng = rng
        self.lines = lines
        hosts = {name: host for line in lines for name, host in line.hosts.items()}
        self.group = Group(hosts, watchdog=self.rng.choice((0.25, 0.5)), draw=self.rng.randint)
        self._beating = asyncio.Lock()  # no beat is under way while the loop stalls

    def disturb(self, *, is_on: bool) -> None:
        """Lose and double frames on their way from now on, or no longer; the witness is told."""
        for line in self.lines:
            line.witness.faults(line.loop.time(), line.name, are_on=is_on)
            line.inward = line.outward = self._alter if is_on else unaltered

    async def run(self, steps: int, *, lossy_steps: int = 0) -> None:
        """Open and arm the group, take so many steps, the first lossy, and disarm."""
        background = [asyncio.ensure_future(line.keep_sensing()) for line in self.lines]
        background.append(asyncio.ensure_future(self.keep_beating()))
        try:
            await self._opened()
            for step in range(steps):
                if step == 0 and lossy_steps:
                    self.disturb(is_on=True)
                elif step == lossy_steps and lossy_steps:
                    self.disturb(is_on=False)
                    await asyncio.sleep(0.6)
                with contextlib.suppress(*_FAILURES):
                    await self._step()
                await asyncio.sleep(self.rng.choice((0.0, 0.001, 0.01, 0.04, 0.2)))
            with contextlib.suppress(*_FAILURES):
                await self.group.disarm()
            await asyncio.sleep(0.1)
        finally:
            for each in background:
                each.cancel()
            await asyncio.gather(*background, return_exceptions=True)

    async def _opened(self) -> None:
        for _ in range(20):
            with contextlib.suppress(*_FAILURES):
                await self.group.open()
                return
        raise AssertionError("the group must open")

    async def _step(self) -> None:
        if self.group.state is GroupState.LOST:
            await self.group.open()
        if not self.group.is_armed and self.rng.random() < 0.8:
            await self.group.clear()
            await self.group.arm()
            return
        chosen = self.rng.random()
        names = [*self.group.amplifiers]
        host = self.group.amplifiers[self.rng.choice(names)]
        if chosen < 0.6:
            layers = {name: self.layers() for name in names}
            await self.group.apply(layers)
        elif chosen < 0.7:
            await host.request("GetAchieved", {"layer": self._number()}, Priority.OTHER)
        elif chosen < 0.75:
            await host.request("GetFaults", {}, Priority.OTHER)
        elif chosen < 0.8:
            await self.group.silence(self._ramp())
        elif chosen < 0.84:
            await self.group.disarm()
        elif chosen < 0.9:
            await self.group.stop()
        elif chosen < 0.93:
            async with self._beating:
                self._stall(is_stalled=True)
                await asyncio.sleep(0.6)
                self._stall(is_stalled=False)
        elif chosen < 0.96:
            line = self.rng.choice(self.lines)
            far = self.rng.choice([*line.far.values()])
            far.tick(line.loop.time())
            far.trip(self.rng.choice(("ARC", "CHANNEL")), line.loop.time(), channel=1)
        else:
            status = await host.read_status()
            if self.group.is_armed and status["state"] != STATES["OPERATION_ENABLED"]:
                await self.group.stop()

    def _stall(self, *, is_stalled: bool) -> None:
        for line in self.lines:
            line.witness.set_stalled(line.loop.time(), is_stalled)

    def _number(self) -> int:
        return self.rng.randrange(_LAYERS)

    def _ramp(self) -> float:
        return self.rng.choice((0.0, 0.005, 0.01, 0.03))

    def layers(self) -> list[Layer]:
        """Draw layers to play."""
        numbers = self.rng.sample(range(_LAYERS), self.rng.choice((1, 1, 1, 2)))
        return [self._layer(number) for number in numbers]

    def _layer(self, number: int) -> Layer:
        kind = self.rng.random()
        valid_for = self.rng.choice((0.0, 0.0, 0.05, 0.3))
        if kind < 0.15:
            return Layer(number, (), self._ramp())
        if kind < 0.25:
            return Layer(number, (), self._ramp(), valid_for, renew=True)
        channels = self.rng.sample(range(_CHANNELS), self.rng.choice((1, 2)))
        tones = tuple(self._tone(channel, number) for channel in channels)
        return Layer(number, tones, self._ramp(), valid_for, after=self.rng.random() < 0.15)

    def _tone(self, channel: int, number: int) -> Tone:
        rng = self.rng
        shapes = [self._shape() if rng.random() < 0.3 else None for _ in range(2)]
        return Tone(
            *(channel, rng.choice((100.0, 100.0, 150.0 + number)), rng.choice((0.0, 0.1, 0.2))),
            rng.uniform(-180, 179),
            keep_phase=rng.random() < 0.4,
            skip_ending=rng.random() < 0.3,
            onset=shapes[0],
            ending=shapes[1],
        )

    def _shape(self) -> Envelope:
        count = self.rng.choice((0, 1, 4))
        step = self.rng.choice((10, 40, 200))
        return Envelope(step, tuple((self.rng.randrange(2000), 0) for _ in range(count)))

    async def keep_beating(self) -> None:
        """Beat as a control loop does while it is armed."""
        while True:
            await asyncio.sleep(_BEAT)
            async with self._beating:
                if self.group.is_armed:
                    with contextlib.suppress(*_FAILURES):
                        await self.group.beat()

    def _alter(self, name: str, data: bytes) -> list[tuple[float, bytes]]:
        chosen = self.rng.random()
        if chosen < 0.03:
            return []
        delays = [0.0002, 0.0015] if chosen < 0.06 else [0.0002]
        return [(delay, data) for delay in delays]
