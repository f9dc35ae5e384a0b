"""Feet of unknown stiffness in a calibration and its report.

How far sources are off the places of a calibrated rig, as the rig states it.

Fitting a rig to responses of a plate that is known, solved without the fit's own model.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import plates as calibration_plates
from benchmarks.calibration.hidden_plates import draw_plate, gains_of, measure, true_values
from benchmarks.weekend import chain
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.calibrate import Calibration, calibrate
from model.estimate.fit_report import calibration_json, change_rows, finding_rows
from model.estimate.measurement import Measurement
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.attachments import PointLoad
from plates import NAMES, make_paper_rig, perturbed
from plates import measured as plates_measured

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
    responses = plates_measured(replace(truth, masses=stiffer), frequencies=FREQUENCIES)
    found = calibrate(rig, responses)
    first, second = (one for one in found.parameters if one.foot)
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
    assert "  30 kN/m  " in rows[0]
    assert "  +4" in rows[0]
    assert rows[1].endswith("  not identified")
    assert any(
        "rig's value kept" in row and "foot 2 stiffness" in row for row in finding_rows(found)
    )
    said = {
        each["foot"]: each for each in calibration_json(found, rig)["parameters"] if each["foot"]
    }
    assert said["1"]["after"] == first.value
    assert (said["2"]["identified"], said["2"]["before"]) == (False, SOFT)


def _off(found: Rig, true: Rig) -> FloatArray:
    """Distances of places in a rig to the true ones along both sides, by the error it states.

    In shares of the sides, which a rig does not have by half a millimetre.
    """
    size = [found.plate.length, found.plate.width]
    places, at = (
        np.array([[era.x, era.y] for era in rig.eras]) / [rig.plate.length, rig.plate.width]
        for rig in (found, true)
    )
    return np.abs((places - at) * size).ravel() / found.uncertainty.place


def boards(seeds: range) -> Iterator[FloatArray]:
    """Exciters on wood, 1 mm off, of which one sensor is moved about twelve places."""
    rig = load_rig(chain.FOLDER / "rig.yaml")
    for seed in seeds:
        built, responses = chain.measured(rig, seed)
        yield _off(calibrate(rig, responses).rig, built.rig)


def plates(seeds: range) -> Iterator[FloatArray]:
    """ERAs on aluminium, 1.5 mm off inwards, with form errors, of finite elements."""
    rig = load_rig(example_rig_path())
    for seed in seeds:
        hidden = draw_plate(rig, seed=seed)
        responses = measure(hidden, rig, seed=seed)
        yield _off(calibrate(rig, responses).rig, hidden.rig)


@pytest.mark.parametrize(
    ("drawn", "by_one", "by_two"),
    [
        pytest.param(boards(range(1, 3)), (0.45, 0.9), 0.8, id="2-boards"),
        pytest.param(boards(range(3, 11)), (0.56, 0.8), 0.88, id="boards", marks=pytest.mark.long),
        pytest.param(plates(range(1, 7)), (0.56, 0.8), 0.85, id="plates", marks=pytest.mark.long),
    ],
)
def test_places_are_off_by_what_the_rig_states(
    drawn: Iterator[FloatArray], by_one: tuple[float, float], by_two: float
) -> None:
    """Normal distances: 68 % within one standard deviation, 95 % within two.

    To 2 standard deviations of such shares of 64 distances, and of 16 where there are few.
    """
    off = np.concatenate([*drawn])
    assert by_one[0] < np.mean(off < 1) < by_one[1]
    assert np.mean(off < 1.96) > by_two


CALIBRATION_FREQUENCIES = np.arange(40.0, 501.0, 40.0)
measured = partial(calibration_plates.measured, frequencies=CALIBRATION_FREQUENCIES)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate on the coarsest mesh that resolves 500 Hz well enough."""
    return make_paper_rig(16, 12)


@pytest.fixture(scope="module")
def truth(rig: Rig) -> Rig:
    """What was measured."""
    return perturbed(rig, frequencies=CALIBRATION_FREQUENCIES)


@pytest.fixture(scope="module")
def fitted(rig: Rig, truth: Rig) -> Calibration:
    """With 1 % noise, one wrong scale and one dead sensor."""
    return calibrated(rig, measured(truth, scales={"P3": 1.25, "P8": 0.0}))


def calibrated(rig: Rig, responses: Measurement, *, all_scales: bool = False) -> Calibration:
    """As `era calibrate` does it."""
    return calibrate(rig, responses, all_scales=all_scales)


def test_calibrate_finds_every_parameter(truth, fitted):
    """All fourteen within 2 % of the truth and within five of their standard errors."""
    found = [fitted_one.value for fitted_one in fitted.parameters]
    np.testing.assert_allclose(found, true_values(truth), rtol=0.02)
    for one, true in zip(fitted.parameters, true_values(truth), strict=True):
        assert one.standard_error is not None
        assert abs(one.value - true) < 5 * one.standard_error
        assert one.standard_error < 0.02 * true


def test_calibrate_states_no_modes_of_a_plate_without_form_errors(fitted):
    """A rig whose modes are those of theory has no rows of ones for them."""
    assert fitted.rig.plate.mode_deviations == ()


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


def test_calibrate_states_each_error_once(truth, fitted):
    """Of eleven sensors, each within 1 %, the mean is that of all gains, and of none of its own.

    That is at least what noise of 1 % leaves, half of its power in each part. Frequencies are as
    uncertain as the model leaves them, 0.1 %, whatever a side could have of the modulus.
    """
    known, true = fitted.rig.uncertainty, truth.plate.material.E
    assert known.common_gain == pytest.approx(0.01 / np.sqrt(11), rel=0.2)
    assert 0.01 / np.sqrt(22) < known.gain < 0.01 / np.sqrt(8)
    assert abs(fitted.rig.plate.material.E / true - 1) / 2 < known.frequency < 0.0012


def test_calibrate_finds_dead_and_wrongly_scaled_sensors(fitted):
    """The dead sensor is left out, the wrong scale found, and no other one suspected."""
    assert fitted.dead_sensors == ("P8",)
    assert fitted.dead_eras == ()
    assert list(fitted.scales) == ["P3"]
    assert fitted.scales["P3"][0] == pytest.approx(1.25, rel=0.005)


def test_calibrate_predicts_held_out_sensors_to_the_noise(fitted):
    """Sensors held out are predicted to about the 1 % of noise, by the old rig not at all."""
    assert fitted.held_out is not None
    assert not {"P3", "P8"} & set(fitted.held_out.sensors)
    assert 0.007 < fitted.held_out.after < 0.02
    assert fitted.held_out.before > 0.3
    assert fitted.is_good


def test_calibrate_finds_a_dead_era_despite_gaps_and_outliers(rig, truth):
    """An ERA that moves nothing is named; its spring is still found by the others' responses.

    So is a sensor that has come off and hears next to nothing. One in twenty of the other values is
    wrong by factors of 2 to 20 with any phase, and left out.
    """
    clean = measured(truth, scales={"P4": 0.05})
    values = clean.values.swapaxes(1, 2).copy()  # (f, eras, s)
    rng = np.random.default_rng(7)
    values[rng.random(values.shape) < 0.3] = np.nan
    wild = rng.random(values.shape) < 0.05
    wild &= np.isfinite(values)
    wild[:, 2] = wild[:, :, NAMES.index("P4")] = False
    values[wild] *= rng.uniform(2, 20, wild.sum()) * np.exp(2j * np.pi * rng.random(wild.sum()))
    values[:, 2] *= 1e-4
    found = calibrated(rig, replace(clean, values=values.swapaxes(1, 2)))
    assert 0.9 * wild.sum() <= found.outlier_count <= 1.1 * wild.sum()
    assert found.scales == {}
    assert found.dead_eras == ("NE",)
    assert found.dead_sensors == ("P4",)
    assert found.rig.era("NE").gains == ()
    np.testing.assert_allclose(
        [one.value for one in found.parameters], true_values(truth), rtol=0.02
    )


def test_calibrate_leaves_out_a_sensor_that_is_elsewhere(rig: Rig, truth: Rig) -> None:
    """P6 stands beside P1, and reads what that one does with less noise: the others find the plate.

    So each fits the place of P1 better than the own of P6, and only one of both is elsewhere.
    """
    full = measured(truth)
    values = full.values.copy()
    silent = measured(truth, noise=0.0).values
    values[:, NAMES.index("P6")] = 1.05 * silent[:, NAMES.index("P1")]
    found = calibrated(rig, replace(full, values=values))
    assert found.dead_sensors == ("P6",)
    assert found.outlier_count == 0
    np.testing.assert_allclose(
        [one.value for one in found.parameters], true_values(truth), rtol=0.02
    )


def test_calibrate_keeps_what_is_not_identified(rig):
    """From 40 to 44 Hz springs outweigh bolts and dampers: these are kept and reported."""
    frequencies = np.linspace(40.0, 44.0, 4)
    truth = perturbed(rig, frequencies=frequencies)
    found = calibrated(rig, measured(truth, frequencies=frequencies, noise=0.05))
    held = [one for one in found.parameters if not one.is_identified]
    assert {one.kind for one in held} >= {"bolt_mass", "damping"}
    assert all(one.value == one.before for one in held)
    for one, true in zip(found.parameters, true_values(truth), strict=True):
        if one.standard_error is not None:
            assert abs(one.value - true) < 5 * one.standard_error


@pytest.mark.long
@pytest.mark.parametrize(("count", "held_out"), [(3, 0), (4, 1)])
def test_calibrate_is_good_only_where_a_sensor_is_left_to_check_it(rig, truth, count, held_out):
    """Of four places one is predicted from three; three leave none, as two tell nothing."""
    full = measured(truth)
    few = full.without(~np.isin(NAMES, ["P1", "P4", "P7", "P9"][:count]))
    found = calibrated(rig, few)
    assert len(found.held_out.sensors if found.held_out else ()) == held_out
    assert found.is_good == bool(held_out)


def test_calibrate_refuses_gains_that_no_drive_has(rig, truth):
    """Eight times the response at one frequency of one ERA, at all sensors alike."""
    full = measured(truth)
    values = full.values.copy()
    values[5, :, 1] *= 8
    with pytest.raises(InputError, match=r"gains of ERA SE .* factor of 5 .* to [78]\.\d of it"):
        calibrated(rig, replace(full, values=values))


@pytest.mark.long
def test_calibrate_estimates_all_scales_when_requested(rig, truth):
    """Every sensor's scale relative to their median, also of one mounted upside down."""
    found = calibrated(rig, measured(truth, scales={"P2": -1.0, "P5": 1.01}), all_scales=True)
    scales = {name: scale for name, (scale, _) in found.scales.items()}
    assert list(scales) == list(NAMES)
    assert scales["P2"] == pytest.approx(-1.0, abs=0.005)
    assert scales["P5"] == pytest.approx(1.01, abs=0.005)
    assert scales["P12"] == pytest.approx(1.0, abs=0.005)


def test_calibrate_refuses_too_few_sensors_and_silence(rig, truth):
    """Two live sensors, and silence."""
    full = measured(truth)
    two = full.without(np.arange(len(NAMES)) > 1)
    with pytest.raises(InputError, match="got 2"):
        calibrated(rig, two)
    with pytest.raises(InputError, match="zero"):
        calibrated(rig, replace(full, values=0 * full.values))
