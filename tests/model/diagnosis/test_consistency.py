"""Whether measured responses can be of one plate, and of which polarity."""

import math
from dataclasses import replace

import numpy as np
import pytest

from long_form import shortly
from model.calibration.responses import Responses
from model.diagnosis import causes
from model.diagnosis.diagnosis_report import as_json
from model.diagnosis.plate_match import phases_of_drive
from model.diagnosis.verdict import Verdict, check_consistency, diagnose, judged_by_promises
from model.errors import InputError
from model.fem import Mesh
from model.rig.rig import Rig
from plates import DISTORTIONS, make_paper_rig, measured, perturbed

FREQUENCIES = np.arange(60.0, 421.0, 40.0)

NAMED = {
    "g": "9.80665",
    "velocity": "velocity in m/s",
    "displacement": "displacement in m",
    "opposite": "SW, SE, NE and NW",
    "conjugated": "exp",
    "swapped_channels": "SW and SE",
    "swapped_sensors": "P1 at that of P6, P6 at that of P1",
    "two_sensors": "got 2",
}
"""By distortion, what the refusal names."""


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate on a coarse mesh."""
    return make_paper_rig(16, 12)


@pytest.fixture(scope="module")
def responses(rig: Rig) -> Responses:
    """Of a plate within a builder's tolerances, with 1 % noise."""
    return measured(perturbed(rig, frequencies=FREQUENCIES), frequencies=FREQUENCIES)


@pytest.mark.parametrize(
    "name", shortly(DISTORTIONS, ["g", "velocity", "displacement", "two_sensors"])
)  # the errors of the others are provoked in tests/errors
def test_distorted_responses_are_refused_by_their_cause(
    rig: Rig, responses: Responses, name: str
) -> None:
    """Each distortion alone, with its own cause named."""
    with pytest.raises(InputError, match=NAMED[name]):
        check_consistency(rig, DISTORTIONS[name](responses))


def test_plate_of_another_length_is_refused_by_its_length(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plate that is a fifth longer than the rig's, sensors where they are said to be.

    Of few sizes and causes; whole searches are tested with diagnoses.
    """
    monkeypatch.setattr(causes, "_SIZES", (0.82, 1.21))
    monkeypatch.setattr(causes, "_FITTED_CAUSES", 3)
    monkeypatch.setattr(causes, "_REFINED_CAUSES", 1)
    monkeypatch.setattr(causes, "_REFINEMENTS", 3)
    plate = replace(rig.plate, length=1.2 * rig.plate.length)
    eras = tuple(replace(era, x=1.2 * era.x) for era in rig.eras)
    longer = replace(rig, plate=plate, eras=eras, mesh=Mesh(16, 12, plate.length, plate.width))
    found = measured(perturbed(longer, frequencies=FREQUENCIES), frequencies=FREQUENCIES)
    with pytest.raises(InputError, match=r"plate\.length"):
        check_consistency(rig, found)


@pytest.mark.parametrize(
    ("degrees", "sign"), [(0.0, 1), (80.0, 1), (-80.0, 1), (100.0, -1), (-100.0, -1), (180.0, -1)]
)
def test_phases_of_drive_inverts_beyond_a_quarter_turn(degrees: float, sign: int) -> None:
    """Measured is what was predicted, turned by an angle; that is found, and the nearer sign."""
    rng = np.random.default_rng(0)
    predicted = rng.standard_normal((5, 1, 4)) + 1j * rng.standard_normal((5, 1, 4))
    turned = predicted * np.exp(1j * math.radians(degrees))
    observation = Responses(
        tuple("ABCD"), np.zeros((4, 2)), np.arange(5.0), turned, has_phases=True
    )
    (phase,) = phases_of_drive(observation, predicted)
    assert phase.degrees == pytest.approx(degrees, abs=1e-6)
    assert phase.sign == sign
    assert phase.confidence == pytest.approx(1.0)


def verdict_on(rig: Rig, *, loss: float, stiffness: float) -> Verdict:
    """Verdict on a plate with these factors, from responses of the sparse solve."""
    eras = tuple(replace(era, stiffness=stiffness * era.stiffness) for era in rig.eras)
    plate = replace(rig.plate, loss_factor=loss * rig.plate.loss_factor)
    truth = replace(rig, plate=plate, eras=eras)
    responses = measured(truth, frequencies=FREQUENCIES, noise=0.005)
    return judged_by_promises(diagnose(rig, responses), rig)


def test_plate_with_more_loss_and_less_stiffness_has_a_verdict_of_its_own() -> None:
    """60 % more loss and 20 % less stiffness: wiring well, both named."""
    verdict = verdict_on(make_paper_rig(16, 12), loss=1.6, stiffness=0.8)
    assert verdict.wiring_matches
    told = as_json(verdict)
    assert told["wiring_matches"]
    assert told["plate"]["changes"]["loss_factor"] == pytest.approx(0.6, abs=0.15)
    assert told["plate"]["changes"]["stiffness"] == pytest.approx(-0.2, abs=0.03)


def test_plate_as_written_costs_nothing() -> None:
    """The rig's own plate: no change of more than 5 %, and more than nine of ten promises kept."""
    verdict = verdict_on(make_paper_rig(16, 12), loss=1.0, stiffness=1.0)
    assert verdict.is_well
    assert verdict.changes is not None
    assert max(map(abs, verdict.changes.values())) < 0.05
    assert verdict.kept_share is not None
    assert verdict.kept_share > 0.9
