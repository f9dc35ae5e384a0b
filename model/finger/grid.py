"""Grid of target cells over the plate."""

from dataclasses import dataclass

import numpy as np

from model.arguments import is_whole
from model.arrays import FloatArray, lattice
from model.errors import InputError
from model.structure.plate import Plate


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
        x = (np.arange(self.nx) + 0.5) * plate.length / self.nx
        return lattice(x, (np.arange(self.ny) + 0.5) * plate.width / self.ny)
