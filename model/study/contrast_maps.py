"""The contrast of a finger at every position of a plate to the same quiet fingers."""

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
    """Contrast between a finger at each position and the same quiet fingers, by drive mode."""

    x: FloatArray
    """Positions (nx,) along x [m]."""
    y: FloatArray
    """Positions (ny,) along y [m]."""
    quiet: tuple[Point, ...]
    """Positions of the quiet fingers [m]."""
    promised_db: dict[str, FloatArray]
    """Promised felt contrast (ny, nx), on 90 % of plates, by drive mode.

    NaN where the level is not reached, and under a quiet finger.
    """
    nominal_db: dict[str, FloatArray]
    """The same on the nominal plate."""

    def __repr__(self) -> str:
        modes = ", ".join(self.promised_db)
        return f"<ContrastMap of {len(self.x)} x {len(self.y)} places, {modes}>"

    @property
    def columns(self) -> Columns:
        """Positions and contrasts as columns with one row per position, x changing first."""
        x, y = np.meshgrid(self.x, self.y)
        columns = {"x_m": x.ravel(), "y_m": y.ravel()}
        for mode, contrasts in self.promised_db.items():
            columns[f"{mode}_promised_db"] = contrasts.ravel()
        for mode, contrasts in self.nominal_db.items():
            columns[f"{mode}_nominal_db"] = contrasts.ravel()
        return columns

    def to_frame(self) -> Any:
        """Return the columns of `era table map -o FILE.csv` as a pandas DataFrame; needs pandas."""
        return as_frame(self.columns)

    def as_json(self) -> dict[str, Any]:
        """Return the map as JSON, one row per y; null if there is no answer."""
        return {
            "x_m": self.x.tolist(),
            "y_m": self.y.tolist(),
            "quiet_m": [list(position) for position in self.quiet],
            "promised_contrast_db": _nullable_by_mode(self.promised_db),
            "nominal_contrast_db": _nullable_by_mode(self.nominal_db),
        }


def _nullable_by_mode(contrasts_by_mode: dict[str, FloatArray]) -> dict[str, Any]:
    return {mode: nullable(contrasts) for mode, contrasts in contrasts_by_mode.items()}


def map_contrast(
    table: LocalizationTable,
    quiet: Sequence[Point],
    *,
    drive_modes: Sequence[str] = (),
    level_db_sl: float = STRONG_DB_SL,
    grid: Grid | None = None,
    progress: Progress = unseen,
) -> ContrastMap:
    """Query a table for a finger at every position of a grid, by default its own cells.

    quiet: positions [m] of the fingers that must not feel it; drive_modes: empty for the table's
    mode; progress: called with the number of finished positions, and the total. Raises
    InputError for quiet fingers that no question can have, and for an unknown drive mode.
    """
    if not quiet:
        raise InputError("a map of contrast must have at least one quiet finger, got none")
    quiet_contacts = tuple(quiet)
    grid = grid or table.grid
    modes = tuple(map(checked_mode, drive_modes)) or (table.drive_mode,)
    centers = grid.centers(table.plate)
    questions: list[tuple[int, int, Placement]] = []
    for cell, (x, y) in enumerate(centers.tolist()):
        nearest = min(math.dist((x, y), contact) for contact in quiet_contacts)
        if nearest < FINGERTIP_RADIUS or not table.plate.contains(x, y):
            continue
        placed = Placement(((x, y),), quiet_contacts)
        questions.extend((row, cell, placed) for row in range(len(modes)))
    check_on_plate("quiet finger", quiet_contacts, table.plate)
    contrasts = np.full((len(modes), 2, grid.cell_count), np.nan)
    for done, (row, cell, placed) in enumerate(questions, start=1):
        answer = contrasts_of(table, placed, level_db_sl, modes[row])
        if answer is not None:
            contrasts[row, :, cell] = answer
        progress(done, len(questions))
    fields = contrasts.reshape(len(modes), 2, grid.ny, grid.nx)
    return ContrastMap(
        x=centers[: grid.nx, 0],
        y=centers[:: grid.nx, 1],
        quiet=quiet_contacts,
        promised_db={mode: fields[row, 0] for row, mode in enumerate(modes)},
        nominal_db={mode: fields[row, 1] for row, mode in enumerate(modes)},
    )
