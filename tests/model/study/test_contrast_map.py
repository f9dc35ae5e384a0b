"""Maps of contrast to given quiet fingers, as a command, from Python and as a frame."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import era_haptics as era
from model.cli import app
from model.table.table_file import build_table
from plates import make_paper_rig

QUIET = (0.2286, 0.0381)  # m; centre of the fourth cell of the lowest row
MODES = ("switched", "phased")


@pytest.fixture(scope="module")
def table() -> era.LocalizationTable:
    """A small table of the paper's plate, cells of 61 x 76 mm."""
    return build_table(
        make_paper_rig(12, 9),
        frequencies=np.array([60.0, 110.0, 250.0]),
        grid=era.Grid(5, 3),
        drive_mode="phased",
    )


@pytest.fixture(scope="module")
def found(table: era.LocalizationTable) -> era.ContrastMap:
    """Both drive modes, side by side."""
    return era.contrast_map(table, QUIET, drive_modes=MODES)


def test_map_has_the_answer_of_every_place(
    table: era.LocalizationTable, found: era.ContrastMap
) -> None:
    """Promised and nominal contrast of a query there; none where the quiet finger itself is."""
    for row, y in enumerate(found.y):
        for column, x in enumerate(found.x):
            far = math.dist((x, y), QUIET) >= 0.013
            for mode in MODES:
                promised = found.promised_db[mode][row, column]
                assert np.isfinite(promised) == far
                if far:
                    felt = era.query(table, (x, y), quiet=[QUIET], drive_mode=mode).fingers[0]
                    assert promised == pytest.approx(felt.promised_contrast_db, abs=1e-3)
                    nominal = found.nominal_db[mode][row, column]
                    assert nominal == pytest.approx(felt.contrast_db, abs=1e-3)


def test_frame_has_a_row_a_place(found: era.ContrastMap) -> None:
    """As pandas has it: places along x first, a column for each mode and number."""
    frame = found.to_frame()
    assert frame.shape == (15, 6)
    best = frame.loc[frame["phased_promised_db"].idxmax()]
    row, column = np.unravel_index(np.nanargmax(found.promised_db["phased"]), (3, 5))
    assert (best["x_m"], best["y_m"]) == (found.x[column], found.y[row])


def test_command_prints_and_writes_the_map(
    table: era.LocalizationTable, found: era.ContrastMap, tmp_path: Path
) -> None:
    """JSON with null for no answer, a CSV file of a row a place, a PDF of the size in cm."""
    file = tmp_path / "t.npz"
    era.save_table(table, file)
    quiet = ["table", "map", str(file), "--quiet", f"{QUIET[0]},{QUIET[1]}"]
    both = [*quiet, "--modes", ",".join(MODES)]

    printed = json.loads(CliRunner().invoke(app, [*both, "--json"]).stdout)
    for mode in MODES:
        rows = np.array(printed["promised_contrast_db"][mode], dtype=float)
        assert rows == pytest.approx(found.promised_db[mode], abs=0.1, nan_ok=True)

    for name in ("map.csv", "map.pdf"):
        options = ["--size", "16x10"] if name.endswith("pdf") else []
        assert CliRunner().invoke(app, [*both, "-o", str(tmp_path / name), *options]).exit_code == 0
    assert (tmp_path / "map.csv").read_text().count("\n") == 16
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "map.pdf").read_bytes())
    assert box is not None
    points = [float(side) for side in box.groups()]
    assert points == pytest.approx([16 / 2.54 * 72, 10 / 2.54 * 72], abs=0.01)


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--quiet", "22,16"], "must be on the plate"),
        (["--quiet", "0.1,0.1", "--modes", "loud"], "drive mode"),
        (["--quiet", "0.1,0.1", "--size", "3"], "--size"),
        (["--quiet", "0.1,0.1", "-o", "m.xyz"], "must end in"),
    ],
)
def test_bad_input_is_refused(
    table: era.LocalizationTable, tmp_path: Path, options: list[str], cause: str
) -> None:
    """A finger off the plate, an unknown mode, a size without height, an unknown ending."""
    era.save_table(table, tmp_path / "t.npz")
    result = CliRunner().invoke(app, ["table", "map", str(tmp_path / "t.npz"), *options])
    assert isinstance(result.exception, era.InputError)
    assert cause in str(result.exception)
