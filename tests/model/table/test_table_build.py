"""Building a table: by several processes, and the error that it states."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.finger.grid import Grid
from model.table.build import TableProblem, solve_table
from model.table.file import save_table
from model.vibration.convergence import study_convergence
from paper_plate import make_paper_rig

FREQUENCIES = np.array([60.0, 90.0, 110.0])


def quick_rig(nx=12, ny=9):
    """The paper's plate with frequencies up to 120 Hz, so that its reference mesh is coarse."""
    rig = make_paper_rig(nx, ny)
    return replace(rig, limits=replace(rig.limits, frequency_max=120.0))


@pytest.fixture(scope="module")
def problem():
    """A small table's."""
    return TableProblem(quick_rig(), FREQUENCIES, Grid(4, 3))


@pytest.mark.long
def test_build_is_the_same_to_the_bit_by_two_processes(problem, tmp_path):
    """Whichever process solves a part."""
    files = []
    for workers in (1, 2):
        path = tmp_path / f"{workers}.npz"
        save_table(solve_table(problem, drive_mode="switched", workers=workers), path)
        files.append(path.read_bytes())
    assert files[0] == files[1]


def test_build_states_the_discretisation_error_of_the_worst_era():
    """That of a convergence study, on elements and another raster, with an ERA inside the plate."""
    rig = quick_rig()
    rig = replace(rig, eras=(replace(rig.eras[0], x=0.11, y=0.09), *rig.eras[1:]))
    table = solve_table(TableProblem(rig, FREQUENCIES, Grid(2, 2)), drive_mode="switched")
    study = study_convergence(rig, [rig.mesh], frequencies=FREQUENCIES.tolist())
    assert table.reference_mesh != study.reference
    np.testing.assert_allclose(table.discretisation_error, study.errors[0].response, rtol=0.1)


def test_build_refuses_an_unknown_drive_mode(problem):
    """The error lists those there are."""
    with pytest.raises(InputError, match="switched, phased"):
        solve_table(problem, drive_mode="loud")
