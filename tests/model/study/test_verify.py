"""Verification passes a true table and fails a changed one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.fem import assemble
from model.finger import fingertip_points, fingertip_weights
from model.structure.attachments import FingertipLoad, PointLoad
from model.study.verification import AnswerCheck, verify_table
from model.table.table_file import load_table, save_table, solve_table
from model.vibration import tone_fields
from plates import make_paper_rig, small_problem, small_table
from set_table import only


@pytest.fixture(scope="module")
def rig():
    """What the table was built from."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="module")
def table():
    """Phased, where contrast is highest and most easily lost."""
    return small_table(drive_mode="phased")


@pytest.fixture(scope="module")
def verified(table, rig):
    """Verification of the table as it is."""
    return verify_table(table, rig, samples=4)


def test_verify_passes_a_true_table(verified):
    """Fields within 5e-5 of the direct solve, and answers with one to three quiet fingers."""
    assert verified.failed_count == 0
    assert verified.promise.kept_share == pytest.approx(0.9, abs=0.08)
    assert verified.promise.plate_count == 800
    assert len(verified.content) == 2
    fields, cells = verified.content
    assert fields.error < 5e-5
    assert cells.error < 2e-3  # the raster does not follow the mesh between its nodes
    assert [len(check.placed.quiet) for check in verified.answer_checks] == [1, 2, 3, 1]


def test_verify_passes_a_table_with_measured_gains_bolts_and_masses(rig, tmp_path):
    """They are in the table, its file, the direct solve and the plate in time."""
    gains = ((60.0, 0.8, 0.3), (250.0, 1.2, -0.5))
    eras = (replace(rig.eras[0], gains=gains, bolt_mass=0.012), *rig.eras[1:])
    measured = replace(rig, eras=eras, masses=(PointLoad(0.1, 0.15, mass=0.06),))
    problem = replace(small_problem(), rig=measured)
    save_table(solve_table(problem, drive_mode="phased"), tmp_path / "t.npz")
    found = verify_table(load_table(tmp_path / "t.npz", rig=measured), measured, samples=3)
    assert found.failed_count == 0


def test_tolerances_follow_from_the_error_of_the_field(verified, rig, table):
    """By hand: 20 log10(1 + error / peak), of the target for its level, of both for contrast.

    The error is 2e-4 for the raster, 7e-3 for the fingers and (k s)²/8 for elements s = 25.4 mm of
    the first order, of the root mean square over the plate.
    """
    rigidity = 70e9 * 0.0015**3 / (12 * (1 - 0.33**2))
    x, y = np.meshgrid((np.arange(8) + 0.5) / 8 * 0.3048, (np.arange(6) + 0.5) / 6 * 0.2286)
    matrices = assemble(rig.plate, rig.mesh)
    for check in verified.answer_checks:
        contacts = (*check.placed.targets, *check.placed.quiet)
        discs = [fingertip_points(*place, rig.plate) for place in contacts]
        weights = fingertip_weights(*contacts[0], rig.plate)
        points = np.vstack([*discs, np.column_stack([x.ravel(), y.ravel()])])
        frequencies, fields = tone_fields(
            only(table, check.placed)[0].excitation,
            rig.eras,
            lambda f, points=points, contacts=contacts: direct_acceleration(
                matrices,
                rig.eras,
                f,
                points,
                loads=[FingertipLoad(*place, rig.fingertip) for place in contacts],
            ),
        )
        assert len(frequencies) == 1
        ends = np.cumsum([len(disc) for disc in discs])
        target, *quiet, plate = np.split(np.abs(fields).sum(axis=0), ends)
        squared = 2700 * 0.0015 * (2 * np.pi * frequencies.max()) ** 2 / rigidity  # k^4
        error = (7.2e-3 + np.sqrt(squared) * 0.0254**2 / 8) * np.sqrt((plate**2).mean())
        at_target, at_quiet = (
            20 * np.log10(1 + error / peak)
            for peak in (target @ weights, np.concatenate(quiet).max())
        )
        assert check.level_tolerance_db == pytest.approx(0.01 + at_target, rel=1e-3)
        assert check.contrast_tolerance_db == pytest.approx(0.01 + at_target + at_quiet, rel=1e-3)


def test_contrast_in_time_agrees_with_the_direct_solve(verified):
    """Two ways that share nothing but the mesh agree within 0.3 dB up to 25 dB."""
    contrasts = [check.direct_contrast_db for check in verified.answer_checks]
    assert max(contrasts) > 15
    for check in verified.answer_checks:
        if check.direct_contrast_db < 25:
            assert check.contrast_in_time_db == pytest.approx(check.direct_contrast_db, abs=0.3)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("shapes", lambda each: each * 1.2),
        ("attachment_shapes", lambda each: each * 1.05),
        ("omega", lambda each: each * 1.05),
    ],
)
def test_verify_fails_changed_content(table, rig, tmp_path, name, change):
    """A few per cent of anything, under a right checksum; answers as well where it is much."""
    old = getattr(table, name)
    path = tmp_path / "changed.npz"
    save_table(replace(table, **{name: change(old).astype(old.dtype)}), path)
    changed = load_table(path, rig=rig)
    found = verify_table(changed, rig, samples=4 if name == "omega" else 1)
    assert not any(check.is_passed for check in found.content)
    if name == "omega":
        assert not all(check.is_passed for check in found.answer_checks)
        assert found.failed_count >= 3


@pytest.mark.parametrize(
    ("changed", "is_passed"),
    [
        ({}, True),
        ({"direct_level_db_sl": 20.2}, False),
        ({"direct_level_db_sl": 19.8}, False),
        ({"direct_contrast_db": 18.5}, False),
        ({"direct_contrast_db": 17.5}, False),
        ({"contrast_in_time_db": 16.5}, False),
        ({"contrast_in_time_db": 18.9}, True),
        ({"contrast_in_time_db": math.nan}, False),
        ({"direct_level_db_sl": math.nan}, False),
        ({"predicted_contrast_db": 40.0, "direct_contrast_db": 40.0}, False),
        (
            {"predicted_contrast_db": 40.0, "direct_contrast_db": 40.0, "contrast_in_time_db": 29},
            True,
        ),
    ],
)
def test_answer_check_passes_within_its_tolerances(verified, changed, is_passed):
    """0.1 dB of level and contrast, 1 dB more in time, where contrast beyond 25 dB counts as 25."""
    check = AnswerCheck(
        **{
            "placed": verified.answer_checks[0].placed,
            "predicted_level_db_sl": 20.0,
            "predicted_contrast_db": 18.0,
            "direct_level_db_sl": 20.0,
            "direct_contrast_db": 18.05,
            "contrast_in_time_db": 18.0,
            "level_tolerance_db": 0.1,
            "contrast_tolerance_db": 0.1,
            **changed,
        }
    )
    assert check.is_passed is is_passed
