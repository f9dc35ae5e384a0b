"""Hosts keep the rules for hosts on random days and in scenarios, on every kind of wire."""

import asyncio
import contextlib
import math
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from cases import shortly
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from drivers.protocol.records import Refusal
from drivers.protocol.sets import LayerSet, pack_layers
from group_stops import RandomGroup
from kit.clock import run_virtual
from kit.courses import Acted, courses, follow
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


def live(kind: str, lines: str, seed: int, *, lossy_steps: int = 0) -> None:
    """Drive two amplifiers through a random day on a kind of wire, and judge it."""
    rng = random.Random(seed)
    wire = KINDS[kind]
    alone = {name: replace(wire, line=name, shared=False) for name in ("a", "b")}
    wires = dict.fromkeys(("a", "b"), wire) if lines == "shared" else alone

    async def run() -> None:
        async with RandomGroup.of(wires, rng) as chain:
            await chain.live(40, lossy_steps=lossy_steps)
            await chain.close()
            chain.judge()
            assert chain.host_rules.requests > 100

    run_virtual(run(), rng=rng)


@pytest.mark.parametrize("seed", shortly(range(12), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["can", "rtu"]))
def test_rules_are_kept_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    live(kind, lines, seed)


@pytest.mark.parametrize("seed", shortly(range(8), [1]))
@pytest.mark.parametrize("lines", shortly(LINES, ["shared"]))
@pytest.mark.parametrize("kind", shortly(KINDS, ["serial", "tcp"]))
def test_rules_are_kept_after_lost_and_doubled_frames(kind: str, lines: str, seed: int) -> None:
    """Host and amplifiers recover, and half a second later all rules hold again."""
    live(kind, lines, seed, lossy_steps=25)


# Over RTU an answer begins within 10 ms, and nothing may be sent before it: 25 ms are a fault, and
# the stop that follows a fault is still under way when the operator clears.
# A finger that comes again before a set was carried out changes nothing.
NOT_OVER_RTU = {"slow", "arc", "hung", "hasty"}


ALL_WIRES = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")
"""Every kind of wire."""
SCENARIOS = courses(Path(__file__).with_name("scenarios.yaml"))
ALONE: Excitation = {"SW": Tone(110.0, 20e-6, math.pi / 2), "NE": Tone(150.0, 40e-6, -math.pi)}
SHARED: Excitation = {"SW": Tone(90.0, 30e-6, 0.0)}
_LONGEST = 5.0  # s; a planted bug may cause a deadlock


@dataclass
class Scene(Acted):
    """A chain whose source repeats its touches from the first on, until `holding` is cancelled."""

    holding: "asyncio.Task[None] | None" = None

    @property
    def amplifier(self) -> Amplifier:
        """The host of the first amplifier."""
        return next(iter(self.controller.amplifiers.values()))

    def fingers(self, *numbers: int, is_played: bool = True) -> None:
        """Replace the fingers on the plate; is_played: whether their pattern may be played.

        Patterns are by hand, of one finger or several: meters over 100 um, radians in degrees.
        """
        self.at = {number: (0.03 + 0.06 * number, 0.1) for number in numbers}
        first, second = {0: [(110.0, 0.2, 90.0)]}, {1: [(150.0, 0.4, 180.0)]}
        if len(numbers) > 1:
            first, second = {0: [(90.0, 0.3, 0.0)]}, {}
        parts = [first, second] if len(self.far.devices) > 1 else [first | second]
        expected = dict(zip(self.far.devices, parts, strict=True))
        self.must_be_felt = is_played
        self.host_rules.expected = expected if is_played else None
        self.report()
        if self.holding is None:
            self.holding = asyncio.create_task(self.hold(math.inf))

    def asks_for(self, frequency: float, level: float, phase: float | str = 0.0) -> None:
        """Touch where the table has this tone for one ERA, which may not be played."""
        self.table.excitation = {**ALONE, "NE": Tone(frequency, level * STROKE, float(phase))}
        self.fingers(1, is_played=False)

    def touches_beside(self) -> None:
        """Deliver a touch beside the plate."""
        self.deliver(TouchFrame("panel", threads.now(), (Touch(9, 1.3, 0.5),)))

    def trips(self) -> None:
        """Trip the first amplifier by an arc."""
        self.far.bench.advance(threads.now())
        self.far.amplifier.trip("ARC", threads.now())

    def injects(self, name: str, **values: Any) -> None:
        """Have another program send a request to the first amplifier."""
        with contextlib.suppress(Refusal):
            self.far.device.handle(name, values, threads.now())

    def another_is_silent(self) -> None:
        """Let another program send a set without levels."""
        stream = pack_layers([LayerSet(layer=0, ramp=200, valid_for=0)])
        head = {"session": 9, "token": 7, "index": 0, "parts": 1, "now": True}
        self.injects("Set", **head, stream=stream)

    def another_feeds(self) -> None:
        """Let another program send a heartbeat of its own session."""
        self.injects("Ping", session=self.amplifier.session % 65535 + 1, rate=0)


@asynccontextmanager
async def scene(*amplifiers: str, wire: str) -> AsyncIterator[Scene]:
    """A scene on a kind of wire, open; broken rules are reported before any other error."""
    rig = make_rig(amplifiers, GuardLimits(40.0, 500.0, 0.5))
    limits = ChannelLimits(channels=3, level=0.5, slew=100.0)
    async with Scene.on(
        SimulatedWire(wire),
        rig,
        SetTable(ALONE, rig.plate, SHARED),
        limits=limits,
        sensed_every=0.001,
    ) as chain:
        chain.is_felt = False
        chain.host_rules.set_contacts(())
        try:
            async with asyncio.timeout(_LONGEST):
                await chain.open()
                yield chain
                chain.holding.cancel()
                chain.host_rules.set_contacts(())
                await chain.close()
        finally:
            chain.judge()
        assert chain.host_rules.requests > 5


def _played() -> list[tuple[str, str, int]]:
    """Each scenario, a wire and the amplifiers: on two wires each, the day on every wire."""
    wires: dict[str, tuple[str, ...]] = {"stranger": ("serial",)}
    wires |= dict.fromkeys(NOT_OVER_RTU, ("serial", "modbus-tcp", "socketcand", "slcan"))
    played = [("day", wire, amplifiers) for wire in ALL_WIRES for amplifiers in (1, 2)]
    played += [("arc", wire, 1) for wire in wires["arc"]]
    for number, name in enumerate(SCENARIOS):
        possible = wires.get(name, ALL_WIRES)
        played += [(name, wire, 1) for wire in (possible[0], possible[number % len(possible)])]
    return [*dict.fromkeys(played)]


@pytest.mark.parametrize(("scenario", "wire", "amplifiers"), _played())
def test_rules_are_kept_in_scenario(scenario: str, wire: str, amplifiers: int) -> None:
    """Every scenario passes clean; amplifiers share a wire of a kind that can be shared."""
    course = {**SCENARIOS[scenario], "amplifiers": ("a", "b")[:amplifiers], "wire": wire}
    follow(course, scene, rng=random.Random(1))
