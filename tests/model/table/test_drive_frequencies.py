"""Drive frequencies of tables: defaults, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.finger.grid import Grid
from model.table.build import build_table
from model.table.table import default_drive_frequencies
from model.table.table_parts import TableProblem
from paper_plate import make_paper_rig
from registry.limits import GuardLimits


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (20.0, 700.0, range(40, 501, 10)),
        (60.0, 300.0, range(60, 301, 10)),
        (75.0, 85.0, [80]),
        (400.0, 430.0, [400, 410, 420, 430]),
        (61.0, 69.0, [61]),
    ],
)
def test_default_drive_frequencies_are_within_the_limits(low, high, expected):
    """40 to 500 Hz in steps of 10 within the limits; at least one."""
    found = default_drive_frequencies(GuardLimits(frequency_min=low, frequency_max=high, level=1.0))
    np.testing.assert_array_equal(found, list(expected))


@pytest.mark.parametrize(
    "frequencies",
    [[], [100.0, 100.0], [200.0, 100.0], [10.0], [100.0, 900.0], [100.0, float("nan")]],
)
def test_build_refuses_impossible_frequencies(frequencies):
    """None, unordered, outside the rig's limits, not a number."""
    with pytest.raises(InputError, match="frequencies"):
        build_table(make_paper_rig(12, 9), frequencies=np.array(frequencies))


def test_table_problem_refuses_a_table_too_large_to_be_read():
    """A foil of three by three metres has some ten thousand modes, refused before it is solved."""
    rig = make_paper_rig(48, 36)
    plate = replace(rig.plate, length=3.0, width=3.0, thickness=0.0001)
    with pytest.raises(InputError, match="GB"):
        TableProblem(replace(rig, plate=plate), np.array([100.0, 500.0]), Grid(4, 3))
