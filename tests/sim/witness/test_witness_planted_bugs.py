"""The witness finds every planted bug by the right rule, and nothing in the chain as it is.

The chain is the real one, from a touch to the amplifiers' channels, over wires in memory and in
virtual time.
"""

import inspect
import re
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

import witness_scenarios
from long_form import shortly
from planted_bugs import BUGS, CONTROLLER, DRIVERS, FAR_ENDS
from witnessed_chain import WITNESSED, Chain, play

SCENARIOS: dict[str, Callable[[Chain], Awaitable[None]]] = {
    name: scenario
    for name, scenario in inspect.getmembers(witness_scenarios, inspect.iscoroutinefunction)
    if not name.startswith("_") and name not in ("rough", "lossy")
}
RULES = {
    *("limits", "garbage", "enabled", "justified", "pattern", "lift", "touch", "commit", "token"),
    *("session", "voices"),
    *("stop", "heartbeat", "armed", "identified", "credit", "answer", "damage", "watchdog"),
    *("latched", "state", "ramp", "plays", "silent", "high_voltage", "constant", "faults"),
}
"""As docs/reference/witness.md lists them."""

SERIAL_ONLY = {"noise", "late_copy", "damaged_answer", "foreign_answer"}
# Over RTU an answer begins within 10 ms, and nothing may be sent before it: 25 ms are a fault.
NOT_OVER_RTU = {"slow_stop", "slow_lift", "slow_touch"}


def _played() -> list[tuple[str, str]]:
    """Each scenario and a wire on which it can be played, the day on all of them."""
    wires: dict[str, tuple[str, ...]] = {"incomplete_set": ("slcan",)}
    wires |= dict.fromkeys(SERIAL_ONLY, ("serial",))
    wires |= dict.fromkeys(NOT_OVER_RTU, ("serial", "modbus-tcp", "socketcand", "slcan"))
    played = [("day", wire) for wire in WITNESSED]
    for number, name in enumerate(SCENARIOS):
        possible = wires.get(name, WITNESSED)
        played.append((name, possible[number % len(possible)]))
    return [*dict.fromkeys(played)]


@pytest.mark.parametrize(("scenario", "wire"), _played())
def test_witness_finds_nothing_in_the_chain(scenario: str, wire: str) -> None:
    """Every scenario passes clean; the soak plays many more on every wire."""
    outcome = play(wire, SCENARIOS[scenario])
    assert [str(one) for one in outcome.found] == []
    assert outcome.errors == []
    assert outcome.frames > 5


@pytest.mark.parametrize("wire", WITNESSED)
def test_witness_finds_nothing_with_two_amplifiers(wire: str) -> None:
    """A day with two amplifiers, on one wire where the kind shares it, passes clean."""
    outcome = play(wire, witness_scenarios.day, amplifiers=("a", "b"))
    assert [str(one) for one in outcome.found] == []
    assert outcome.errors == []


@pytest.mark.parametrize("seed", shortly(range(3), [0]))
@pytest.mark.parametrize("wire", ["serial", "modbus-rtu", "slcan"])
def test_witness_excuses_noise(wire: str, seed: int) -> None:
    """Lost and damaged frames on a line are borne by both sides as the pages say."""
    scenario = witness_scenarios.lossy if wire == "slcan" else witness_scenarios.rough
    outcome = play(wire, scenario, seed=seed)
    assert [str(one) for one in outcome.found] == []


@pytest.mark.parametrize("seed", [3, 8])
def test_chain_ends_with_a_hardly_reachable_node(seed: int) -> None:
    """Nothing asks itself again and again in one moment, which the loop here calls stuck."""
    outcome = play("slcan", witness_scenarios.rough, seed=seed)
    assert outcome.frames > 5


@pytest.mark.parametrize("name", BUGS)
def test_witness_finds_a_planted_bug(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rule that this bug breaks is found broken."""
    bug = BUGS[name]
    bug.plant(monkeypatch)
    found = play(bug.wire, bug.scenario, amplifiers=bug.amplifiers).found
    broken = [one for one in found if one.invariant == bug.breaks]
    assert broken, [str(one) for one in found[:5]]
    assert broken[0].frames
    assert len(broken[0].sentence) > 20


def test_witness_page_lists_every_rule() -> None:
    """docs/reference/witness.md has a row for each rule, and no other."""
    page = (Path(__file__).parents[3] / "docs" / "reference" / "witness.md").read_text(
        encoding="utf-8"
    )
    rules = page.partition("## The rules")[2].partition("## In tests")[0]
    assert set(re.findall(r"^\| (\w+) \|", rules, flags=re.M)) - {"name"} == RULES


def test_planted_bugs_cover_every_rule() -> None:
    """Thirty at least, in controller, drivers and far ends alike, and every rule is among them."""
    assert len(BUGS) >= 30
    assert min(len(CONTROLLER), len(DRIVERS), len(FAR_ENDS)) >= 10
    assert {bug.breaks for bug in BUGS.values()} == RULES
