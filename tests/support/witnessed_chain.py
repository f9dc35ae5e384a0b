"""The whole chain in virtual time, with a witness on its wires: controller, drivers, far ends.

A scenario is a sequence of touches and operator commands: arm, stop, clear, the
control loop hangs. What each touch must give is known by hand from the rig below.
"""

import asyncio
import contextlib
import math
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from controller.loop.loop import Controller
from controller.sources.touch import Touch, TouchFrame
from drivers import clock
from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from memory_machine import MemoryMachine, live_in_memory
from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.attachments import Era
from model.structure.plate import Material, Plate
from model.table.pattern import Pattern
from model.table.question import Question
from model.vibration.excitation import Excitation, Tone
from newest_contact import BuzzNewestContact
from registry.limits import GuardLimits
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire, open_wire
from sim.witness.violation import Violation
from sim.witness.witness import OperatorCommand, Witness
from virtual_loop import VirtualLoop, run_virtual
from witness_config import sense, witness_config

STROKE = 100e-6  # m
SENSED_EVERY = 0.001  # s
_LONGEST = 5.0  # s; a planted bug may cause a deadlock
ALONE: Excitation = {"SW": Tone(110.0, 20e-6, math.pi / 2), "NE": Tone(150.0, 40e-6, -math.pi)}
SHARED: Excitation = {"SW": Tone(90.0, 30e-6, 0.0)}
WITNESSED = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")
"""Every kind of wire."""


class OneTable:
    """A table with one pattern for a single finger and one for more; both may be replaced."""

    def __init__(self, plate: Plate) -> None:
        self.plate = plate
        self.alone = ALONE
        self.shared = SHARED

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies of its tones [Hz]."""
        return np.array([90.0, 110.0, 150.0])

    def prepare(self, drive_mode: str) -> None:
        """Nothing to prepare."""

    def query(self, question: Question, over_effect: object = None) -> Pattern:
        """Select the pattern by the number of fingers."""
        excitation = self.shared if question.quiet else self.alone
        contrast = 12.0 if question.quiet else None
        return Pattern(excitation, 0.015, 20.0, contrast, None, question.drive_mode)

    def amplitudes(
        self, excitation: Excitation, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """1 m/s² at every point."""
        return np.array([110.0]), np.ones((1, len(points)))


def make_rig(amplifiers: Sequence[str], limits: GuardLimits) -> Rig:
    """Three ERAs on one amplifier, or NE on another; SE is never driven."""
    return Rig(
        plate=Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33)),
        mesh=Mesh(4, 4, 0.3, 0.2),
        eras=(
            Era("SW", 0.0, 0.0, 17_000.0, 1.0, 0.0, STROKE),
            Era("NE", 0.3, 0.2, 17_000.0, 1.0, 0.0, STROKE),
            Era("SE", 0.3, 0.0, 17_000.0, 1.0, 0.0, STROKE),
        ),
        wiring={
            "SW": Channel(amplifiers[0], 0),
            "NE": Channel(amplifiers[-1], 1),
            "SE": Channel(amplifiers[0], 2),
        },
        amplifiers=dict.fromkeys(amplifiers, "memory://"),
        limits=limits,
    )


@dataclass
class Chain:
    """A running chain and its witness; names of amplifiers as in the rig.

    delay [s]: of what goes to the host.
    """

    loop: VirtualLoop
    machine: MemoryMachine
    bench: Bench
    witness: Witness
    table: OneTable
    controller: Controller
    links: Mapping[str, str]
    errors: list[BaseException] = field(default_factory=list)
    running: "asyncio.Task[None] | None" = None
    fingers: tuple[int, ...] = ()
    holding: "asyncio.Task[None] | None" = None
    delay: float = 0.0
    _due: float = 0.0

    def __post_init__(self) -> None:
        """Delay what goes to the host, before the witness hears it."""
        deliver = self.machine.deliver

        def delayed(link: str, toward: str, data: bytes, to: Any) -> None:
            if toward == "host" and self.delay:
                # Timers of one moment fire in any order; bytes of one line stay in order.
                self._due = max(self._due + 1e-9, self.loop.time() + self.delay)
                self.loop.call_at(self._due, deliver, link, toward, data, to)
            else:
                deliver(link, toward, data, to)

        self.machine.deliver = delayed  # type: ignore[method-assign]

    @property
    def amplifier(self) -> Amplifier:
        """The first amplifier."""
        return next(iter(self.controller.amplifiers.values()))

    @property
    def link(self) -> str:
        """The wire of the first amplifier."""
        return next(iter(self.links.values()))

    async def rest(self, seconds: float) -> None:
        """Sleep for a time [s]."""
        if seconds:
            await asyncio.sleep(seconds)

    async def operate(self, command: OperatorCommand, *, rest: float = 0.0) -> None:
        """Carry out an operator's command, then sleep for `rest` [s]."""
        self.witness.operator_command(self.loop.time(), command)
        await self._try(getattr(self.controller, command)())
        await self.rest(rest)

    def run(self) -> None:
        """Start the control loop."""
        self.witness.set_stalled(self.loop.time(), False)
        self.running = asyncio.get_running_loop().create_task(self._try(self.controller.run()))

    async def hang(self) -> None:
        """Stall the control loop."""
        if self.running is not None:
            self.running.cancel()
            await asyncio.gather(self.running, return_exceptions=True)
        await self.rest(0.002)  # until bytes in flight are on the wire
        self.witness.set_stalled(self.loop.time())

    def touch_beside(self) -> None:
        """Deliver a touch beside the plate."""
        touches = (Touch(9, 1.3, 0.5),)
        self.controller.deliver(TouchFrame("test", self.loop.time(), touches))

    async def touch(self, *fingers: int, answerable: bool = True, rest: float = 0.0) -> None:
        """Replace the fingers on the plate, which the source repeats, then sleep for `rest` [s]."""
        self.fingers = fingers
        self.witness.expect(self.expected())
        self.witness.contacts(self.loop.time(), fingers, is_answerable=answerable)
        self._deliver()
        await self.rest(rest)

    def disturb(self, are_on: bool = True) -> None:
        """Notify the witness that faults of the first wire begin or end."""
        self.witness.faults(self.loop.time(), self.link, are_on=are_on)

    def expected(self) -> dict[str, dict[int, list[tuple[float, float, float]]]]:
        """Expected patterns on the wire, by hand: metres over 100 um, radians in degrees."""
        alone = {0: [(110.0, 0.2, 90.0)]}, {1: [(150.0, 0.4, 180.0)]}
        parts = alone if len(self.fingers) < 2 else ({0: [(90.0, 0.3, 0.0)]}, {})
        names = tuple(self.bench.amplifiers)
        if len(names) == 1:
            return {names[0]: {**parts[0], **parts[1]}}
        return {names[0]: parts[0], names[1]: parts[1]}

    async def reopen(self) -> None:
        """Close and reopen all, including the control loop."""
        self.witness.operator_command(self.loop.time(), "disarm")
        await self._try(self.controller.close())
        for link in {*self.links.values()}:
            self.witness.closed(link, self.loop.time())
        await self.rest(0.01)
        for link in {*self.links.values()}:
            self.witness.opened(link, self.loop.time())
        await self.controller.open()
        self.run()

    def trip(self) -> None:
        """Trip the first amplifier by an arc."""
        amplifier = next(iter(self.bench.amplifiers.values()))
        self.bench.advance(self.loop.time())
        amplifier.trip("ARC", self.loop.time())

    async def fall_silent(self) -> None:
        """Stop the source with fingers down: after its lease of 150 ms they count as lifted."""
        heard = self.loop.time()
        self._deliver()
        if self.holding is not None:
            self.holding.cancel()
        await self.rest(0.150)
        self.witness.contacts(heard + 0.150, ())

    def inject(self, data: bytes) -> None:
        """Inject bytes toward the amplifier on the first wire."""
        self.machine.deliver(
            self.link, "amplifier", data, self.machine._terminals[self.link].inward
        )

    async def _try(self, work: Awaitable[Any]) -> None:
        try:
            await work
        except Exception as error:
            self.errors.append(error)

    def _deliver(self) -> None:
        touches = tuple(Touch(number, 0.1 + 0.2 * number, 0.5) for number in self.fingers)
        self.controller.deliver(TouchFrame("test", self.loop.time(), touches))
        if self.holding is None:
            self.holding = asyncio.get_running_loop().create_task(self._hold())

    async def _hold(self) -> None:
        while True:
            await asyncio.sleep(0.05)
            self._deliver()


Scenario = Callable[[Chain], Awaitable[None]]


@dataclass(frozen=True)
class Outcome:
    """Violations, frames seen, and errors raised to the caller."""

    found: list[Violation]
    frames: int
    errors: list[BaseException]


def play(
    wire: str,
    scenario: Scenario,
    *,
    amplifiers: Sequence[str] = ("main",),
) -> Outcome:
    """Play a scenario to its end on a wire of this kind; returns the outcome."""
    probe = _Probe()
    main = _play(wire, scenario, amplifiers, probe)
    return run_virtual(main, rng=random.Random(1), seen=probe.seen)


class _Probe:
    """Passes bytes of the loop's network to the witness, buffered until it exists."""

    def __init__(self) -> None:
        self.witness: Witness | None = None
        self.early: list[tuple[float, str, str, bytes]] = []

    def seen(self, link: str, toward: str, data: bytes) -> None:
        """Record bytes on a link."""
        if self.witness is None:
            self.early.append((clock.now(), link, toward, data))
        else:
            self.witness.record_bytes(link, toward, clock.now(), data)  # type: ignore[arg-type]


async def _play(
    wire: str,
    scenario: Scenario,
    names: Sequence[str],
    probe: _Probe,
) -> Outcome:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    machine = live_in_memory()
    rig = make_rig(names, GuardLimits(40.0, 500.0, 0.5))
    bench = Bench(rig, now=loop.time())
    devices = [
        AmplifierDevice(bench, name, address=number)
        for number, name in enumerate(bench.amplifiers, 1)
    ]
    async with open_wire(Wire(wire), devices) as urls:
        config = witness_config(urls, channels=3, times_s={}, level=0.5, slew_per_s=100)
        links = {name: amplifier["wire"] for name, amplifier in config["amplifiers"].items()}
        probe.witness = witness = Witness(config)
        for link in {*links.values()}:
            witness.opened(link, loop.time())
        witness.contacts(loop.time(), ())
        table = OneTable(rig.plate)
        controller = Controller(
            rig, table, lines=Lines, intent_source=BuzzNewestContact(), urls=urls
        )
        chain = Chain(loop, machine, bench, witness, table, controller, links)
        async with _sensed(chain):
            await chain._try(controller.open())
            if not chain.errors:
                chain.run()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_LONGEST):
                        await chain._try(scenario(chain))
            await _end(chain)
        for device in devices:
            device.close()
    return Outcome(witness.finish(loop.time()), witness.frames, chain.errors)


async def _end(chain: Chain) -> None:
    if chain.holding is not None:
        chain.holding.cancel()
    if chain.fingers:
        chain.witness.contacts(chain.loop.time(), ())
    chain.witness.operator_command(chain.loop.time(), "disarm")
    await chain._try(chain.controller.close())
    for link in {*chain.links.values()}:
        chain.witness.closed(link, chain.loop.time())
    if chain.running is not None:
        chain.running.cancel()
        await asyncio.gather(chain.running, return_exceptions=True)


@asynccontextmanager
async def _sensed(chain: Chain) -> AsyncIterator[None]:
    """Sensors on every channel, a thousand times a second."""

    async def keep_sensing() -> None:
        while True:
            now = chain.loop.time()
            chain.bench.advance(now)
            for name, amplifier in chain.bench.amplifiers.items():
                sense(chain.witness, now, name, amplifier)
            await asyncio.sleep(SENSED_EVERY)

    task = asyncio.get_running_loop().create_task(keep_sensing())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
