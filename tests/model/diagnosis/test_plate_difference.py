"""A plate within tolerances that is not as written: its size and its cost in contrast."""

from dataclasses import replace

import numpy as np
import pytest

from model.diagnosis.diagnosis_report import as_json
from model.diagnosis.verdict import Verdict, diagnose
from model.rig.rig import Rig
from paper_plate import make_paper_rig
from perturbed_plate import measured

FREQUENCIES = np.arange(60.0, 421.0, 40.0)


def verdict_on(rig: Rig, *, loss: float, stiffness: float) -> Verdict:
    """Verdict on a plate with these factors, from responses of the sparse solve."""
    eras = tuple(replace(era, stiffness=stiffness * era.stiffness) for era in rig.eras)
    plate = replace(rig.plate, loss_factor=loss * rig.plate.loss_factor)
    truth = replace(rig, plate=plate, eras=eras)
    responses = measured(truth, frequencies=FREQUENCIES, noise=0.005)
    return diagnose(rig, responses)


def test_plate_with_more_loss_and_less_stiffness_has_a_verdict_of_its_own() -> None:
    """60 % more loss and 20 % less stiffness: wiring well, both named, contrast lost."""
    verdict = verdict_on(make_paper_rig(16, 12), loss=1.6, stiffness=0.8)
    assert verdict.wiring_matches
    assert verdict.difference is not None
    assert verdict.difference.changes["loss_factor"] == pytest.approx(0.6, abs=0.15)
    assert verdict.difference.changes["stiffness"] == pytest.approx(-0.2, abs=0.03)
    assert verdict.difference.loss_db > 3
    told = as_json(verdict)
    assert told["wiring_matches"]
    assert told["plate"]["contrast_loss_db"] == verdict.difference.loss_db


def test_plate_as_written_costs_nothing() -> None:
    """The rig's own plate: no change of more than 5 %, and less than half a decibel."""
    verdict = verdict_on(make_paper_rig(16, 12), loss=1.0, stiffness=1.0)
    assert verdict.is_well
    assert verdict.difference is not None
    assert max(map(abs, verdict.difference.changes.values())) < 0.05
    assert abs(verdict.difference.loss_db) < 0.5
