"""From touches over UDP to what each finger felt, over every wire, in processes as users run them.

Of all checks those that do not depend on how fast the machine is; in virtual time all hold.
"""

import asyncio
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from felt_assertions import CHECKS, Truth
from felt_chain import Played
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


@pytest.fixture(scope="module")
def played(
    truth: Truth, tmp_path_factory: pytest.TempPathFactory
) -> Mapping[str, tuple[Played, int]]:
    """Results and the daemon's exit status by wire, two of them at a time."""
    return asyncio.run(play_all(tmp_path_factory.mktemp("wires"), truth))


async def play_all(folder: Path, truth: Truth) -> Mapping[str, tuple[Played, int]]:
    """Play the stream over each wire."""
    table = folder / "table.npz"
    save_table(truth.table, table)

    two_at_once = asyncio.Semaphore(2)  # beside six plates that are solved a watchdog elapses

    async def play(wire: str) -> tuple[Played, int]:
        (folder / wire).mkdir()
        async with two_at_once, running_chain(folder / wire, wire, table=table) as chain:
            return await chain.play(STREAM)

    return dict(zip(WIRES, await asyncio.gather(*map(play, WIRES)), strict=True))


@pytest.mark.parametrize("check", TIMELESS)
@pytest.mark.parametrize("wire", WIRES)
def test_processes_make_fingers_feel_the_commanded_pattern(
    played: Mapping[str, tuple[Played, int]], truth: Truth, wire: str, check: str
) -> None:
    """Over every wire; the daemon ends without an error."""
    result, status = played[wire]
    assert status == 0
    CHECKS[check](result, truth)
