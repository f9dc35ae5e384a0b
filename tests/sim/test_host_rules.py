"""Hosts keep the rules for hosts on random days and in scenarios, on every kind of wire."""

import asyncio
import contextlib
import math
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import Any

import pytest

from cases import shortly
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.protocol.records import Refusal
from drivers.protocol.sets import LayerSet, pack_layers
from group_stops import RandomGroup
from kit.chain import Chain
from kit.clock import run_virtual
from kit.host_rules import ChannelLimits
from kit.set_table import STROKE, SetTable, make_rig
from model.vibration import Excitation, Tone
from registry import threads
from registry.limits import GuardLimits
from sim.far_ends.wire_assignment import SimulatedWire

KINDS = {
    "can": SimulatedWire("slcan", 500_000),
    "serial": SimulatedWire("serial", 921_600, shared=True),
    "rtu": SimulatedWire("modbus-rtu", 460_800),  # a set is read back between two heartbeats
    "tcp": SimulatedWire("modbus-tcp"),
}
LINES = ("shared", "each its own")


@pytest.mark.parametrize("seed", shortly(range(12), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["can", "rtu"]))
def test_rules_are_kept_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    rng = random.Random(seed)
    wire = KINDS[kind]
    alone = {name: replace(wire, line=name, shared=False) for name in ("a", "b")}
    wires = dict.fromkeys(("a", "b"), wire) if lines == "shared" else alone

    async def run() -> None:
        async with RandomGroup.of(wires, rng) as chain:
            await chain.live(40)
            await chain.close()
            chain.judge()
            assert chain.host_rules.requests > 100

    run_virtual(run(), rng=rng)


ALONE: Excitation = {"SW": Tone(110.0, 20e-6, math.pi / 2), "NE": Tone(150.0, 40e-6, -math.pi)}
"""The excitation for one finger."""
SHARED: Excitation = {"SW": Tone(90.0, 30e-6, 0.0)}
"""The excitation for several fingers."""
_LONGEST = 5.0  # s; a planted bug may cause a deadlock


@dataclass
class Scene(Chain):
    """A chain whose source repeats its touches from the first one on."""

    holding: "asyncio.Task[None] | None" = None
    """Repeats them, until it is cancelled."""

    @property
    def amplifier(self) -> Amplifier:
        """The host of the first amplifier."""
        return next(iter(self.controller.amplifiers.values()))

    async def fingers(self, *numbers: int, duration: float, is_played: bool = True) -> None:
        """Replace the fingers on the plate for a time [s].

        is_played: whether their pattern may be played. Patterns are by hand: levels are meters over
        100 um, phases radians in degrees.
        """
        self.at = {number: (0.03 + 0.06 * number, 0.1) for number in numbers}
        names = [*self.far.devices]
        if len(numbers) > 1:
            expected = {names[0]: {0: [(90.0, 0.3, 0.0)]}}
        elif len(names) > 1:
            expected = {names[0]: {0: [(110.0, 0.2, 90.0)]}, names[1]: {1: [(150.0, 0.4, 180.0)]}}
        else:
            expected = {names[0]: {0: [(110.0, 0.2, 90.0)], 1: [(150.0, 0.4, 180.0)]}}
        for name in names:
            expected.setdefault(name, {})
        self.must_be_felt = is_played
        self.host_rules.expected = expected if is_played else None
        self.report()
        if self.holding is None:
            self.holding = asyncio.create_task(self.hold(math.inf))
        await asyncio.sleep(duration)

    async def lift(self, duration: float) -> None:
        """Lift all fingers for a time [s]."""
        await self.fingers(duration=duration)

    async def ask_for(self, frequency: float, level: float, phase: float = 0.0) -> None:
        """Touch where the table asks one ERA for a tone that may not be played, then lift."""
        self.table.excitation = {**ALONE, "NE": Tone(frequency, level * STROKE, phase)}
        await self.fingers(1, duration=0.1, is_played=False)
        await self.lift(0.05)

    def trip(self) -> None:
        """Trip the first amplifier by an arc."""
        self.far.bench.advance(threads.now())
        self.far.amplifier.trip("ARC", threads.now())

    async def poll(self, times: int) -> None:
        """Read the status of the first amplifier every 20 ms."""
        for _ in range(times):
            await asyncio.sleep(0.02)
            await self.amplifier.read_status()

    def inject(self, name: str, **values: Any) -> None:
        """Have another program send a request to the first amplifier."""
        with contextlib.suppress(Refusal):
            self.far.device.handle(name, values, threads.now())


async def arc(scene: Scene) -> None:
    """An amplifier trips during a touch; its faults are read, it is cleared and identified."""
    await scene.controller.arm()
    await scene.fingers(1, duration=0.06)
    scene.trip()
    await scene.poll(5)
    await scene.amplifier.request("GetFaults", {})
    await scene.lift(0.1)
    await scene.controller.clear()
    await asyncio.sleep(0.05)
    await scene.amplifier.identify()
    scene.trip()
    await scene.amplifier.request("GetFaults", {})


async def day(scene: Scene) -> None:
    """Touches, a neighbor, a lift, a stop during a touch, clearing, arming, disarming."""
    await scene.controller.arm()
    await asyncio.sleep(0.12)
    await scene.fingers(1, duration=0.12)
    await scene.fingers(1, 2, duration=0.12)
    await scene.fingers(1, duration=0.05)
    await scene.lift(0.1)
    await scene.fingers(1, duration=0.1)
    await scene.lift(0.1)
    await scene.fingers(3, duration=0.1)
    await scene.controller.stop()
    await asyncio.sleep(0.1)
    await scene.lift(0.0)
    await scene.controller.clear()
    await scene.controller.arm()
    await scene.fingers(4, duration=0.06)
    await scene.controller.disarm()
    await asyncio.sleep(0.1)
    await scene.lift(0.0)


async def hasty(scene: Scene) -> None:
    """Other fingers touch every 4 ms, within the ramp of a pattern; then all is opened again."""
    await scene.controller.arm()
    await asyncio.sleep(0.12)
    for _ in range(5):
        await scene.fingers(1, duration=0.004)
        await scene.fingers(1, 2, duration=0.004)
    await asyncio.sleep(0.1)
    await scene.lift(0.06)
    await scene.close()
    await asyncio.sleep(0.01)
    await scene.open()
    await scene.controller.arm()
    await scene.fingers(1, duration=0.06)
    await scene.lift(0.05)


async def hung(scene: Scene) -> None:
    """The control loop stalls during a touch; a client polls the status, clears and rearms."""
    await scene.controller.arm()
    await scene.fingers(1, duration=0.1)
    scene.turning.clear()
    await scene.poll(20)
    await scene.lift(0.0)
    await scene.controller.clear()
    await asyncio.sleep(0.05)
    scene.turning.set()
    await scene.controller.arm()
    await scene.fingers(2, duration=0.06)
    await scene.lift(0.06)


async def slow(scene: Scene) -> None:
    """The last finger is lifted, then an amplifier is stopped, each before a late reply."""
    await scene.controller.arm()
    await asyncio.sleep(0.02)
    for far_end in scene.far_ends:
        far_end.delay(0.025)
    await scene.fingers(1, duration=0.001)
    await scene.lift(0.05)
    await scene.fingers(1, duration=0.001)
    await scene.controller.stop()
    await scene.lift(0.05)
    for far_end in scene.far_ends:
        far_end.delay(0.0)
    await asyncio.sleep(0.05)


async def source_dies(scene: Scene) -> None:
    """A finger off the plate is ignored; the source of touches dies with a finger down."""
    await scene.controller.arm()
    await asyncio.sleep(0.05)
    scene.deliver(TouchFrame("panel", threads.now(), (Touch(9, 1.3, 0.5),)))
    await scene.fingers(1, duration=0.1)
    assert scene.holding
    scene.holding.cancel()
    await asyncio.sleep(0.25)


async def stranger(scene: Scene) -> None:
    """Another program sends a silent set while disarmed, later a heartbeat of its own session."""
    await asyncio.sleep(0.1)
    stream = pack_layers([LayerSet(layer=0, ramp=200, valid_for=0)])
    scene.inject("Set", session=9, token=7, index=0, parts=1, now=True, stream=stream)
    await asyncio.sleep(0.01)
    await scene.controller.arm()
    await asyncio.sleep(0.05)
    await scene.fingers(1, duration=0.06)
    scene.inject("Ping", session=scene.amplifier.session % 65535 + 1, rate=0)
    await asyncio.sleep(0.01)
    await scene.lift(0.05)


async def too_much(scene: Scene) -> None:
    """The table asks for more than full level on one ERA, for 620 Hz, or for no number."""
    await scene.controller.arm()
    await scene.ask_for(150.0, 0.7)
    await scene.ask_for(620.0, 0.4)
    await scene.ask_for(150.0, 0.4, phase=math.nan)


@asynccontextmanager
async def open_scene(*amplifiers: str, wire: str) -> AsyncIterator[Scene]:
    """Open a scene on a kind of wire; broken rules are reported before any other error."""
    rig = make_rig(amplifiers, GuardLimits(40.0, 500.0, 0.5))
    limits = ChannelLimits(channels=3, level=0.5, slew=100.0)
    table = SetTable(ALONE, rig.plate, SHARED)
    async with Scene.on(
        SimulatedWire(wire), rig, table, limits=limits, sensed_every=0.001
    ) as scene:
        scene.is_felt = False
        scene.host_rules.set_contacts(())
        try:
            async with asyncio.timeout(_LONGEST):
                await scene.open()
                yield scene
                scene.holding.cancel()
                scene.host_rules.set_contacts(())
                await scene.close()
        finally:
            scene.judge()
        assert scene.host_rules.requests > 5


ALL_WIRES = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")


@pytest.mark.parametrize(
    ("scenario", "wire", "amplifiers"),
    [
        *((day, wire, amplifiers) for wire in ALL_WIRES for amplifiers in (1, 2)),
        # Over RTU a reply starts within 10 ms, before which nothing may be sent: 25 ms are a fault,
        # and the stop that follows a fault is still under way when the operator clears.
        *((arc, wire, 1) for wire in ("serial", "modbus-tcp", "socketcand", "slcan")),
        (hasty, "serial", 1),
        (hasty, "socketcand", 1),
        (hung, "serial", 1),
        (hung, "slcan", 1),
        (slow, "serial", 1),
        (slow, "modbus-tcp", 1),
        (source_dies, "serial", 1),
        (source_dies, "modbus-rtu", 1),
        (stranger, "serial", 1),
        (too_much, "serial", 1),
        (too_much, "modbus-rtu", 1),
    ],
)
def test_rules_are_kept_in_scenario(
    scenario: Callable[[Scene], Awaitable[None]], wire: str, amplifiers: int
) -> None:
    """Every scenario passes clean; amplifiers share a wire of a kind that can be shared."""

    async def run() -> None:
        async with open_scene(*("a", "b")[:amplifiers], wire=wire) as scene:
            await scenario(scene)

    run_virtual(run(), rng=random.Random(1))
