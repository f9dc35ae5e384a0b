"""Two amplifiers on two different wires under one plate, from a touch stream, in virtual time.

Commits on two wires are apart by what the lines make of them, so the fingers are where each
pattern is the work of one amplifier, and the other one takes its turn.
"""

import numpy as np
import pytest

from felt_assertions import CHECKS, Truth
from felt_chain import Played, play_stream
from model.finger.grid import Grid
from model.rig.file import load_rig
from model.table.build import build_table
from rig_files import TWO_AMPLIFIERS, write_rig
from touch_stream import Stream

STREAM = Stream(
    {"A": (0.16, 0.20), "B": (0.25, 0.09), "C": (0.15, 0.05)},
    [
        (0.1, {1: "B", 2: "C"}),  # SW and SE, on one amplifier
        (1.0, {}),
        (1.3, {3: "A"}),  # NE and NW, on the other
        (2.0, {}),
        (2.5, {}),
    ],
)
WIRES = {"main": "serial", "side": "modbus-tcp"}


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """The rig as it is meant, and its table, asked without any of the chain."""
    rig = load_rig(
        write_rig(tmp_path_factory.mktemp("truth") / "rig.yaml", *TWO_AMPLIFIERS, mesh="auto")
    )
    table = build_table(rig, frequencies=np.arange(80.0, 321.0, 40.0), grid=Grid(4, 3))
    return Truth(rig, table, STREAM, drive_mode="switched")


@pytest.fixture(scope="module")
def played(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Played:
    """What came of the stream."""
    rig = load_rig(write_rig(tmp_path_factory.mktemp("chain") / "rig.yaml", *TWO_AMPLIFIERS))
    return play_stream(STREAM, WIRES, rig, truth.table, drive_mode="switched")


def test_amplifiers_take_turns(played: Played, truth: Truth) -> None:
    """Two ERAs of one amplifier, then two of the other one."""
    patterns = [pattern for heard in played.heard for pattern in heard.patterns]
    assert [
        {truth.rig.wiring[era].amplifier for era in pattern["drive"]} for pattern in patterns
    ] == [{"main"}, {"side"}]
    assert all(len(pattern["drive"]) == 2 for pattern in patterns)


@pytest.mark.parametrize("check", CHECKS)
def test_fingers_feel_the_commanded_pattern_over_two_wires(
    played: Played, truth: Truth, check: str
) -> None:
    """What holds over one wire holds where two amplifiers on two wires play together."""
    CHECKS[check](played, truth)
