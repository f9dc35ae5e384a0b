"""The whole chain in virtual time: 160 seeds, the same each time, and it notices bugs."""

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from controller.loop.loop import Controller
from controller.loop.selection import Selector
from controller.sources.touch import TouchFrame
from drivers.backends.modbus.line import ModbusLine
from planted_bugs import BUGS as BUGS_OF_THE_WITNESS
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.far_ends.serial_end import SerialEnd
from sim.faults.fault_window import FaultWindow
from soak import outcomes, shrink
from soak_chain import run_plan
from soak_plan import (
    AMPLIFIER_FAULTS,
    KINDS,
    TELEGRAM_FAULTS,
    Ask,
    Hand,
    Line,
    Plan,
    Trouble,
    make_plan,
)

SEEDS = 160
SOAK = Path(__file__).parent / "support" / "soak.py"


def test_more_than_a_hundred_seeds_break_no_rule() -> None:
    """Every wire, every fault, every gesture: silence in time, nothing beyond, touches are felt.

    What was tried is counted, so that seeds under which nothing happens would show.
    """
    totals: Counter[str] = Counter()
    broken = {}
    for outcome, _ in outcomes((seed, True) for seed in range(SEEDS)):
        totals.update(outcome.counts)
        if outcome.violations:
            broken[f"{SOAK.name} --short --seed {outcome.seed}"] = outcome.violations
    assert broken == {}
    assert all(totals[f"fault {fault}"] for fault in (*TELEGRAM_FAULTS, *AMPLIFIER_FAULTS))
    assert all(totals[f"on {kind}"] >= SEEDS / 10 for kind in KINDS)
    assert totals["patterns"] > 10 * SEEDS
    assert totals["touches that must be felt"] > SEEDS / 10
    assert totals["links lost"] > SEEDS / 20


def digests() -> dict[str, str]:
    """The trace of one seed on every wire."""
    return {wire: run_plan(make_plan(11, wire, short=True)).digest for wire in KINDS}


def test_a_seed_is_the_same_in_every_process() -> None:
    """Not a byte differs on any wire, however strings are hashed there; of another seed it does.

    Nor does it matter whether anything was run before it in a process.
    """
    here = digests()
    said = subprocess.run(
        [sys.executable, "-c", "import test_soak" + "; print(test_soak.digests())" * 2],
        env={
            **os.environ,
            "PYTHONHASHSEED": "1",  # another than here, where it is by chance
            "PYTHONPATH": os.pathsep.join((str(SOAK.parent), str(Path(__file__).parent))),
        },
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert said.splitlines() == [str(here)] * 2
    assert len({*here.values(), run_plan(make_plan(12, "serial", short=True)).digest}) == 6


def test_a_trace_says_all_that_is_hashed(tmp_path: Path) -> None:
    """Touches, bytes both ways, the amplifier's states and patterns, each with its time."""
    path = tmp_path / "trace.txt"
    with path.open("w") as file:
        run_plan(held(wire="serial"), trace=file)
    words = {tuple(line.split()[1:2]) for line in path.read_text().splitlines()}
    assert words >= {("touch",), ("bytes",), ("amplifier",), ("pattern",), ("operator",)}
    times = [float(line.split()[0]) for line in path.read_text().splitlines()]
    assert times == sorted(times)


def held(*troubles: Trouble, wire: str = "serial", asks: tuple[Ask, ...] = ()) -> Plan:
    """A finger that stays for a second on the plate of one armed amplifier."""
    frames = [(number * 0.05, 0.0, ((1, 0.3, 0.4),)) for number in range(20)]
    hand = Hand(1.5, "hold", "panel", (*frames, (1.0, 0.0, ())))
    actions = (Ask(0.5, "ready"), hand, *troubles, *asks)
    ordered = tuple(sorted(actions, key=lambda action: action.at))
    return Plan(3, (Line(wire, KINDS[wire][0]),), 1, ordered, 4.0, 4.0)


def _never(*_: Any) -> float:
    return float("inf")


def _deaf_to_lifts(deliver: Callable[..., None]) -> Callable[..., None]:
    def deafly(controller: Controller, frame: TouchFrame) -> None:
        if frame.touches:
            deliver(controller, frame)

    return deafly


BUGS: dict[str, tuple[Any, str, Any, Plan, str]] = {
    "an amplifier without a watchdog": (
        SimulatedAmplifier,
        "_watchdog_end",
        property(_never),
        held(Trouble(2.0, 0, FaultWindow("unplug", lasts=1.5))),
        "after it was fed",
    ),
    "lifts that get lost": (
        Controller,
        "deliver",
        _deaf_to_lifts(Controller.deliver),
        held(),
        "after the last finger",
    ),
    "a choice that fails": (Selector, "select", lambda *_: 1 / 0, held(), "logged"),
    "an answer nobody takes": (
        ModbusLine,
        "_received",
        lambda link, data: None,
        held(wire="modbus-tcp"),
        "could not be opened",
    ),
    "a far end that stumbles": (
        SerialEnd,
        "_answer",
        lambda end, frame, device: 1 / 0,
        held(),
        "unhandled",
    ),
}


@pytest.mark.parametrize("name", BUGS)
def test_bugs_are_noticed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What breaks a rule is told; the same plan breaks none without the bug."""
    owner, attribute, bug, plan, violation = BUGS[name]
    assert run_plan(plan).violations == []
    monkeypatch.setattr(owner, attribute, bug)
    assert violation in "; ".join(run_plan(plan).violations)


STOPPED = held(asks=(Ask(1.8, "stop"), Ask(2.6, "ready")))
STALLED = held(asks=(Ask(1.8, "stall", 0.6),))

WITNESSED = {
    "heartbeats are too rare": held(),
    "every set has the same token": held(),
    "no amplifier is identified": held(),
    "a commit reaches one channel only": held(),
    "a ramp is ignored": held(),
    "its channels vibrate at half the frequency": held(),
    "every answer is sent twice": held(),
    "a command has the sequence number before": held(wire="socketcand"),
    "a stop is sent as a disarm": STOPPED,
    "a stop is not latched": STOPPED,
    "a status request feeds the watchdog": held(),
    "the watchdog is 20 ms early": STALLED,
}


@pytest.mark.parametrize("name", WITNESSED)
def test_the_witness_finds_planted_bugs_in_the_soak(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is shown the wires of every run: by its rule a run fails that is fine without the bug."""
    plan = WITNESSED[name]
    assert run_plan(plan).violations == []
    BUGS_OF_THE_WITNESS[name].plant(monkeypatch)
    found = run_plan(plan).violations
    assert any(f" {BUGS_OF_THE_WITNESS[name].breaks}: " in violation for violation in found), found


def test_what_is_not_needed_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a plan that fails, shrinking leaves what makes it fail: to arm, and the finger."""
    plan = held(
        Trouble(3.7, 0, FaultWindow("delay", lasts=0.1, delay=0.002)),
        asks=(Ask(3.8, "disarm"), Ask(3.9, "clear")),
    )
    monkeypatch.setattr(Controller, "deliver", _deaf_to_lifts(Controller.deliver))
    smaller, kept = shrink(plan)
    assert [type(action) for action in smaller.actions] == [Ask, Hand]
    assert [plan.actions[number] for number in kept] == list(smaller.actions)
    assert smaller.actions[0] == Ask(0.5, "ready")
