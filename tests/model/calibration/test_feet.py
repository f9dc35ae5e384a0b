"""Feet of unknown stiffness in a calibration and its report."""

from dataclasses import replace

import numpy as np
import pytest

from model.calibration.calibrate import as_json, calibrate, change_rows, finding_rows
from model.diagnosis.verdict import check_consistency
from model.structure.attachments import PointLoad
from plates import make_paper_rig, measured, perturbed

FREQUENCIES = np.arange(40.0, 321.0, 40.0)
STIFF, SOFT = 30e3, 10.0  # N/m; the latter is 3e-4 of an ERA's


def test_report_has_the_feet_that_responses_tell_of_and_names_others() -> None:
    """A foot of rubber 40 % stiffer than its file is found; of one of 10 N/m it says nothing.

    That one keeps the rig's value, is named, and leaves the rig as uncertain of feet as it was, in
    the root mean square of both.
    """
    paper = make_paper_rig(12, 9)
    feet = (
        PointLoad(0.07, 0.06, stiffness=STIFF, loss_factor=0.15, is_foot=True),
        PointLoad(0.21, 0.13, stiffness=SOFT, loss_factor=0.15, is_foot=True),
    )
    rig = replace(paper, masses=feet, uncertainty=replace(paper.uncertainty, supports=0.3))
    truth = perturbed(rig, frequencies=FREQUENCIES)
    stiffer = tuple(replace(each, stiffness=1.4 * each.stiffness) for each in feet)
    responses = measured(replace(truth, masses=stiffer), frequencies=FREQUENCIES)
    found = calibrate(rig, responses, check_consistency(rig, responses))
    first, second = (one for one in found.parameters if one.parameter.foot)
    assert first.standard_error is not None
    assert first.standard_error < 0.02 * STIFF
    assert abs(first.value - 1.4 * STIFF) < 5 * first.standard_error
    assert (second.value, second.standard_error) == (SOFT, None)
    assert [each.stiffness for each in found.rig.masses] == pytest.approx(
        [1.4 * STIFF, SOFT], rel=0.05
    )
    assert found.rig.uncertainty.supports == pytest.approx(0.3 / np.sqrt(2), rel=0.02)
    rows = [row for row in change_rows(found) if row.startswith("foot")]
    assert rows[0].startswith("foot 1 stiffness")
    assert "30 kN/m ->" in rows[0]
    assert "kN/m (+4" in rows[0]
    assert rows[1].endswith("0.01 kN/m -> not identified")
    assert any(
        "rig's value kept" in row and "foot 2 stiffness" in row for row in finding_rows(found)
    )
    said = {each["foot"]: each for each in as_json(found, rig)["parameters"] if each["foot"]}
    assert said["1"]["after"] == first.value
    assert (said["2"]["identified"], said["2"]["before"]) == (False, SOFT)
