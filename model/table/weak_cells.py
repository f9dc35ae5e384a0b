"""Where on the plate a target is told from other fingers, cell by cell, and where hardly.

For the centre of each cell as the target, the best contrast to another finger at random places (the
same for all cells and every time, those at least 5 cm away). A cell is *feasible* where the median
other finger is told from it by 12 dB at 20 dB SL: felt strongly, and what is turned down to be just
felt well, at 12 dB SL, is then at the other's threshold. It is *weak* where more than one other
finger in ten is not.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.errors import InputError
from model.finger.grid import Grid
from model.finger.perception import FELT_DB_SL, STRONG_DB_SL
from model.table.question import Question
from model.table.table import LocalizationTable

LEAST_DISTANCE = 0.05
"""Fingers of a contact set are at least this far apart [m]: fingertips of two hands."""

WANTED_CONTRAST_DB = FELT_DB_SL
WANTED_LEVEL_DB_SL = STRONG_DB_SL

STRATA = (4, 3)
"""Another finger is tried at a random place in each of so many equal parts of a quarter of the
plate, and at the mirror images of these places in both axes: the map of a symmetric plate is then
symmetric, and depends less on what was drawn than with places drawn freely."""

# A finer map takes longer and shows no more: weak places are as large as a quarter of a wave.
_FINEST = Grid(16, 12)


@dataclass(frozen=True, eq=False)
class WeakCells:
    """Contrast [dB] from each cell to the median other finger and to that of one in ten, (cells,).

    -inf where the level is not reached either, NaN on a plate too small for two fingers.
    """

    grid: Grid
    centres: FloatArray
    median_db: FloatArray
    tenth_db: FloatArray

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Which cells can be told from the median other finger."""
        return np.asarray(self.median_db >= WANTED_CONTRAST_DB)

    @property
    def weak(self) -> NDArray[np.bool_]:
        """Which cells cannot be told from more than one other finger in ten."""
        return np.asarray(self.tenth_db < WANTED_CONTRAST_DB)


def are_apart(contacts: FloatArray) -> bool:
    """Whether fingers at contacts (n, 2) [m], two or more, are all that far apart."""
    gaps = np.linalg.norm(contacts[:, None] - contacts, axis=-1)
    return bool(gaps[np.triu_indices(len(contacts), 1)].min() >= LEAST_DISTANCE)


def map_grid(table: LocalizationTable) -> Grid:
    """The cells that are asked about: the table's own, or fewer of a fine grid."""
    return Grid(min(table.grid.nx, _FINEST.nx), min(table.grid.ny, _FINEST.ny))


def find_weak_cells(
    table: LocalizationTable,
    *,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> WeakCells:
    """Ask the table about each cell, in its own mode; cells of a fine grid are taken together.

    progress: called with how many cells are done, of how many.
    """
    grid = map_grid(table)
    centres = grid.centres(table.plate)
    size = np.array([table.plate.length, table.plate.width])
    corner = np.stack(np.meshgrid(*(np.arange(n) for n in STRATA)), axis=-1).reshape(-1, 1, 2)
    drawn = np.random.default_rng(0).uniform(0, 1, corner.shape)
    drawn = (corner + drawn) / (2 * np.array(STRATA))
    mirrored = np.abs(drawn - [[0, 0], [1, 0], [0, 1], [1, 1]])
    places = size * mirrored.reshape(-1, 2)
    found = np.full((2, len(centres)), np.nan)
    for cell, centre in enumerate(centres):
        far = np.linalg.norm(places - centre, axis=1) >= LEAST_DISTANCE
        contrasts = [_contrast(table, centre, other) for other in places[far]]
        if contrasts:
            # Of a sample with -inf in it nothing can be interpolated.
            found[:, cell] = np.percentile(contrasts, [50, 10], method="inverted_cdf")
        progress(cell + 1, len(centres))
    return WeakCells(grid, centres, *found)


def text_map(weak: WeakCells) -> Iterator[str]:
    """The plate as lines of text, the largest y first: the median contrast, * where it is weak."""
    shape = (weak.grid.ny, weak.grid.nx)
    rows = zip(weak.median_db.reshape(shape), weak.weak.reshape(shape), strict=True)
    for median, marks in reversed(list(rows)):
        yield "".join(
            f"{'-' if not np.isfinite(value) else format(value, '.0f'):>4}{'*' if mark else ' '}"
            for value, mark in zip(median, marks, strict=True)
        ).rstrip()


def _contrast(table: LocalizationTable, target: FloatArray, other: FloatArray) -> float:
    """Contrast [dB] at the wanted level; -inf where that is not reached."""
    at, quiet = ((float(x), float(y)) for x, y in (target, other))
    question = Question((at,), (quiet,), level_db_sl=WANTED_LEVEL_DB_SL)
    try:
        contrast = table.query(question).contrast_db
    except InputError:
        return -np.inf
    return -np.inf if contrast is None else contrast
