"""The daemon's supervisor over real wires in virtual time, whose amplifiers can be made to lie."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from controller.daemon.states import DaemonEvent, DaemonState, Trigger
from controller.daemon.supervisor import Supervisor
from controller.loop.loop import Controller
from controller.loop.observer import Observer
from controller.sources.touch import Touch, TouchFrame
from drivers.opening import Lines
from drivers.protocol.records import Values
from memory_machine import live_in_memory
from model.table.pattern import Pattern
from model.table.question import Question
from model.vibration.excitation import Tone
from registry.limits import GuardLimits
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire, open_wires
from straight_shapes import Shapes
from witnessed_chain import STROKE, OneTable, make_rig
from word_lies import Lie

WIRES = {
    "serial": Wire("serial", speed=921_600),
    "serial, shared": Wire("serial", speed=115_200, shared=True),
    "modbus-rtu": Wire("modbus-rtu", speed=115_200),
    "modbus-tcp": Wire("modbus-tcp"),
    "socketcand": Wire("socketcand", speed=500_000),
    "slcan": Wire("slcan", speed=500_000),
}
"""Every kind of wire; of two amplifiers one line or bus each kind but serial is shared."""

ENABLED = DaemonState.OPERATION_ENABLED
LEVELS = {"SW": 0.2, "NE": 0.4}
"""Commanded levels; SW is channel 0 of the first amplifier, NE channel 1 of the last one."""

SETTLES = 0.3  # s; from opening until it is ready


class Changing(OneTable):
    """A table whose pattern has another frequency for every question; SE plays at a weak level."""

    weak = 0.005
    asked = 0

    def query(self, question: Question, over_effect: object = None) -> Pattern:
        """Answer at 110, 111 or 112 Hz."""
        frequency = 110.0 + self.asked % 3
        self.asked += 1
        tones = {
            "SW": Tone(frequency, LEVELS["SW"] * STROKE, math.pi / 2),
            "NE": Tone(frequency, LEVELS["NE"] * STROKE, -math.pi / 4),
            "SE": Tone(frequency, self.weak * STROKE, math.pi / 3),
        }
        return Pattern(tones, 0.015, 20.0, None, None, question.drive_mode)


@dataclass
class SupervisedChain:
    """An armed daemon without its socket; causes: of every fault."""

    supervisor: Supervisor
    controller: Controller
    bench: Bench
    devices: list[AmplifierDevice]
    table: Changing
    causes: list[str] = field(default_factory=list)
    number: int = 0

    @property
    def state(self) -> DaemonState:
        """The daemon's state now."""
        return self.supervisor.machine.state

    def move(self) -> None:
        """Move the finger to the other one of two places."""
        self.number += 1
        self.touch()

    def touch(self) -> None:
        """Repeat the finger."""
        now = asyncio.get_running_loop().time()
        at = (0.2, 0.2) if self.number % 2 else (0.8, 0.8)
        self.controller.deliver(TouchFrame("test", now, (Touch(1, *at),)))

    def lift(self) -> None:
        """Lift the finger."""
        now = asyncio.get_running_loop().time()
        self.controller.deliver(TouchFrame("test", now, ()))

    async def rest(self, seconds: float) -> None:
        """Send no frame for a time [s]."""
        await asyncio.sleep(seconds)

    async def play(self, seconds: float, *, interval: float, moves: bool) -> None:
        """Repeat a finger for a time [s], moved each time or not, while the daemon is armed."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while loop.time() < end and self.state is ENABLED:
            (self.move if moves else self.touch)()
            await asyncio.sleep(interval)

    def lie(self, lie: Lie, name: str) -> None:
        """Let an amplifier answer every request with this lie from now on."""
        device = next(device for device in self.devices if device.name == name)
        obey = device.handle

        def handle(asked: str, values: Values, now: float) -> Values:
            return lie(asked, obey(asked, values, now))

        device.handle = handle  # type: ignore[method-assign]

    def levels(self) -> Mapping[str, tuple[float, ...]]:
        """What the amplifiers play now."""
        now = asyncio.get_running_loop().time()
        self.bench.advance(now)
        return {name: each.summary(now).levels for name, each in self.bench.amplifiers.items()}


@asynccontextmanager
async def supervised_chain(
    wire: str, names: tuple[str, ...], *, shaped: bool = False
) -> AsyncIterator[SupervisedChain]:
    """A daemon over a wire, armed; shaped: whether its sets have envelopes."""
    loop = asyncio.get_running_loop()
    live_in_memory()
    rig = make_rig(names, GuardLimits(40.0, 500.0, 0.5))
    bench = Bench(rig, now=loop.time())
    devices = [AmplifierDevice(bench, name, address=at) for at, name in enumerate(names, 1)]
    async with open_wires(dict.fromkeys(names, WIRES[wire]), devices) as urls:
        causes: list[str] = []
        supervisor = Supervisor(
            state_changed=[
                lambda _, new: causes.append(new.cause) if "FAULT" in new.state.name else None
            ],
            link_changed=lambda change, lost, message: None,
            alive=lambda: None,
        )
        table = Changing(rig.plate)
        controller = Controller(
            rig,
            table,
            lines=Lines,
            urls=urls,
            connected=supervisor.connected,
            observer=supervisor.observe(Observer()),
            timing=Shapes() if shaped else None,
        )
        running = asyncio.create_task(supervisor.run(controller))
        await supervisor.started.wait()
        chain = SupervisedChain(supervisor, controller, bench, devices, table, causes)
        await asyncio.sleep(SETTLES)
        await supervisor.handle(DaemonEvent(Trigger.ARM, "test"))
        try:
            yield chain
        finally:
            with contextlib.suppress(Exception):
                await supervisor.close("end of the test")
            await running
            for device in devices:
                device.close()
