"""The witness finds nothing in the chain as it is; planted faults make it find their rule broken.

The chain is the real one, from a touch to the amplifiers' channels, over wires in memory and in
virtual time. The faults, each with the rule that must be reported: tests/faults.
"""

import inspect
import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import witness_scenarios
from witnessed_chain import WITNESSED, Scenario, play

ROOT = Path(__file__).parents[3]
SCENARIOS: dict[str, Scenario]
SCENARIOS = dict(inspect.getmembers(witness_scenarios, inspect.iscoroutinefunction))
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
