"""Random days of amplifiers on the chain: layers, stops, faults, lost frames."""

import asyncio
import contextlib
import random
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Any, Self

from chain import Chain
from drivers.errors import CommandRefused, LinkError, Preempted
from drivers.host.group import Group
from drivers.host.line import Priority
from drivers.playing import Layer, Tone
from drivers.protocol.definition import STATES
from drivers.protocol.sets import Envelope
from registry import threads
from registry.limits import GuardLimits
from set_table import SetTable, make_rig
from sim.far_ends.wire_assignment import Wire
from sim.faults import FaultWindow
from virtual_loop import VirtualLoop

_CHANNELS, _LAYERS = 2, 4
_PASSING = 50e-6, 350e-6  # s; through driver and adapter, that sets may be read back at any time
_LOST, _DOUBLED = 0.03, 0.03  # share of frames
_FAILURES = (CommandRefused, LinkError, Preempted)


@dataclass
class RandomGroup(Chain):
    """A chain whose amplifiers play what is drawn: no finger touches, and its loop only beats."""

    rng: random.Random = field(init=False)
    _turned: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        """Draw as the wires do."""
        super().__post_init__()
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.rng = loop.rng

    @classmethod
    def of(
        cls, wires: Mapping[str, Wire], rng: random.Random, **options: Any
    ) -> AbstractAsyncContextManager[Self]:
        """A chain of amplifiers on wires, not open yet; options: as for `Chain.on`."""
        rig = make_rig([*wires], GuardLimits(20.0, 1000.0, 1.0))
        options |= {
            "passing": _PASSING,
            "capabilities": {"layers": _LAYERS},
            "watchdog": rng.choice((0.25, 0.5)),
        }
        judged = {"frequency": (20, 1000)}
        table = SetTable({}, rig.plate)
        return cls.on(wires, rig, table, judged=judged, sensed_every=0.002, **options)

    async def _turn(self, step: Callable[[], Awaitable[None]]) -> None:
        try:
            await super()._turn(step)
        finally:
            self._turned.set()

    async def arm(self) -> None:
        """Arm, and await the turn of the loop that silences what it does not know."""
        await self.operate("arm")
        self._turned.clear()
        await self._turned.wait()

    @property
    def group(self) -> Group:
        """All amplifiers."""
        return self.controller.group

    def disturb(self, *windows: FaultWindow) -> None:
        """Have faults of frames on all wires from now on, until `recover`."""
        self.witness.disturb()
        for far_end in self.far_ends:
            for window in windows:
                far_end.device.inject_fault(window)

    def recover(self) -> None:
        """End the faults of frames."""
        for far_end in self.far_ends:
            far_end.recover()
        self.witness.disturb(-1)

    async def live(self, steps: int, *, lossy_steps: int = 0) -> None:
        """Open and arm the group, take so many steps, the first lossy, and disarm."""
        await self.open()
        for step in range(steps):
            if step == 0 and lossy_steps:
                lost = FaultWindow(fault="drop", share=_LOST)
                self.disturb(lost, FaultWindow(fault="duplicate", share=_DOUBLED))
            elif step == lossy_steps and lossy_steps:
                self.recover()
                await asyncio.sleep(0.6)
            with contextlib.suppress(*_FAILURES):
                await self._step()
            await asyncio.sleep(self.rng.choice((0.0, 0.001, 0.01, 0.04, 0.2)))
        with contextlib.suppress(*_FAILURES):
            await self.operate("disarm")
        await asyncio.sleep(0.1)

    async def _step(self) -> None:
        if not self.group.is_open:
            await self.controller.release()
            await self.controller.open()
        if not self.group.is_armed and self.rng.random() < 0.8:
            await self.operate("clear")
            await self.arm()
            return
        chosen = self.rng.random()
        names = [*self.group.amplifiers]
        host = self.group.amplifiers[self.rng.choice(names)]
        if chosen < 0.6:
            await self.group.apply({name: self.layers() for name in names})
        elif chosen < 0.7:
            await host.request("GetAchieved", {"layer": self._number()}, Priority.OTHER)
        elif chosen < 0.75:
            await host.request("GetFaults", {}, Priority.OTHER)
        elif chosen < 0.8:
            await self.group.silence(self._ramp())
        elif chosen < 0.84:
            await self.operate("disarm")
        elif chosen < 0.9:
            await self.operate("stop")
        elif chosen < 0.93:
            self.turning.clear()
            await asyncio.sleep(0.6)
            self.turning.set()
        elif chosen < 0.96:
            self.far.bench.advance(threads.now())
            amplifier = self.rng.choice(self.far_ends).amplifier
            amplifier.trip(self.rng.choice(("ARC", "CHANNEL")), threads.now(), channel=1)
        else:
            status = await host.read_status()
            if self.group.is_armed and status["state"] != STATES["OPERATION_ENABLED"]:
                await self.operate("stop")

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
