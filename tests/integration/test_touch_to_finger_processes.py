"""From touches over UDP to what each finger felt, over every wire, in processes as users run them.

Of all checks those that do not depend on how fast the machine is; in virtual time all hold.
"""

from pathlib import Path

import numpy as np
import pytest

from felt_assertions import CHECKS, Truth
from long_form import shortly
from model.finger.grid import Grid
from model.rig.file import load_rig
from model.table.build import build_table
from model.table.file import save_table
from rig_files import write_rig
from touch_stream import Stream
from whole_chain import running_chain

pytestmark = pytest.mark.real_time

WIRES = ("serial", "modbus-tcp", "modbus-rtu", "slcan", "socketcand", "sim")
STREAM = Stream(
    {"B": (0.04, 0.17), "C": (0.16, 0.19), "D": (0.05, 0.05)},
    [
        (0.0, {1: "B", 2: "C"}),
        (1.0, {1: "B"}),
        (2.0, {}),
        (3.0, {}),
    ],  # each lasts as long as it takes
)
TIMELESS = (
    "patterns_match_table",
    "plate_response_matches_model",
    "localization_matches_prediction",
    "plate_decays",
    "all_is_off_in_the_end",
)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """The true rig and its table, without the chain."""
    rig = load_rig(write_rig(tmp_path_factory.mktemp("truth") / "rig.yaml", mesh="auto"))
    table = build_table(rig, frequencies=np.arange(80.0, 321.0, 40.0), grid=Grid(4, 3))
    return Truth(rig, table, STREAM)


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial"]))
async def test_processes_make_fingers_feel_the_commanded_pattern(
    wire: str, truth: Truth, tmp_path: Path
) -> None:
    """Over every wire; the daemon ends without an error."""
    save_table(truth.table, tmp_path / "table.npz")
    async with running_chain(tmp_path, wire, table=tmp_path / "table.npz") as chain:
        played, status = await chain.play(STREAM)
    assert status == 0
    for check in TIMELESS:
        CHECKS[check](played, truth)
