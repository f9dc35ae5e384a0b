"""Days of amplifiers on every kind of wire, of which the witness finds nothing."""

import asyncio
import contextlib
import random
import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from drivers.contents import Layer, Tone
from drivers.errors import CommandRefused, Preempted
from drivers.host.group import Group
from drivers.host.jobs import Priority
from drivers.protocol.sets import Envelope
from listened_line import ListenedLine, witness_of
from long_form import in_turn, shortly
from random_group import RandomGroup
from sim.witness.capture import Violation
from virtual_loop import run_virtual
from witnessed_chain import SCENARIOS, WITNESSED, play
from words_line import KINDS

SWELL = Envelope(100, ((1000, 0), (3000, 0), (1000, 0)))
SLOW = Envelope(400, ((500, 0),))


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


LINES = {"shared": (("a", "b"),), "each its own": (("a",), ("b",))}


def play_group(
    kind: str, seed: int, *lines: tuple[str, ...], lossy_steps: int = 0, at_host: bool = False
) -> tuple[list[Violation], int]:
    """Return what a witness finds on lines of a kind, and how many frames it has seen."""
    named = {f"line{number}": (kind, names) for number, names in enumerate(lines)}
    witness = witness_of(named)

    async def run() -> None:
        ends = [
            ListenedLine(witness, name, kind, *names, at_host=at_host)
            for name, (_, names) in named.items()
        ]
        await RandomGroup(ends, random.Random(seed)).run(40, lossy_steps=lossy_steps)

    run_virtual(run())
    return witness.finish(), witness.frames


@pytest.mark.parametrize("seed", shortly(range(8), [0]))
@pytest.mark.parametrize(("kind", "lines"), in_turn(KINDS, [*LINES]))
def test_witness_finds_nothing_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    found, frames = play_group(kind, seed, *LINES[lines])
    assert not found, str(found[0])
    assert frames > 200


@pytest.mark.parametrize("seed", shortly(range(8), [1]))
@pytest.mark.parametrize(("kind", "lines"), in_turn(KINDS, [*LINES]))
def test_witness_excuses_lost_and_doubled_frames(kind: str, lines: str, seed: int) -> None:
    """Both sides bear them as the decision says, and half a second later all rules hold again."""
    found, frames = play_group(kind, seed, *LINES[lines], lossy_steps=25, at_host=True)
    assert not found, str(found[0])
    assert frames > 200


ROOT = Path(__file__).parents[3]
# Over RTU an answer begins within 10 ms, and nothing may be sent before it: 25 ms are a fault, and
# the stop that follows a fault is still under way when the operator clears.
# A finger that comes again before a set was carried out changes nothing.
NOT_OVER_RTU = {"slow", "arc", "hung", "hasty"}


def _played() -> list[tuple[str, str, int]]:
    """Each scenario, a wire and the amplifiers: on two wires each, the day on every wire."""
    wires: dict[str, tuple[str, ...]] = {"stranger": ("serial",)}
    wires |= dict.fromkeys(NOT_OVER_RTU, ("serial", "modbus-tcp", "socketcand", "slcan"))
    played = [("day", wire, amplifiers) for wire in WITNESSED for amplifiers in (1, 2)]
    played += [("arc", wire, 1) for wire in wires["arc"]]
    for number, name in enumerate(SCENARIOS):
        possible = wires.get(name, WITNESSED)
        played += [(name, wire, 1) for wire in (possible[0], possible[number % len(possible)])]
    return [*dict.fromkeys(played)]


@pytest.mark.parametrize(("scenario", "wire", "amplifiers"), _played())
def test_witness_finds_nothing_in_the_chain(scenario: str, wire: str, amplifiers: int) -> None:
    """Every scenario passes clean; amplifiers share a wire of a kind that can be shared."""
    chain, found = play(wire, SCENARIOS[scenario], amplifiers=("a", "b")[:amplifiers])
    broken = sorted({one.invariant for one in found})
    assert not broken, f"broken {', '.join(broken)}: {found[0]}"
    assert chain.errors == []
    assert chain.witness.frames > 5


def test_a_fault_is_planted_for_every_rule() -> None:
    """Each rule of the page has a fault that a test of the witness must report as broken.

    But for damage, which one codec for both sides hides, and for identified, since a host that does
    not identify an amplifier has no limits to play by: conversations written by hand break them.
    """
    faults, page = ROOT / "tests" / "faults", ROOT / "docs" / "reference" / "witness.md"
    rules = page.read_text(encoding="utf-8").partition("## The rules")[2].partition("## In tests")
    planted = [
        fault
        for area in sorted(faults.glob("*.yaml"))
        for fault in YAML(typ="safe").load(area)
        if any("tests/sim/witness" in test for test in fault["found_by"])
    ]
    shown = {fault["shows"].removesuffix(": ") for fault in planted if "shows" in fault}
    assert shown == set(re.findall(r"^\| (\w+) \|", rules[0], flags=re.M)) - {
        "name",
        "damage",
        "identified",
    }
