"""From a touch stream to what each finger felt, over every wire and over two, by the same checks.

In virtual time, so that times are asserted as well as what is felt.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from felt_assertions import CHECKS, Truth
from felt_chain import Played, Stream, play_stream
from long_form import shortly
from model.finger.grid import Grid
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.table.build import build_table
from rig_files import TWO_AMPLIFIERS, write_rig

PLACES = {
    "A": (0.07, 0.06),
    "B": (0.04, 0.17),
    "C": (0.16, 0.19),
    "D": (0.05, 0.05),
    "E": (0.24, 0.08),
    "F": (0.26, 0.11),
}
STREAM = Stream(
    PLACES,
    [
        (0.1, {1: "B", 2: "C"}),  # two at once on a plate at rest: the second is the target
        (0.8, {1: "B", 2: "C", 3: "D", 4: "E"}),  # three are to be quiet
        (1.4, {1: "B", 2: "C", 3: "D", 4: "F"}),  # the target moves by 36 mm
        (2.0, {1: "B", 2: "C", 3: "D"}),  # it lifts: the one before is the target again
        (2.6, {}),  # the last up
        (2.9, {5: "A"}),  # one finger
        (3.5, {}),
        (3.8, {}),
    ],
)
SHORT = Stream(PLACES, [*STREAM.changes[:1], (0.8, {}), (1.1, {})])
"""Stream for the other wires, since the daemon's decisions do not depend on the wire."""

TURNS = Stream(
    {"A": (0.16, 0.20), "B": (0.25, 0.09), "C": (0.15, 0.05)},
    [
        (0.1, {1: "B", 2: "C"}),  # SW and SE, on one amplifier
        (1.0, {}),
        (1.3, {3: "A"}),  # NE and NW, on the other
        (2.0, {}),
        (2.5, {}),
    ],
)
"""Commits on two wires are apart by what the lines make of them: each pattern is of one of them."""

# In 10 ms Modbus RTU at 115 200 baud carries some 47 words and CAN at 500 kbit/s some 109. Four
# channels with an onset and room for an ending need 38 words, and 8 more for each knot.
KNOTS = {"modbus-rtu": 1, "slcan": 8, "socketcand": 8}
WIRES = ("serial", "modbus-tcp", "modbus-rtu", "slcan", "socketcand")
SHORTLY = ("serial", "modbus-rtu", "socketcand")


def truth_of(folder: Path, stream: Stream, *changes: tuple[str, str], **options: str) -> Truth:
    """The true rig and its table, without the chain; changes: in the rig's text."""
    rig = load_rig(write_rig(folder / "truth.yaml", *changes, mesh="auto"))
    table = build_table(rig, frequencies=np.arange(80.0, 321.0, 40.0), grid=Grid(4, 3))
    return Truth(rig, table, stream, **options)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """That of one amplifier."""
    return truth_of(tmp_path_factory.mktemp("truth"), STREAM)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """The rig as the controller and the plate have it."""
    return load_rig(write_rig(tmp_path_factory.mktemp("rig") / "rig.yaml"))


@pytest.fixture(scope="module")
def played(truth: Truth, rig: Rig) -> Callable[[str], Played]:
    """Result over a wire: of the full stream over the first, of the short one over the others."""

    @cache
    def over(wire: str) -> Played:
        stream = STREAM if wire == WIRES[0] else SHORT
        return play_stream(stream, {"main": wire}, rig, truth.table)

    return over


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("wire", shortly(WIRES, SHORTLY))
def test_fingers_feel_the_commanded_pattern(
    played: Callable[[str], Played], truth: Truth, wire: str, check: str
) -> None:
    """Every check passes over every wire."""
    CHECKS[check](played(wire), replace(truth, onset_knots=KNOTS.get(wire)))


def test_checks_detect_another_wiring(truth: Truth, rig: Rig) -> None:
    """Of a plate whose channels are swapped, those checks fail that see the plate."""
    plate = replace(rig, wiring={**rig.wiring, "SE": rig.wiring["NW"], "NW": rig.wiring["SE"]})
    played = play_stream(SHORT, {"main": "serial"}, rig, truth.table, plate=plate)
    failed = set()
    for name, check in CHECKS.items():
        try:
            check(played, replace(truth, stream=SHORT))
        except AssertionError:
            failed.add(name)
    assert failed >= {"plate_response_matches_model", "localization_matches_prediction"}


@pytest.fixture(scope="module")
def turns(tmp_path_factory: pytest.TempPathFactory) -> tuple[Played, Truth]:
    """What came of two amplifiers on two wires that take turns."""
    folder = tmp_path_factory.mktemp("turns")
    truth = truth_of(folder, TURNS, *TWO_AMPLIFIERS, drive_mode="switched")
    rig = load_rig(write_rig(folder / "rig.yaml", *TWO_AMPLIFIERS))
    wires = {"main": "serial", "side": "modbus-tcp"}
    return play_stream(TURNS, wires, rig, truth.table, drive_mode="switched"), truth


def test_amplifiers_take_turns(turns: tuple[Played, Truth]) -> None:
    """Two ERAs of one amplifier, then two of the other one."""
    played, truth = turns
    patterns = [pattern for heard in played.heard for pattern in heard.patterns]
    assert [
        {truth.rig.wiring[era].amplifier for era in pattern["drive"]} for pattern in patterns
    ] == [{"main"}, {"side"}]
    assert all(len(pattern["drive"]) == 2 for pattern in patterns)


@pytest.mark.parametrize("check", CHECKS)
def test_fingers_feel_the_commanded_pattern_over_two_wires(
    turns: tuple[Played, Truth], check: str
) -> None:
    """What holds over one wire holds where two amplifiers on two wires play together."""
    CHECKS[check](*turns)
