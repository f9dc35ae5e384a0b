"""The one chain, in virtual time: control loop, wires in memory, far ends, plate and witness.

Everything between the touch frames and the plate is the project's own, with the durations of the
wires; only the lines are memory. The witness reads every byte and is the judge.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Self

from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer, Silenced
from controller.sources.touch import Touch, TouchFrame
from drivers import clock
from drivers.opening import Lines
from memory_machine import MemoryMachine
from model.rig.rig import Rig
from newest_contact import BuzzNewestContact
from rig_on_wire import FarSide, far_side
from set_table import SetTiming
from sim.far_ends.wires import Wire
from sim.plant.imperfections import Imperfections
from sim.witness.witness import OperatorCommand
from witness_config import LoopWitness

Position = tuple[float, float]
_REPORT = 0.010  # s; between two frames of the panel


@dataclass
class Chain:
    """A chain whose control loop runs once it is open; names of amplifiers as in the rig.

    at: the fingers by id, at x, y [m] of the plate; is_felt: whether they rest on the plate too, or
    on its panel alone; must_be_felt: whether each that comes must lead to a pattern;
    applied, silenced: what the control loop has reported.
    """

    far: FarSide
    operation: MemoryMachine
    witness: LoopWitness
    controller: Controller
    at: dict[int, Position] = field(default_factory=dict)
    is_felt: bool = True
    must_be_felt: bool = True
    applied: list[Applied] = field(default_factory=list)
    silenced: list[Silenced] = field(default_factory=list)
    running: "asyncio.Task[None] | None" = None

    @classmethod
    @asynccontextmanager
    async def on(
        cls,
        wires: Wire | Mapping[str, Wire],
        rig: Rig,
        table: Any,
        *,
        plate: Rig | None = None,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
        judged: Mapping[str, Any] | None = None,
        layers: int = 8,
        **options: Any,
    ) -> AsyncIterator[Self]:
        """A chain whose wires are not open yet; wires: of all amplifiers, or of each by name.

        plate: the rig of the far side, if it is another; judged: by what the witness judges, as for
        `witness_config`; layers: of each amplifier; options: as a `Controller` takes them.
        """
        far_end = far_side(wires, plate or rig, seed=1, imperfections=imperfections)
        async with far_end as far:
            for amplifier in far.bench.amplifiers.values():
                amplifier.capabilities["layers"] = layers
            witness = LoopWitness(far.urls, **(judged or {}))
            controller = Controller(
                rig,
                table,
                lines=Lines,
                urls=far.urls,
                **{"intent_source": BuzzNewestContact(), "timing": SetTiming(), **options},
            )
            witness.follow(controller)
            assert far.machine is not None
            chain = cls(far, far.machine, witness, controller)
            controller.observers.append(
                Observer(pattern_applied=chain.applied.append, silenced=chain.silenced.append)
            )
            yield chain

    @classmethod
    @asynccontextmanager
    async def armed(
        cls, *given: Any, breaks: str | None = None, **options: Any
    ) -> AsyncIterator[Self]:
        """A chain as of `on`, armed; closed at the end, when the witness is asked.

        breaks: the only rule of the witness that is broken.
        """
        async with cls.on(*given, **options) as chain:
            await chain.open()
            await chain.operate("arm")
            yield chain
            await chain.close()
            found = chain.witness.finish(clock.now())
            assert {one.invariant for one in found} == ({breaks} if breaks else set()), found[:1]
            assert chain.witness.frames > 10

    async def open(self) -> None:
        """Open all wires, and start the control loop."""
        await self.controller.open()
        self.run()

    def run(self) -> None:
        """Start the control loop."""
        self.running = asyncio.create_task(self.controller.run())

    async def operate(self, command: OperatorCommand) -> Any:
        """Carry out an operator's command; returns what the control loop says of it."""
        return await getattr(self.controller, command)()

    def report(self) -> None:
        """Report where the fingers are."""
        now, plate = clock.now(), self.far.bench.rig.plate
        if self.is_felt:
            self.far.bench.place_fingers({str(id): at for id, at in self.at.items()}, now=now)
        self.witness.contacts(now, tuple(self.at), is_answerable=self.must_be_felt)
        touches = tuple(
            Touch(id, x / plate.length, 1 - y / plate.width) for id, (x, y) in self.at.items()
        )
        self.controller.deliver(TouchFrame("panel", now, touches))

    async def hold(self, seconds: float, way: Callable[[float], None] = lambda since: None) -> None:
        """Report them for a time [s]; way moves them, by the time since the start."""
        begin = clock.now()
        while (since := clock.now() - begin) < seconds - 1e-9:
            way(since)
            self.report()
            await asyncio.sleep(_REPORT)

    def levels(self) -> dict[str, tuple[float, ...]]:
        """Level of each channel now, by amplifier."""
        return {name: self.far.summary(name).levels for name in self.far.devices}

    async def close(self) -> None:
        """Disarm and close all, and end the control loop."""
        self.witness.commanded("disarm")
        await self.controller.close()
        if self.running is not None:
            self.running.cancel()
            await asyncio.gather(self.running, return_exceptions=True)
