"""The cells of the plate, and the points at which they are sampled."""

import numpy as np

from model.finger.grid import CELL_SAMPLES, Grid
from model.structure.plate import Material, Plate

PLATE = Plate(0.6, 0.2, 0.002, Material("steel", 210e9, 7850.0, 0.3))


def test_grid_numbers_cells_along_x_first():
    """Three by two cells of 200 x 100 mm."""
    centres = [[x, y] for y in (0.05, 0.15) for x in (0.1, 0.3, 0.5)]
    np.testing.assert_allclose(Grid(3, 2).centres(PLATE), centres)


def test_grid_samples_cells_evenly():
    """Each cell in its turn: five by five points a fifth of a side apart, about its centre."""
    grid = Grid(3, 2)
    cells = grid.samples(PLATE).reshape(grid.cell_count, -1, 2)
    share = (np.arange(5) - 2) / 5
    offsets = [[dx * 0.2, dy * 0.1] for dy in share for dx in share]
    assert CELL_SAMPLES == 5
    for samples, centre in zip(cells, grid.centres(PLATE), strict=True):
        np.testing.assert_allclose(samples - centre, offsets, atol=1e-12)
