"""Pictures of a table against its numbers."""

from dataclasses import replace

import numpy as np
import pytest

from model.figures.table_pictures import (
    answer_figure,
    levels_figure,
    weak_cells_figure,
)
from model.finger.grid import Grid
from model.table.build import build_table
from model.table.weak_cells import WeakCells
from paper_plate import make_paper_rig
from small_table import small_table


@pytest.fixture(scope="module")
def table():
    """A small one."""
    return small_table()


def test_levels_figure_shows_each_cell(table):
    """The first row of colours is the lowest y, and no cell of this plate is crossed out."""
    axes = levels_figure(table).axes[0]
    (mesh,) = axes.collections
    np.testing.assert_array_equal(
        mesh.get_array().reshape(3, 4), table.available_level_db_sl.reshape(3, 4)
    )
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert [len(line.get_xdata()) for line in crosses] == [0]


def test_weak_cells_figure_crosses_out_weak_cells(table):
    """Left those not feasible, right those weak; cells without a value are white."""
    weak = WeakCells(
        Grid(2, 1),
        np.zeros((2, 2)),
        median_db=np.array([20.0, 9.0]),
        tenth_db=np.array([11.0, -np.inf]),
        errors_db=np.zeros((2, 2)),
        pairs_db=np.empty((2, 0)),
    )
    left, right = weak_cells_figure(table, weak).axes[:2]
    crosses = [
        next(line for line in axes.lines if line.get_marker() == "x").get_xdata().tolist()
        for axes in (left, right)
    ]
    # Centres of two cells over 30.48 cm.
    assert crosses[0] == pytest.approx([22.86])
    assert crosses[1] == pytest.approx([7.62, 22.86])
    assert right.collections[0].get_array().mask.tolist() == [[False, True]]


def test_answer_figure_shows_field_and_fingers(table):
    """The field at the target's centre is near the level asked for, 20 dB SL; three fingers."""
    axes = answer_figure(table).axes[0]
    levels = axes.collections[0].get_array()
    rows, columns = levels.shape
    at_target = levels[round(0.35 * (rows - 1)), round(0.3 * (columns - 1))]
    assert at_target == pytest.approx(20.0, abs=2.0)
    assert len(axes.patches) == 3


def test_answer_figure_without_an_answer():
    """ERAs that move a nanometre have a picture without a field."""
    rig = make_paper_rig(12, 9)
    still = replace(rig, eras=tuple(replace(era, stroke=1e-9) for era in rig.eras))
    table = build_table(still, frequencies=np.array([110.0]), grid=Grid(2, 2))
    assert len(answer_figure(table).axes[0].collections) == 0
