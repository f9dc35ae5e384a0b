"""A true table is confirmed, a false one found out."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.finger.fingertip import fingertip_points
from model.table.build import build_in_parts
from model.table.file import load_table, save_table
from model.table.verify import AnswerCheck, verify_table
from model.vibration.peak import tone_amplitudes
from paper_plate import make_paper_rig
from small_table import small_problem, small_table


@pytest.fixture(scope="module")
def rig():
    """What the table was built from."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="module")
def table():
    """Phased, where contrast is highest and most easily lost."""
    return small_table(drive_mode="phased")


@pytest.fixture(scope="module")
def confirmed(table, rig):
    """What is found of the table as it is."""
    return verify_table(table, rig, samples=4)


def tampered(table, tmp_path, **changed):
    """A table with other content, whose file is whole: its checksum was made for that content."""
    path = tmp_path / "tampered.npz"
    save_table(replace(table, **changed), path)
    return load_table(path, fingerprint=table.fingerprint)


def test_a_true_table_holds(confirmed):
    """Content within 5e-5 of the direct solve, and answers with one to three quiet fingers."""
    assert confirmed.misses == 0
    assert len(confirmed.content) == 3
    assert max(check.error for check in confirmed.content) < 5e-5
    assert [len(check.question.quiet) for check in confirmed.answer_checks] == [1, 2, 3, 1]


def test_a_rig_whose_eras_were_measured_holds(rig, tmp_path):
    """ERAs that move by other amounts and phases than asked are in the table, its file and time."""
    gains = ((60.0, 0.8, 0.3), (250.0, 1.2, -0.5))
    measured = replace(rig, eras=(replace(rig.eras[0], gains=gains), *rig.eras[1:]))
    problem = replace(small_problem(), rig=measured)
    save_table(build_in_parts(problem, drive_mode="phased").table, tmp_path / "t.npz")
    found = verify_table(
        load_table(tmp_path / "t.npz", fingerprint=measured.fingerprint), measured, samples=3
    )
    assert found.misses == 0


def test_tolerances_are_what_an_error_of_the_field_makes_of_an_answer(confirmed, rig):
    """By hand: 20 log10(1 + error / peak), of the target for its level, of both for contrast.

    The error is 2e-4 for the raster and (k s)²/8 for elements s = 25.4 mm of the first order, of
    the root mean square over the plate.
    """
    rigidity = 70e9 * 0.0015**3 / (12 * (1 - 0.33**2))
    x, y = np.meshgrid((np.arange(8) + 0.5) / 8 * 0.3048, (np.arange(6) + 0.5) / 6 * 0.2286)
    matrices = assemble(rig.plate, rig.mesh)
    for check in confirmed.answer_checks:
        contacts = (*check.question.targets, *check.question.quiet)
        discs = [fingertip_points(*place, rig.plate) for place in contacts]
        points = np.vstack([*discs, np.column_stack([x.ravel(), y.ravel()])])
        frequencies, amplitudes = tone_amplitudes(
            check.pattern.excitation,
            rig.eras,
            lambda f, points=points: direct_acceleration(matrices, rig.eras, f, points),
        )
        ends = np.cumsum([len(disc) for disc in discs])
        target, *quiet, plate = np.split(amplitudes.sum(axis=0), ends)
        squared = 2700 * 0.0015 * (2 * np.pi * frequencies.max()) ** 2 / rigidity  # k^4
        error = (2e-4 + np.sqrt(squared) * 0.0254**2 / 8) * np.sqrt((plate**2).mean())
        at_target, at_quiet = (
            20 * np.log10(1 + error / peak) for peak in (target.mean(), np.concatenate(quiet).max())
        )
        assert check.level_tolerance_db == pytest.approx(0.01 + at_target, rel=1e-3)
        assert check.contrast_tolerance_db == pytest.approx(0.01 + at_target + at_quiet, rel=1e-3)


def test_in_time_the_contrast_is_that_of_the_direct_solve(confirmed):
    """Two ways that share nothing but the mesh agree within 0.3 dB up to 25 dB."""
    contrasts = [check.direct_contrast_db for check in confirmed.answer_checks]
    assert max(contrasts) > 15
    for check in confirmed.answer_checks:
        if check.direct_contrast_db < 25:
            assert check.contrast_in_time_db == pytest.approx(check.direct_contrast_db, abs=0.3)


def test_an_era_that_was_made_stronger_is_found_out(table, rig, tmp_path):
    """A tenth more of one ERA's field, rightly summed: fields and answers miss, the rest holds."""
    stronger = table.acceleration.copy()
    stronger[:, :, 1] *= 1.1
    found = verify_table(tampered(table, tmp_path, acceleration=stronger), rig, samples=4)
    assert [check.is_passed for check in found.content] == [False, True, True]
    assert not all(check.is_passed for check in found.answer_checks)
    assert found.misses >= 2


@pytest.mark.parametrize(
    ("name", "verdicts"),
    [("shapes", [True, False, True]), ("held", [True, False, True]),
     ("omega", [True, False, True]), ("cell_sources", [True, True, False])],
)  # fmt: skip
def test_other_content_that_was_changed_is_found_out(table, rig, tmp_path, name, verdicts):
    """One per cent more of anything else in the file misses where it is looked at."""
    changed = tampered(table, tmp_path, **{name: getattr(table, name) * np.float32(1.01)})
    found = verify_table(changed, rig, samples=1)
    assert [check.is_passed for check in found.content] == verdicts


def test_content_that_is_no_number_is_found_out(table, rig):
    """A point at which a mode has no shape: what cannot be compared does not hold."""
    shapes = table.shapes.copy()
    shapes[0, -1] = math.nan
    found = verify_table(replace(table, shapes=shapes), rig, samples=1)
    assert [check.is_passed for check in found.content] == [True, False, True]


def test_an_era_at_another_phase_is_found_out(table, rig, tmp_path):
    """Magnitudes alone would not show it: one ERA's field turned by ten degrees."""
    turned = table.acceleration.copy()
    turned[:, :, 0] *= np.complex64(np.exp(1j * np.radians(10)))
    found = verify_table(tampered(table, tmp_path, acceleration=turned), rig, samples=1)
    assert not found.content[0].is_passed


@pytest.mark.parametrize(
    ("changed", "holds"),
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
def test_an_answer_holds_within_its_tolerances(confirmed, changed, holds):
    """0.1 dB of level and contrast, 1 dB more in time, where contrast beyond 25 dB counts as 25."""
    check = AnswerCheck(
        **{
            "question": confirmed.answer_checks[0].question,
            "pattern": replace(confirmed.answer_checks[0].pattern, level_db_sl=20.0),
            "predicted_contrast_db": 18.0,
            "direct_level_db_sl": 20.0,
            "direct_contrast_db": 18.05,
            "contrast_in_time_db": 18.0,
            "level_tolerance_db": 0.1,
            "contrast_tolerance_db": 0.1,
            **changed,
        }
    )
    assert check.is_passed is holds
