"""Days of amplifiers on every kind of wire, of which the witness finds nothing."""

import random
import re
from dataclasses import replace
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from chain import SCENARIOS, WITNESSED, play
from group_stops import RandomGroup
from long_form import in_turn, shortly
from plate_witness import RULES
from sim.far_ends.wire_assignment import Wire
from virtual_lines import run_virtual

KINDS = {
    "can": Wire("slcan", 500_000),
    "serial": Wire("serial", 921_600, shared=True),
    "rtu": Wire("modbus-rtu", 460_800),  # a set is read back between two heartbeats
    "tcp": Wire("modbus-tcp"),
}
LINES = ("shared", "each its own")


def live(kind: str, lines: str, seed: int, *, lossy_steps: int = 0) -> None:
    """Have two amplifiers live a random day on a kind of wire, and ask the witness."""
    rng = random.Random(seed)
    wire = KINDS[kind]
    alone = {name: replace(wire, line=name, shared=False) for name in ("a", "b")}
    wires = dict.fromkeys(("a", "b"), wire) if lines == "shared" else alone

    async def run() -> None:
        async with RandomGroup.of(wires, rng) as chain:
            await chain.live(40, lossy_steps=lossy_steps)
            await chain.close()
            chain.judge()
            assert chain.witness.frames > 200

    run_virtual(run(), rng=rng)


@pytest.mark.parametrize("seed", shortly(range(12), [1, 7, 11]))
@pytest.mark.parametrize(("kind", "lines"), in_turn(KINDS, LINES))
def test_witness_finds_nothing_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    live(kind, lines, seed)


@pytest.mark.parametrize("seed", shortly(range(8), [1]))
@pytest.mark.parametrize(("kind", "lines"), in_turn(KINDS, LINES))
def test_witness_excuses_lost_and_doubled_frames(kind: str, lines: str, seed: int) -> None:
    """Both sides bear them as the decision says, and half a second later all rules hold again."""
    live(kind, lines, seed, lossy_steps=25)


ROOT = Path(__file__).parents[4]
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
    """Each rule, of the page or of the plate, has one that the witness must report as broken.

    But for damage, which one codec for both sides hides, and for identified, since a host that does
    not identify an amplifier has no limits to play by: conversations written by hand break them.
    """
    faults, page = ROOT / "tests" / "faults", ROOT / "docs" / "reference" / "witness.md"
    rules = page.read_text(encoding="utf-8").partition("## The rules")[2].partition("## In tests")
    planted = [
        fault
        for area in sorted(faults.glob("*.yaml"))
        for fault in YAML(typ="safe").load(area)
        if any("tests/drivers/judge/watching" in test for test in fault["found_by"])
    ]
    shown = {fault["shows"].removesuffix(": ") for fault in planted if "shows" in fault}
    listed = set(re.findall(r"^\| (\w+) \|", rules[0], flags=re.M))
    assert shown == listed - {"name", "damage", "identified"} | RULES.keys()
