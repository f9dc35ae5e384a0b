"""A table of the paper's plate that is built in a moment."""

from dataclasses import replace
from functools import cache

import numpy as np

from model.finger import Grid
from model.table.table import LocalizationTable
from model.table.table_file import TableProblem, solve_table
from paper_plate import make_paper_rig

FREQUENCIES = np.array([60.0, 110.0, 250.0])


def small_problem(*, nx: int = 12, ny: int = 9) -> TableProblem:
    """Three frequencies, twelve cells."""
    return TableProblem(make_paper_rig(nx, ny), FREQUENCIES, Grid(4, 3))


@cache
def small_table(*, drive_mode: str = "switched") -> LocalizationTable:
    """On the paper's own mesh."""
    return solve_table(small_problem(), drive_mode=drive_mode)


def with_strokes(table: LocalizationTable, factor: float) -> LocalizationTable:
    """The table of ERAs with other strokes, in which accelerations are in proportion."""
    eras = tuple(replace(era, stroke=factor * era.stroke) for era in table.eras)
    return replace(table, eras=eras)
