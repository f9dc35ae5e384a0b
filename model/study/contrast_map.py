"""Contrast from every place of the plate to given quiet fingers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.answer.stimulus import Placement, check_on_plate
from model.arrays import FloatArray, Point, nullable
from model.drive_modes import checked_mode
from model.errors import InputError
from model.files.csv_file import Columns, as_frame
from model.finger import FINGERTIP_RADIUS, STRONG_DB_SL, Grid
from model.processes import Progress, unseen
from model.study.weak_cells import contrasts_of
from model.table.table import LocalizationTable


@dataclass(frozen=True, eq=False)
class ContrastMap:
    """Contrast of a finger at every place to the same quiet fingers, by drive mode.

    x (nx,), y (ny,) [m]: of the places; quiet [m]; promised_db, nominal_db: felt contrast [dB] that
    nine of ten plates within the rig's uncertainty give, and of the nominal plate, each (ny,
    nx), NaN where the level is not reached and under a quiet finger.
    """

    x: FloatArray
    y: FloatArray
    quiet: tuple[Point, ...]
    promised_db: dict[str, FloatArray]
    nominal_db: dict[str, FloatArray]

    def __repr__(self) -> str:
        modes = ", ".join(self.promised_db)
        return f"<ContrastMap of {len(self.x)} x {len(self.y)} places, {modes}>"

    @property
    def columns(self) -> Columns:
        """Places and contrasts as columns of one row a place, x changing first."""
        x, y = np.meshgrid(self.x, self.y)
        return {
            "x_m": x.ravel(),
            "y_m": y.ravel(),
            **{f"{mode}_promised_db": of.ravel() for mode, of in self.promised_db.items()},
            **{f"{mode}_nominal_db": of.ravel() for mode, of in self.nominal_db.items()},
        }

    def to_frame(self) -> Any:
        """The columns of `era table map -o FILE.csv` as a pandas DataFrame; needs pandas."""
        return as_frame(self.columns)

    def as_json(self) -> dict[str, Any]:
        """The map for programs, one row per y; null where there is no answer."""
        return {
            "x_m": self.x.tolist(),
            "y_m": self.y.tolist(),
            "quiet_m": [list(at) for at in self.quiet],
            "promised_contrast_db": {mode: nullable(of) for mode, of in self.promised_db.items()},
            "nominal_contrast_db": {mode: nullable(of) for mode, of in self.nominal_db.items()},
        }


def map_contrast(
    table: LocalizationTable,
    quiet: Sequence[Point],
    *,
    drive_modes: Sequence[str] = (),
    level_db_sl: float = STRONG_DB_SL,
    grid: Grid | None = None,
    progress: Progress = unseen,
) -> ContrastMap:
    """Ask a table for a finger at every place of a grid, by default its cells.

    quiet [m]: one finger or more that must not feel it; drive_modes: the table's own for none;
    progress: called with the number of finished places, and the total. Raises InputError for quiet
    fingers that no question may have, and for an unknown drive mode.
    """
    if not quiet:
        raise InputError("a map of contrast must have at least one quiet finger, got none")
    fingers = tuple(quiet)
    grid, modes = grid or table.grid, tuple(map(checked_mode, drive_modes)) or (table.drive_mode,)
    centres = grid.centres(table.plate)
    questions = {
        (row, cell): Placement((at,), fingers)
        for cell, at in enumerate((float(x), float(y)) for x, y in centres)
        if min(math.dist(at, finger) for finger in fingers) >= FINGERTIP_RADIUS
        for row in range(len(modes))
    }
    check_on_plate("quiet finger", fingers, table.plate)
    found = np.full((len(modes), 2, grid.cell_count), np.nan)
    for done, ((row, cell), placed) in enumerate(questions.items(), start=1):
        found[row, :, cell] = contrasts_of(table, placed, level_db_sl, modes[row]) or np.nan
        progress(done, len(questions))
    fields = found.reshape(len(modes), 2, grid.ny, grid.nx)
    return ContrastMap(
        centres[: grid.nx, 0],
        centres[:: grid.nx, 1],
        fingers,
        {mode: fields[row, 0] for row, mode in enumerate(modes)},
        {mode: fields[row, 1] for row, mode in enumerate(modes)},
    )
