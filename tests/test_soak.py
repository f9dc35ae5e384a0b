"""The soak: the whole chain in virtual time, reproducible, and sensitive to bugs."""

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultWindow
from sim.transport.simulated_line import PROMPT
from soak_runs import (
    KINDS,
    FaultInjection,
    OperatorAction,
    Plan,
    TouchSequence,
    run_plan,
)


def digests() -> dict[str, str]:
    """The digest of a plan's trace, on a line and on a bus."""
    return {wire: digest(held(wire=wire)) for wire in ("serial", "slcan")}


def digest(plan: Plan) -> str:
    """The digest of a plan's trace."""
    trace: list[str] = []
    run_plan(plan, trace=trace)
    return hashlib.sha256("".join(trace).encode()).hexdigest()


@pytest.mark.long
def test_soak_trace_is_the_same_in_every_process() -> None:
    """Neither hash seeds nor earlier runs change a byte of it; another seed does."""
    digests_here = digests()
    printed = subprocess.run(
        [sys.executable, "-c", "import test_soak; print(test_soak.digests())"],
        env={
            **os.environ,
            "PYTHONHASHSEED": "1",
            "PYTHONPATH": os.pathsep.join((*sys.path, str(Path(__file__).parent))),
        },
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert printed.strip() == str(digests_here)
    assert digest(replace(held(), seed=4)) not in digests_here.values()


def held(
    *faults: FaultInjection, wire: str = "serial", commands: tuple[OperatorAction, ...] = ()
) -> Plan:
    """A finger that stays for a second on the plate of one armed amplifier."""
    frames = [(number * 0.05, 0.0, ((1, 0.3, 0.4),)) for number in range(20)]
    sequence = TouchSequence(1.5, "hold", "panel", (*frames, (1.0, 0.0, ())))
    actions = (OperatorAction(0.5, "ready"), sequence, *faults, *commands)
    ordered = tuple(sorted(actions, key=lambda action: action.at))
    return Plan(3, (SimulatedWire(wire, KINDS[wire][0], line_kind=PROMPT),), 1, ordered, 4.0, 4.0)


PLANS = {
    "held on serial": held(),
    "held on modbus-tcp": held(wire="modbus-tcp"),
    "held on socketcand": held(wire="socketcand"),
    "unplugged": held(FaultInjection(2.0, 0, FaultWindow(fault="unplug", lasts=1.5))),
    "stopped": held(commands=(OperatorAction(1.8, "stop"), OperatorAction(2.6, "ready"))),
    "stalled": held(commands=(OperatorAction(1.8, "stall", 0.6),)),
}


@pytest.mark.parametrize("plan", PLANS)
def test_soak_plan_breaks_no_rule(plan: str) -> None:
    """Short plans, each of which breaks a rule once a fault of tests/faults is planted."""
    violations, _ = run_plan(PLANS[plan])
    assert not violations, "; ".join(violations)
