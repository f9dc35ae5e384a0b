"""The one chain, in virtual time: control loop, wires in memory, far ends, plate and witness.

Everything between the touch frames and the plate is the project's own, with the durations of the
wires; only the lines are memory. The witness reads every byte, and the plate is judged beside it.
"""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, Self, cast

from controller.play.loop import Controller
from controller.play.planner import Observers, PlayReport, SilenceReport
from controller.sources.touch import Touch, TouchFrame
from drivers.opening import Lines
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_vibrating, unpack_layers
from era_haptics.lab.witness.witness_cli import parse_endpoint
from memory_machine import MemoryMachine
from model.rig.rig import Rig
from newest_contact import BuzzNewestContact
from plate_judge import STEP, WATCHDOG, PlateJudge
from plate_witness import OperatorCommand
from registry import threads
from rig_on_wire import FarSide, far_side
from set_table import SetTiming
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.wire_assignment import Wire
from sim.faults import FaultKind, FaultWindow
from sim.plant.imperfections import Imperfections
from witness_config import LoopWitness

Position = tuple[float, float]
Finger = tuple[int, float, float]
"""A finger by its number, at x and y [m] of the plate."""

_REPORT = 0.010  # s; between two frames of the panel


@dataclass
class Chain:
    """A chain whose control loop runs once it is open; names of amplifiers as in the rig.

    at: the fingers by id, at x, y [m] of the plate; is_felt: whether they rest on the plate too, or
    on its panel alone; must_be_felt: whether each that comes must lead to a pattern;
    timeout [s]: how long they are taken for down after a report, None for a panel's;
    far_ends: the amplifiers; applied, silenced, refused, lost, contacts: what the control loop has
    reported, of contacts their number at each change; turning: unless the loop is to stall before
    its next turn.
    """

    far: FarSide
    operation: MemoryMachine
    witness: LoopWitness
    plate_judge: PlateJudge
    make_controller: Callable[..., Controller]
    controller: Controller = field(init=False)
    at: dict[int, Position] = field(default_factory=dict)
    is_felt: bool = True
    must_be_felt: bool = True
    timeout: float | None = None
    table: Any = field(init=False)
    far_ends: "list[FarEnd]" = field(init=False)
    applied: list[PlayReport] = field(default_factory=list)
    silenced: list[SilenceReport] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    running: "asyncio.Task[None] | None" = None
    turning: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        """Make the control loop, and hear of all that is requested of the far ends."""
        self.far_ends = [FarEnd(self.far, name, self.witness.disturb) for name in self.far.devices]
        self.make_host()
        self.table = self.controller.table

    def make_host(self, **more: Any) -> None:
        """Make a control loop in place of the one before, if any; more: as a `Controller` takes."""
        controller = self.controller = self.make_controller(**more)
        self.witness.follow(controller)
        cycle = controller.cycle
        cycle.step = partial(self._turn, cycle.step)  # type: ignore[method-assign]
        self.turning.set()
        loop = cycle.observers
        loop.contacts_changed.append(lambda contacts, change: self.contacts.append(len(contacts)))
        loop.pattern_applied.append(self.applied.append)
        loop.silenced.append(self.silenced.append)
        loop.refused.append(self.refused.append)
        loop.link_lost.append(self.lost.append)

    async def _turn(self, step: Callable[[], Awaitable[None]]) -> None:
        """Turn the control loop once, unless it stalls."""
        if not self.turning.is_set():
            self.witness.set_stalled(threads.now())
            try:
                await self.turning.wait()
            finally:
                self.witness.set_stalled(threads.now(), False)
        await step()

    @property
    def far_end(self) -> "FarEnd":
        """The first amplifier."""
        return self.far_ends[0]

    @classmethod
    @asynccontextmanager
    async def on(
        cls,
        wires: Wire | Mapping[str, Wire],
        rig: Rig,
        table: Any,
        *,
        passing: tuple[float, float] | None = None,
        plate: Rig | None = None,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
        judged: Mapping[str, Any] | None = None,
        sensed_every: float = STEP,
        capabilities: Mapping[str, int] = MappingProxyType({}),
        seed: int = 1,
        observe: Callable[[Observers], None] = lambda loop: None,
        **options: Any,
    ) -> AsyncIterator[Self]:
        """A chain whose wires are not open yet; wires: of all amplifiers, or of each by name.

        passing [s]: shortest and longest time of bytes on serial lines, None for those of machines;
        plate: the rig of the far side, if it is another; judged: by what the witness judges, as for
        `witness_config`; sensed_every [s]: while a channel vibrates; capabilities: what each
        amplifier has in place of its own; seed: of faults; observe: adds the first observers of
        the control loop; options: as a `Controller` takes them.
        """
        far_end = far_side(wires, plate or rig, seed=seed, imperfections=imperfections)
        async with far_end as far:
            for amplifier in far.bench.amplifiers.values():
                amplifier.capabilities.update(capabilities)
            witness = LoopWitness(far.urls, **(judged or {}))
            given = {"timing": SetTiming(), "watchdog": WATCHDOG, **options}
            watchdog = given["watchdog"]
            plate_judge = PlateJudge(far, witness, step=sensed_every, watchdog=watchdog)

            def make(**more: Any) -> Controller:
                own = {"intent_source": BuzzNewestContact(), **given, **more}
                controller = Controller(rig, table, lines=Lines, urls=far.urls, **own)
                observe(controller.cycle.observers)
                return controller

            assert far.machine is not None
            far.machine.passing = passing or far.machine.passing
            try:
                yield cls(far, far.machine, witness, plate_judge, make)
            finally:
                plate_judge.close()

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
            chain.judge(breaks)

    def judge(self, breaks: str | None = None) -> None:
        """Ask the witness and what judges the plate.

        breaks: the only rules of the witness that are broken, spaces between, or "plate" if none
        is but the plate may play.
        """
        found = self.witness.finish(threads.now())
        assert {one.invariant for one in found} == {*(breaks or "").split()} - {"plate"}, [
            *map(str, found[:1])
        ]
        assert breaks or not self.plate_judge.violations, self.plate_judge.violations
        assert self.witness.frames

    async def open(self) -> None:
        """Open all wires, and start the control loop."""
        await self.controller.open()
        self.run()

    def run(self) -> None:
        """Start the control loop."""
        self.running = asyncio.create_task(self.controller.cycle.run())

    async def operate(self, command: OperatorCommand) -> Any:
        """Carry out an operator's command; returns what the control loop says of it."""
        return await getattr(self.controller, command)()

    def report(self, *, ago: float = 0.0) -> None:
        """Report where the fingers are, or were some time ago [s]."""
        now, plate = threads.now(), self.far.bench.rig.plate
        if self.is_felt:
            self.far.bench.place_fingers({str(id): at for id, at in self.at.items()}, now=now)
        touches = tuple(
            Touch(id, x / plate.length, 1 - y / plate.width) for id, (x, y) in self.at.items()
        )
        frame = TouchFrame("panel", now - ago, touches, self.timeout)
        self.deliver(frame, must_be_felt=self.must_be_felt)

    def deliver(self, frame: TouchFrame, *, must_be_felt: bool = False) -> None:
        """Deliver a frame to the judges, then to the control loop."""
        self.plate_judge.touched(frame, must_be_felt=must_be_felt)
        self.controller.cycle.deliver(frame)

    def put(self, *fingers: Finger, ago: float = 0.0) -> None:
        """Have these fingers in place of all that are down, and report them."""
        self.at = {id: (x, y) for id, x, y in fingers}
        self.report(ago=ago)

    async def leave(self, seconds: float, *fingers: Finger, ago: float = 0.0) -> None:
        """Put these fingers down, and report them no more for a time [s]."""
        self.put(*fingers, ago=ago)
        await asyncio.sleep(seconds)

    async def hold(
        self,
        seconds: float,
        way: Callable[[float], None] = lambda since: None,
        *,
        down: Sequence[Finger] = (),
    ) -> None:
        """Report the fingers for a time [s]; way moves them, by the time since the start.

        down: fingers in place of all that are down.
        """
        if down:
            self.at = {id: (x, y) for id, x, y in down}
        begin = threads.now()
        while (since := threads.now() - begin) < seconds - 1e-9:
            way(since)
            self.report()
            await asyncio.sleep(_REPORT)

    def levels(self) -> dict[str, tuple[float, ...]]:
        """Level of each channel now, by amplifier."""
        return {name: self.far.summary(name).levels for name in self.far.devices}

    async def close(self) -> None:
        """Disarm and close all; raises what ended the control loop."""
        self.witness.commanded("disarm")
        await self.controller.close()
        self.turning.set()  # one that stalls has nothing to end it
        if self.running is not None:
            await self.running


@dataclass(frozen=True)
class Sent:
    """What a layer was to play from a time [s] on; token 0 for a silence."""

    time: float
    token: int
    layer: LayerSet

    @property
    def is_silent(self) -> bool:
        """Whether nothing plays after it."""
        return not is_vibrating(self.layer)


class FarEnd:
    """An amplifier of a chain: what is requested of it, and what it does in place of its duty.

    asked: times [s], names and values of all requests; committed: time, token and layers of every
    set, no layers for a silence, as they are carried out; answer may override a reply, or raise
    Refusal; `delay` is of serial lines alone.
    """

    def __init__(self, far: FarSide, name: str, disturb: Callable[[], None]) -> None:
        self.name = name
        self.disturb = disturb
        self.device = far.devices[name]
        self.amplifier = cast(Amplifier, far.bench.amplifiers[name])
        self.asked: list[tuple[float, str, Values]] = []
        self.answer: Callable[[str, Values], Values | None] = lambda name, values: None
        self.obey = self.device.handle
        self.device.handle = self._handle  # type: ignore[method-assign]
        self.committed: list[tuple[float, int, tuple[LayerSet, ...]]] = []
        self._staged: dict[int, dict[int, list[int]]] = {}
        self._far = far
        assert far.machine is not None
        self._machine = far.machine

    def _handle(self, name: str, values: Values, now: float) -> Values:
        self.asked.append((now, name, values))
        reply = self.answer(name, values)
        if reply is None:
            reply = self.obey(name, values, now)
        self._note(name, values, reply, now)
        return reply

    def _note(self, name: str, values: Values, reply: Values, now: float) -> None:
        """Note what a request and its reply at a time [s] change."""
        if name == "Silence":
            self.committed.append((now, 0, ()))
        if name == "Set":
            parts = self._staged.setdefault(values["token"], {})
            parts[values["index"]] = list(values["stream"])
        if name == "Commit" or reply.get("played"):
            parts = self._staged.pop(values["token"], {})  # none if it was repeated
            words = [word for index in sorted(parts) for word in parts[index]]
            if words:
                self.committed.append((now, values["token"], unpack_layers(words)))

    @property
    def port(self) -> str:
        """Where its line is."""
        return parse_endpoint(self._far.urls[self.name]).location

    @property
    def is_open(self) -> bool:
        """Whether a host has its line open."""
        return self._machine.opened(self.port) is not None

    def delay(self, seconds: float) -> None:
        """Let its replies leave it so much later [s] from now on."""
        self._machine.late[self.port] = seconds

    def fault(self, kind: FaultKind, **given: Any) -> None:
        """Let a fault begin, until `recover` unless it has an end."""
        self.device.inject_fault(FaultWindow(fault=kind, **given))
        self.disturb()

    def lie(self, answer: Callable[[str, Values], Values | None]) -> None:
        """Answer by this from now on, which no witness is to judge."""
        self.answer = answer
        self.disturb()

    def recover(self) -> None:
        """End all its faults."""
        self.device.recover()

    @property
    def state(self) -> str:
        """Its state now."""
        return self._far.summary(self.name).state

    @property
    def levels(self) -> tuple[float, ...]:
        """What its channels play now."""
        return self._far.summary(self.name).levels

    def status(self) -> Values:
        """What it would report now."""
        self.device.tick(threads.now())
        return self.amplifier.status(threads.now())

    def sent(self) -> list[Sent]:
        """All sets that were committed, and silences, in order."""
        return [
            Sent(time, token, one)
            for time, token, layers in self.committed
            for one in layers or (LayerSet(0, 0, 0),)
        ]

    def requests(self, *names: str) -> list[Values]:
        """What was requested, of some names."""
        return [values for _, name, values in self.asked if name in names]

    def names(self, since: int = 0) -> list[str]:
        """Names of all requests from a number on."""
        return [name for _, name, _ in self.asked[since:]]

    def times(self, *names: str) -> list[float]:
        """When something was requested [s]."""
        return [time for time, name, _ in self.asked if name in names]
