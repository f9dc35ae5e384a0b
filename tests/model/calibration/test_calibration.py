"""Fitting a rig to responses of a plate that is known, solved without the fit's own model."""

from dataclasses import replace

import numpy as np
import pytest

from model.calibration.calibrate import calibrate
from model.calibration.calibration_result import Calibration
from model.calibration.responses import Responses
from model.errors import InputError
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.fem.mesh import Mesh
from model.rig.rig import Rig
from model.structure.point_load import PointLoad
from model.vibration.parametric_plate import parametric_plate
from paper_plate import make_paper_rig
from perturbed_plate import FREQUENCIES, NAMES, POINTS, measured, perturbed

FEW = FREQUENCIES[::3]


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate on the coarsest mesh that resolves 500 Hz well enough."""
    return make_paper_rig(16, 12)


@pytest.fixture(scope="module")
def truth(rig: Rig) -> Rig:
    """What was measured."""
    return perturbed(rig)


@pytest.fixture(scope="module")
def fitted(rig: Rig, truth: Rig) -> Calibration:
    """With 1 % noise, one wrong scale and one dead sensor."""
    return calibrate(rig, measured(truth, scales={"P3": 1.25, "P8": 0.0}))


def true_values(rig: Rig) -> list[float]:
    """In the order of the parameters."""
    values = [rig.plate.material.E, rig.plate.loss_factor]
    return values + [v for era in rig.eras for v in (era.stiffness, era.damping, era.bolt_mass)]


def gains_of(rig: Rig) -> np.ndarray:
    """Complex gains, (f, eras)."""
    return np.column_stack([era.gain(FREQUENCIES) for era in rig.eras])


def test_parametric_plate_agrees_with_the_direct_solve(rig, truth):
    """Another modulus, damping and mass without a new solve: as the sparse solve to 0.1 %."""
    loaded = replace(rig, masses=(PointLoad(0.2, 0.1, mass=0.02),))
    plain = replace(truth, eras=tuple(replace(era, gains=()) for era in truth.eras))
    loaded_truth = replace(plain, masses=loaded.masses)
    fast = parametric_plate(loaded, POINTS, FREQUENCIES).responses(loaded_truth)
    matrices = assemble(plain.plate, plain.mesh)
    exact = direct_acceleration(
        matrices, plain.eras, FREQUENCIES, POINTS, loads=loaded_truth.masses
    ) / np.array([era.stroke for era in plain.eras]).reshape(-1, 1)
    wrong = np.linalg.norm(fast - exact, axis=2) / np.linalg.norm(exact, axis=2)
    assert wrong.max() < 1e-3


def test_calibrate_finds_every_parameter(truth, fitted):
    """All fourteen within 2 % of the truth and within five of their standard errors."""
    found = [fitted_one.value for fitted_one in fitted.parameters]
    np.testing.assert_allclose(found, true_values(truth), rtol=0.02)
    for one, true in zip(fitted.parameters, true_values(truth), strict=True):
        assert one.standard_error is not None
        assert abs(one.value - true) < 5 * one.standard_error
        assert one.standard_error < 0.02 * true


def test_calibrate_finds_gains(truth, fitted):
    """Gains 8 % and 6 degrees off are known to 1 % in the median, 4 % at worst.

    Their standard error is at least that of noise of 1 %, half of its power in each part, over the
    eleven live sensors, and of what their scales have in common, of which each is known to 1 %.
    """
    true = gains_of(truth)
    wrong = np.abs(gains_of(fitted.rig) / true - 1)
    assert np.median(wrong) < 0.01
    assert wrong.max() < 0.04
    errors = fitted.gains_error / np.abs(true)
    assert 0.01 * np.sqrt(1 / 22 + 1 / 11) < np.median(errors) < 0.01


def test_calibrate_finds_dead_and_wrongly_scaled_sensors(fitted):
    """The dead sensor is left out, the wrong scale found, and no other one suspected."""
    assert fitted.dead_sensors == ("P8",)
    assert fitted.dead_eras == ()
    assert [scale.name for scale in fitted.scales] == ["P3"]
    assert fitted.scales[0].scale == pytest.approx(1.25, rel=0.005)


def test_calibrate_predicts_held_out_sensors_to_the_noise(fitted):
    """Sensors held out are predicted to about the 1 % of noise, by the old rig not at all."""
    assert fitted.held_out is not None
    assert not {"P3", "P8"} & set(fitted.held_out.sensors)
    assert 0.007 < fitted.held_out.after < 0.02
    assert fitted.held_out.before > 0.3
    assert fitted.is_good


def test_calibrate_leaves_outliers_out(rig, truth):
    """Five in a hundred values wrong by factors of 2 to 20 with any phase move nothing."""
    clean = measured(truth)
    rng = np.random.default_rng(6)
    wild = rng.random(clean.values.shape) < 0.05
    values = clean.values.copy()
    values[wild] *= rng.uniform(2, 20, wild.sum()) * np.exp(2j * np.pi * rng.random(wild.sum()))
    found = calibrate(rig, replace(clean, values=values))
    assert found.outlier_count >= 0.9 * wild.sum()
    assert found.outlier_count <= 1.1 * wild.sum()
    np.testing.assert_allclose(
        [one.value for one in found.parameters], true_values(truth), rtol=0.02
    )
    assert found.dead_sensors == ()
    assert found.scales == ()


def test_calibrate_finds_a_dead_era_despite_gaps(rig, truth):
    """An ERA that moves nothing is named; its spring is still found by the others' responses.

    So is a sensor that has come off and hears next to nothing.
    """
    clean = measured(truth, scales={"P4": 0.05})
    values = clean.values.copy()
    values[:, 2] *= 1e-4
    values[np.random.default_rng(7).random(values.shape) < 0.3] = np.nan
    found = calibrate(rig, replace(clean, values=values))
    assert found.dead_eras == ("NE",)
    assert found.dead_sensors == ("P4",)
    assert found.rig.era("NE").gains == ()
    np.testing.assert_allclose(
        [one.value for one in found.parameters], true_values(truth), rtol=0.02
    )


def test_calibrate_keeps_what_is_not_identified(rig):
    """From 40 to 44 Hz springs outweigh bolts and dampers: these are kept and reported."""
    frequencies = np.array([40.0, 42.0, 44.0])
    truth = perturbed(rig, frequencies=frequencies)
    found = calibrate(rig, measured(truth, frequencies=frequencies, noise=0.05))
    held = [one for one in found.parameters if not one.is_identified]
    assert {one.parameter.kind for one in held} >= {"bolt_mass", "damping"}
    assert all(one.value == one.parameter.prior for one in held)
    for one, true in zip(found.parameters, true_values(truth), strict=True):
        if one.standard_error is not None:
            assert abs(one.value - true) < 5 * one.standard_error


@pytest.mark.long
def test_calibrate_estimates_all_scales_when_requested(rig, truth):
    """Every sensor's scale relative to their median, also of one mounted upside down."""
    found = calibrate(rig, measured(truth, scales={"P2": -1.0, "P5": 1.01}), all_scales=True)
    scales = {scale.name: scale.scale for scale in found.scales}
    assert list(scales) == list(NAMES)
    assert scales["P2"] == pytest.approx(-1.0, abs=0.005)
    assert scales["P5"] == pytest.approx(1.01, abs=0.005)
    assert scales["P12"] == pytest.approx(1.0, abs=0.005)


@pytest.mark.long
def test_calibrate_refuses_a_plate_of_another_size(rig):
    """A plate twice as thick and 9 mm shorter: its length is refused, whatever the values."""
    plate = replace(rig.plate, thickness=0.003, length=0.296)
    eras = tuple(replace(era, x=min(era.x, 0.296)) for era in rig.eras)
    other = replace(rig, plate=plate, eras=eras, mesh=Mesh(16, 12, 0.296, rig.plate.width))
    found = measured(perturbed(other, frequencies=FEW), frequencies=FEW)
    with pytest.raises(InputError, match=r"plate\.length"):
        calibrate(rig, found)


def test_calibrate_refuses_too_few_sensors_and_silence(rig, truth):
    """Two live sensors, and silence."""
    full = measured(truth)
    two = Responses(NAMES[:2], POINTS[:2], full.frequencies, full.values[:, :, :2])
    with pytest.raises(InputError, match="got 2"):
        calibrate(rig, two)
    with pytest.raises(InputError, match="zero"):
        calibrate(rig, replace(full, values=0 * full.values))
