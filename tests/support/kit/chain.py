"""The one chain, in virtual time: control loop, wires in memory, far ends and plate.

Everything between the touch frames and the plate is the project's own, with the durations of the
wires; only the lines are memory. `HostRules` judge what the host sends, `PlateJudge` what plays. A
chain has a table that a test sets, on a rig for which nothing has to be solved, or the table of a
plate.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, Self, TypeVar, cast

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.operation.plate_controller import Controller
from controller.play.reports import Observers, PlayReport
from controller.sources.touch import Touch, TouchFrame
from drivers.opening import Lines
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_vibrating, unpack_layers
from drivers.wires.wire import address_of
from kit.clock import MemoryMachine
from kit.host_rules import ChannelLimits, HostRules, HostTimes, OperatorCommand
from kit.plate_judge import STEP, WATCHDOG, PlateJudge
from kit.set_table import SetTable, SetTiming, make_rig
from kit.wires import FarSide, far_side
from model.rig.rig import Rig
from model.vibration import Tone
from registry import threads
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultKind, FaultWindow
from sim.plant.imperfections import Imperfections

Position = tuple[float, float]
Finger = tuple[int, float, float]
"""A finger by its number, at x and y [m] of the plate."""

_REPORT = 0.010  # s; between two frames of the panel


@dataclass
class Chain:
    """A chain whose control loop runs once it is open; names of amplifiers as in the rig.

    at: the fingers by id, at x, y [m] of the plate; off: their displacement [m] from there, which
    the panel does not report; is_felt: whether they rest on the plate too, or
    on its panel alone; must_be_felt: whether each that comes must lead to a pattern;
    timeout [s]: how long they are taken for down after a report, None for a panel's;
    far_ends: the amplifiers; applied, silenced, refused, lost, contacts: what the control loop has
    reported, of contacts their number at each change; turning: unless the loop is to stall before
    its next turn.
    """

    far: FarSide
    operation: MemoryMachine
    host_rules: HostRules
    plate_judge: PlateJudge
    make_controller: Callable[..., Controller]
    controller: Controller = field(init=False)
    at: dict[int, Position] = field(default_factory=dict)
    off: dict[int, Position] = field(default_factory=dict)
    is_felt: bool = True
    must_be_felt: bool = True
    timeout: float | None = None
    table: Any = field(init=False)
    far_ends: "list[FarEnd]" = field(init=False)
    applied: list[PlayReport] = field(default_factory=list)
    silenced: list[PlayReport] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    running: "asyncio.Task[None] | None" = None
    turning: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        """Make the control loop, and hear of all that is requested of the far ends."""
        self.far_ends = [
            FarEnd(self.far, name, self.host_rules.disturb) for name in self.far.devices
        ]
        self.make_host()
        self.table = self.controller.table

    def make_host(self, **more: Any) -> None:
        """Make a control loop in place of the one before, if any; more: as a `Controller` takes."""
        controller = self.controller = self.make_controller(**more)
        self.host_rules.follow(controller)
        cycle = controller.cycle
        cycle.step = partial(self._turn, cycle.step)  # type: ignore[method-assign]
        self.turning.set()
        loop = cycle.observers
        loop.contacts_changed.append(lambda contacts, change: self.contacts.append(len(contacts)))
        loop.reported.append(
            lambda each: (self.applied if each.contents else self.silenced).append(each)
        )
        loop.refused.append(self.refused.append)
        loop.link_lost.append(self.lost.append)

    async def _turn(self, step: Callable[[], Awaitable[None]]) -> None:
        """Turn the control loop once, unless it stalls."""
        if not self.turning.is_set():
            self.host_rules.set_stalled()
            try:
                await self.turning.wait()
            finally:
                self.host_rules.set_stalled(False)
        await step()

    @property
    def far_end(self) -> "FarEnd":
        """The first amplifier."""
        return self.far_ends[0]

    @classmethod
    @asynccontextmanager
    async def on(
        cls,
        wires: SimulatedWire | Mapping[str, SimulatedWire],
        rig: Rig,
        table: Any,
        *,
        passing: tuple[float, float] | None = None,
        plate: Rig | None = None,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
        limits: ChannelLimits | None = None,
        times: HostTimes | None = None,
        sensed_every: float = STEP,
        capabilities: Mapping[str, int] = MappingProxyType({}),
        seed: int = 1,
        observe: Callable[[Observers], None] = lambda loop: None,
        **options: Any,
    ) -> AsyncIterator[Self]:
        """A chain whose wires are not open yet; wires: of all amplifiers, or of each by name.

        passing [s]: shortest and longest time of bytes on serial lines, None for those of machines;
        plate: the rig of the far side, if it is another; limits, times: by which the host is
        judged; sensed_every [s]: while a channel vibrates; capabilities: what each amplifier has in
        place of its own; seed: of faults; observe: adds the first observers of
        the control loop; options: as a `Controller` takes them.
        """
        far_end = far_side(wires, plate or rig, seed=seed, imperfections=imperfections)
        async with far_end as far:
            for amplifier in far.bench.amplifiers.values():
                amplifier.capabilities.update(capabilities)
            host_rules = HostRules(
                far.urls, limits=limits or ChannelLimits(), times=times or HostTimes()
            )
            given = {"timing": SetTiming(), "watchdog": WATCHDOG, **options}
            watchdog = given["watchdog"]
            plate_judge = PlateJudge(far, host_rules, step=sensed_every, watchdog=watchdog)

            def make(**more: Any) -> Controller:
                own = {"intent_source": EffectPlayer(SurfaceLayout()), **given, **more}
                controller = Controller(rig, table, lines=Lines, urls=far.urls, **own)
                observe(controller.cycle.observers)
                return controller

            far.machine.passing = passing or far.machine.passing
            try:
                yield cls(far, far.machine, host_rules, plate_judge, make)
            finally:
                plate_judge.close()

    @classmethod
    @asynccontextmanager
    async def armed(
        cls, *given: Any, breaks: str | None = None, **options: Any
    ) -> AsyncIterator[Self]:
        """A chain as of `on`, armed; closed and judged at the end.

        breaks: the only rule that is broken.
        """
        async with cls.on(*given, **options) as chain:
            await chain.open()
            await chain.operate("arm")
            yield chain
            await chain.close()
            chain.judge(breaks)

    def judge(self, breaks: str | None = None) -> None:
        """Judge the host, the amplifiers and the plate.

        breaks: the only rules that are broken, with spaces between, or "plate" if none is but the
        plate may play.
        """
        violations = self.host_rules.finish()
        broken = {violation.rule for violation in violations}
        expected = {*(breaks or "").split()} - {"plate"}
        assert broken == expected, "\n".join(map(str, violations[:5]))
        assert breaks or not self.plate_judge.violations, self.plate_judge.violations
        assert self.host_rules.requests

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
            self.far.bench.place_fingers(self.touched_at(), now=now)
        touches = tuple(
            Touch(id, x / plate.length, 1 - y / plate.width) for id, (x, y) in self.at.items()
        )
        frame = TouchFrame("panel", now - ago, touches, self.timeout)
        self.deliver(frame, must_be_felt=self.must_be_felt)

    def touched_at(self) -> dict[str, Position]:
        """Return where the fingers touch the plate [m], by number as text."""
        positions = {}
        for id, (x, y) in self.at.items():
            dx, dy = self.off.get(id, (0.0, 0.0))
            positions[str(id)] = (x + dx, y + dy)
        return positions

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
        self.host_rules.commanded("disarm")
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
        self.amplifier = cast(SimulatedAmplifier, far.bench.amplifiers[name])
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
        return address_of(self._far.urls[self.name]).place.name

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
        """Answer by this from now on, which nothing judges."""
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


Made = TypeVar("Made", bound=Chain)

FINGER = (1, 0.15, 0.1)
OTHER = (2, 0.27, 0.02)
"""Fingers on these rigs."""


@asynccontextmanager
async def set_chain(
    *amplifiers: str,
    of: type[Made] = Chain,  # type: ignore[assignment]
    wire: str = "serial",
    rate: float = math.inf,
    on_time: float = math.inf,
    knots: int = 0,
    **options: Any,
) -> AsyncIterator[Made]:
    """A chain with a table that a test sets, not open yet; one amplifier unless more are named.

    of: its class; wire: its kind; rate [1/s], on_time [s]: limits of the rig; knots: of an
    envelope, none that can be played without; options: as for `Chain.on`. Its wires have no delays,
    its fingers load no plate.
    """
    names = amplifiers or ("main",)
    rig = make_rig(names, GuardLimits(40.0, 500.0, 1.0, rate=rate, on_time=on_time))
    table = SetTable({"SW": Tone(110.0, 20e-6, math.pi / 2)}, rig.plate)
    options = {"passing": (0.0, 0.0), "capabilities": {"knots": knots}, **options}
    async with of.on(SimulatedWire(wire, unpluggable=True), rig, table, **options) as chain:
        chain.is_felt = chain.must_be_felt = False
        yield chain


@asynccontextmanager
async def set_running(
    *amplifiers: str, of: type[Made] = Chain, breaks: str | None = None, **options: Any
) -> AsyncIterator[Made]:
    """The same, armed, and judged at its end; breaks: the only rule that is broken."""
    async with set_chain(*amplifiers, of=of, **options) as chain:
        await chain.open()
        await chain.operate("arm")
        await asyncio.sleep(0.001)
        yield chain
        await chain.close()
        chain.judge(breaks)
