"""Grid of target cells over the plate."""

from dataclasses import dataclass

import numpy as np

from model.arguments import is_whole
from model.arrays import FloatArray
from model.errors import InputError
from model.structure.plate import Plate

# Points per side at which a cell of the grid is sampled; five put them 5 mm apart on the paper's
# plate, a fiftieth of the shortest bending wavelength that a table holds.
CELL_SAMPLES = 5


@dataclass(frozen=True)
class Grid:
    """Target cells: nx by ny equal rectangles over the plate, numbered along x first."""

    nx: int
    ny: int

    def __post_init__(self) -> None:
        """Refuse a grid without cells or with too many."""
        if not (is_whole(self.nx) and is_whole(self.ny)):
            raise InputError(f"grid: numbers of cells must be integers, got {self}")
        if not (1 <= self.nx <= 200 and 1 <= self.ny <= 200):
            raise InputError(f"grid must be 1x1 to 200x200 cells, got {self}")

    def __str__(self) -> str:
        return f"{self.nx}x{self.ny}"

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.nx * self.ny

    def centres(self, plate: Plate) -> FloatArray:
        """Centres of the cells [m], (cell_count, 2)."""
        return self._points(plate, samples=1)

    def samples(self, plate: Plate) -> FloatArray:
        """Points [m] spread evenly, cell after cell, (cell_count * CELL_SAMPLES², 2)."""
        return self._points(plate, samples=CELL_SAMPLES)

    def _points(self, plate: Plate, *, samples: int) -> FloatArray:
        inside = (np.arange(samples) + 0.5) / samples
        cell_y, cell_x, sample_y, sample_x = np.meshgrid(
            np.arange(self.ny), np.arange(self.nx), inside, inside, indexing="ij"
        )
        x = (cell_x + sample_x) * plate.length / self.nx
        y = (cell_y + sample_y) * plate.width / self.ny
        return np.column_stack([x.ravel(), y.ravel()])
