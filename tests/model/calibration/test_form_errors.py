"""Form errors of a plate: their derivatives, and intervals that hold the truth despite them."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.calibration.hidden_plates import (
    FORMS,
    SENSORS,
    draw_plate,
    gain_deviations,
    measure,
    true_gains,
    true_values,
)
from model.arrays import FloatArray
from model.calibration.calibrate import calibrate
from model.calibration.form_errors import form_model
from model.calibration.sensed_plate import Parameters, sensed_plate
from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from model.structure.attachments import PointLoad

FREQUENCIES = np.arange(50.0, 491.0, 40.0)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate as its file has it."""
    return load_rig(example_rig_path())


def test_form_model_without_form_errors_is_the_sensed_plate(rig: Rig) -> None:
    """A solve of all modes at once, and the correction of low rank of the free plate, agree.

    The one has residual vectors for waves that are not resolved, the other their sums.
    """
    points = SENSORS * [rig.plate.length, rig.plate.width]
    deviations = ((0.02, 0.3), (-0.01, 0.0))
    plate = replace(rig.plate, loss_exponent=0.3, mode_deviations=deviations)
    rig = replace(rig, plate=plate, masses=(PointLoad(0.1, 0.05, mass=0.004),))
    model = form_model(rig, points, FREQUENCIES)
    parameters = Parameters.of(rig)
    start = np.zeros(len(parameters.rows))
    found, _ = model.responses(parameters, start, np.zeros(len(model.std)))
    expected = sensed_plate(rig, points, FREQUENCIES).responses()
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


def test_stiffening_does_not_depend_on_rounding(rig: Rig) -> None:
    """Moduli that differ in the eleventh digit give derivatives by the sides that agree to 1e-4.

    Relative to the modes' own stiffness, as couplings are that move a mode's frequency.
    """
    points = SENSORS[:3] * [rig.plate.length, rig.plate.width]

    def couplings(share: float) -> FloatArray:
        material = replace(rig.plate.material, E=rig.plate.material.E * (1 + share))
        other = replace(rig, plate=replace(rig.plate, material=material))
        model = form_model(other, points, FREQUENCIES)
        size = np.sqrt(model.eigenvalues + 4e4)  # of a rigid body on springs of some 30 Hz
        return np.abs(model.stiffening) / np.outer(size, size)

    exact = couplings(0.0)
    for share in (1e-11, 2e-11, 3e-11):
        np.testing.assert_allclose(couplings(share), exact, atol=1e-4)


@pytest.mark.parametrize(
    ("sensors", "plates", "share"),
    [
        pytest.param(6, 1, 0.7, id="6-sensors"),
        pytest.param(12, 1, 0.7, id="12-sensors", marks=pytest.mark.long),
        pytest.param(12, 2, 0.8, id="two-plates", marks=pytest.mark.long),
    ],
)
def test_intervals_hold_the_truth_on_plates_with_form_errors(
    rig: Rig, sensors: int, plates: int, share: float
) -> None:
    """ERAs 1.5 mm off, a foreign mass, sides and Poisson's ratio off, by finite elements.

    Of the 28 true values of two plates four in five or more lie within two standard errors and none
    beyond four, of the 14 of one plate seven in ten; without form errors in the fit it is a third.
    So do three in four of the gains and phases within the interval of 90 % by the uncertainty of
    the new rig. No sensor within its tolerance counts as one of a wrong scale. The benchmark has
    more plates.
    """
    deviations, gains = [], []
    for seed in range(plates):
        hidden = draw_plate(rig, FORMS["usual"], seed=seed, frequencies=FREQUENCIES)
        responses = measure(hidden, rig, seed=seed, frequencies=FREQUENCIES, count=sensors)
        found = calibrate(rig, responses)
        assert found.outlier_count == 0
        assert found.scales == ()
        gains.append(gain_deviations(found.rig, true_gains(hidden)))
        for one, true in zip(found.parameters, true_values(hidden), strict=True):
            if one.standard_error is not None:
                deviations.append(abs(one.value - true) / one.standard_error)
    assert len(deviations) > 12 * plates
    assert np.mean(np.array(deviations) < 2) > share
    assert max(deviations) < 4
    assert np.mean(np.array(gains) < 1.645) > 0.75
