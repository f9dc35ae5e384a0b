"""A rig identified in place: refusals, repeatability, the new rig and its file.

A board whose moduli differ each by itself, found from its responses.

Clocks of two amplifiers that are off, found by the sensors of a hidden plate.
"""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.identification.coverage import parameters_held
from benchmarks.identification.hidden import Hidden, draw
from model.arrays import FloatArray
from model.config.document import parse_document
from model.errors import InputError
from model.estimate.fit_report import clock_rows, fit_rows, identification_json
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.identify import (
    MAX_CHI2,
    ClockEstimate,
    Identification,
    clock_estimates,
    identify,
    standard_errors,
)
from model.estimate.measurement import Measurement, Repeat
from model.estimate.space import space_of
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Channel, Rig
from model.rig.rig_file import example_rig_path, load_rig, rig_of
from model.rig.rig_writing import save_fitted, stated
from model.spectral.modes import SpectralMesh
from model.structure.material import Orthotropy
from model.study.verification import expected_contrast
from plates import SETTLED_PATTERNS_FREQUENCIES

FREQUENCIES = np.linspace(40.0, 500.0, 21)
ONE_ROUND = (np.arange(len(FREQUENCIES))[:, None] + np.arange(4)) % 4 == 0


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    """A thin plate with places and a mass of its own."""
    return draw("form", 3)


@pytest.fixture(scope="module")
def measurement(rig: Rig, hidden: Hidden) -> Measurement:
    """Responses of the hidden plate at its ERAs to interleaved tones."""
    values = hidden.measured(FREQUENCIES, np.random.default_rng(3))
    values = np.where(ONE_ROUND[:, None], values, np.nan)
    return Measurement([Sensor(era.name, era.name) for era in rig.eras], FREQUENCIES, values)


@pytest.fixture(scope="module")
def found(rig: Rig, measurement: Measurement) -> Identification:
    """The rig as the measurement shows it."""
    return identify(rig, measurement)


def test_identified_rig_states_less_uncertainty_but_for_fingers(found: Identification) -> None:
    """Thickness and springs are known better; drives repeat to 1 %; fingers are as they were.

    So are harmonics, of which responses to single tones say nothing.
    """
    before, after = found.before.uncertainty, found.rig.uncertainty
    assert after.thickness < before.thickness / 5
    assert after.stiffness < before.stiffness / 5
    assert 0.01 <= after.gain < before.gain
    assert (after.fingertip, after.harmonic) == (before.fingertip, before.harmonic)


def test_level_of_all_drives_is_known_as_far_as_four_sensors_tell(found: Identification) -> None:
    """Means of four drives and of four sensors, 5 % each, of which only the product is measured.

    Without any error of measurement 0.05 / sqrt(4) / sqrt(2) is left of either.
    """
    assert found.rig.uncertainty.common_gain == pytest.approx(0.05 / np.sqrt(8), rel=0.05)


def test_the_same_data_again_tell_no_more_of_the_level(rig: Rig) -> None:
    """What is unknown of the level stays, and the level itself, since the sensors may be the same.

    Drives that repeat to 1 % each add 0.5 % of their mean. A fit that takes the sensors for new
    ones moves half of their own level into that of the drives, each time.
    """
    tones = np.linspace(40.0, 500.0, 47)
    values = draw("plain", 3).measured(tones, np.random.default_rng(3))
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    same = Measurement(sensors, tones, 1.1 * values)
    once = identify(rig, same)
    again = identify(once.rig, same)
    first, second = (each.rig.uncertainty.common_gain for each in (once, again))
    assert first <= second <= np.hypot(first, 0.006)
    level, moved = (np.log(np.abs(each.values["gain"])).mean() for each in (once, again))
    assert level > 0.03
    assert abs(moved) < 0.1 * level


def test_identified_rig_is_identified_again_by_few_tones(
    found: Identification, measurement: Measurement
) -> None:
    """Every third tone tells little more of what is known to a fraction of what is built."""
    few = measurement.part(np.arange(len(FREQUENCIES))[:, None, None] % 3 == 0)
    again = identify(found.rig, few).rig.uncertainty
    assert again.stiffness < 0.02
    assert again.thickness < 0.005


@pytest.mark.parametrize(
    "factors",
    [
        pytest.param(np.full(4, 1 / 9.80665), marks=pytest.mark.long),
        pytest.param(np.full(4, -1.0), marks=pytest.mark.long),
        np.array([1.0, 1.0, -1.0, 1.0]),
    ],
)
def test_other_units_and_signs_are_refused(
    rig: Rig, measurement: Measurement, factors: FloatArray
) -> None:
    """In g, all or one sensor upside down: the fit explains each by gains that nothing has."""
    wrong = replace(measurement, values=measurement.values * factors[:, None])
    with pytest.raises(InputError):
        identify(rig, wrong)


def test_contrast_is_promised_of_an_explained_plate(found: Identification) -> None:
    """Identified answers give more than those of the rig as written.

    Nothing is promised of a plate that the model does not explain.
    """
    assert found.can_promise
    for each in expected_contrast(found.before, found.rig, seed=1, frequencies=FREQUENCIES, sets=4):
        assert each.after > each.before
        assert each.promised < each.after
    far_off = replace(found.fitted, residuals=2 * found.fitted.residuals)
    assert not replace(found, fitted=far_off).can_promise


def test_uneven_plate_is_promised_less(rig: Rig, found: Identification) -> None:
    """A thickness that differs by 3 % over the plate is what no parameter explains: it is written.

    Fields off by more than 1 % at quiet fingers leave less to promise to one; the report says it.
    Without harmonics of ERAs: at 1 % these alone keep promises near to where such fields have them.
    """
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    values = draw("uneven", 3).measured(FREQUENCIES, np.random.default_rng(3))
    uneven = identify(rig, Measurement(sensors, FREQUENCIES, values))
    assert uneven.is_explained
    known = uneven.rig.uncertainty
    assert known.field > 0.01
    assert found.rig.uncertainty.field < 0.005
    linear = replace(known, harmonic=0.0)
    promised, too_much = (
        expected_contrast(
            rig,
            replace(uneven.rig, uncertainty=uncertainty),
            seed=1,
            frequencies=FREQUENCIES,
            sets=4,
        )[0].promised
        for uncertainty in (linear, replace(linear, field=0.0))
    )
    assert promised < too_much - 1
    assert fit_rows(uneven)[3:]
    assert not fit_rows(found)[3:]


@pytest.mark.long
def test_errors_of_an_uneven_plate_are_as_wide_as_paths_disagree(rig: Rig) -> None:
    """On four uneven plates 60 % of springs and gains are within two standard errors, and not 30.

    Relative to the plate's mass, and to the gains' mean; 95 % where the model is right.
    """
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    errors: list[float] = []
    for seed in (2, 3, 4, 5):
        plate = draw("uneven", seed)
        values = plate.measured(FREQUENCIES, np.random.default_rng(seed))
        identified = identify(rig, Measurement(sensors, FREQUENCIES, values))
        off = parameters_held(identified, plate.mounted)
        errors += [*np.abs(off["stiffness"]), *np.abs(off["gain"])]
    assert np.mean(np.array(errors) < 2) > 0.6


def test_file_with_identified_values_reads_back(found: Identification, tmp_path: Path) -> None:
    """The rig that stands beside the file is the one identified, with the errors of the table."""
    shutil.copy(example_rig_path(), tmp_path / "rig.yaml")
    path, before = tmp_path / "identified.yaml", load_rig(tmp_path / "rig.yaml")
    save_fitted(path, before, found.rig, comment="identified", errors=standard_errors(found))
    back, rows = load_rig(path), identification_json(found, [])["parameters"]
    printed = {each["name"]: each["standard_error"] for each in rows}
    assert back.document is not None
    assert back.document.over is not None
    written: Any = back.document.over.data["standard_errors"]
    values = {"thickness": before.plate.thickness, "loss_factor": before.plate.loss_factor}
    for key, value in values.items():
        error = 100 * written["plate"][key] / value
        assert error == pytest.approx(printed[key.replace("_", " ")], rel=0.01)
    for era in before.eras:
        error = 100 * written["eras"][era.name]["stiffness"] / era.stiffness
        assert error == pytest.approx(printed[f"stiffness {era.name}"], rel=0.01)
    differences = {each["name"]: each["difference"] for each in rows}
    for era, other in zip(before.eras, back.eras, strict=True):
        expected = 100 * (other.stiffness / era.stiffness - 1)
        assert differences[f"stiffness {era.name}"] == pytest.approx(expected, rel=1e-3)
    assert back.plate.thickness == pytest.approx(found.rig.plate.thickness, rel=1e-5)
    assert pytest.approx(found.rig.plate.material.E, rel=1e-5) == back.plate.material.E
    assert back.plate.loss_exponent == pytest.approx(found.rig.plate.loss_exponent, rel=1e-5)
    np.testing.assert_allclose(
        back.plate.mode_deviations, found.rig.plate.mode_deviations, atol=1e-4
    )
    for era, expected in zip(back.eras, found.rig.eras, strict=True):
        np.testing.assert_allclose([era.x, era.y], [expected.x, expected.y], atol=1e-6)
        np.testing.assert_allclose(era.gains, expected.gains, atol=1e-4)
        assert era.damping == pytest.approx(expected.damping, rel=1e-5)
    assert back.masses[0].mass == pytest.approx(found.rig.masses[0].mass, rel=1e-5)
    assert back.uncertainty.stiffness == pytest.approx(found.rig.uncertainty.stiffness, rel=1e-5)


def test_era_that_never_played_is_named_with_the_tone_that_helps(
    rig: Rig, measurement: Measurement
) -> None:
    """Without tones of SE its gain is unknown; the advice is to play SE."""
    silent = measurement.part(np.arange(4) != 1)
    with pytest.raises(InputError, match=r"gain SE.*play ERA SE at"):
        identify(rig, silent)


@pytest.mark.parametrize(
    ("kind", "change", "allowed"),
    [
        pytest.param("half_level", 1.022, 1.018, id="half"),
        pytest.param("at_end", 1.012, 1.008, id="end"),
    ],
)
def test_plate_that_is_not_linear_or_drifts_is_refused(
    rig: Rig, measurement: Measurement, kind: str, change: float, allowed: float
) -> None:
    """One that responds otherwise by 2 % at half the level, or by 1 % at the end, is refused."""
    row, _, era = np.argwhere(np.abs(measurement.values) == np.nanmax(np.abs(measurement.values)))[
        0
    ]
    values, frequency = measurement.values[row, :, era], float(FREQUENCIES[row])
    for factor, is_refused in ((change, True), (allowed, False)):
        repeat = Repeat(rig.eras[era].name, frequency, values, factor * values)
        repeated = replace(measurement, **{kind: (repeat,)})
        if is_refused:
            with pytest.raises(InputError):
                repeated.check()
        else:
            repeated.check()


def test_values_without_an_error_and_frequencies_in_another_order_are_refused(
    rig: Rig, measurement: Measurement
) -> None:
    """A sensor that reads exactly nothing has neither; so has a measurement without values."""
    silent = np.where(np.arange(measurement.values.shape[1])[:, None] == 1, 0, measurement.values)
    for values, frequencies in (
        (silent, FREQUENCIES),
        (np.full_like(measurement.values, np.nan), FREQUENCIES),
        (measurement.values, FREQUENCIES[::-1]),
    ):
        with pytest.raises(InputError):
            identify(rig, Measurement(measurement.sensors, frequencies, values))


@pytest.mark.long
def test_plate_of_another_kind_is_not_explained(rig: Rig, measurement: Measurement) -> None:
    """A sensor whose phases are conjugated leaves chi² beyond what promises anything."""
    wrong = measurement.values.copy()
    wrong[:, 2] = wrong[:, 2].conj()
    assert identify(rig, replace(measurement, values=wrong)).chi2 > MAX_CHI2


@pytest.mark.long
@pytest.mark.parametrize("sensors", [3, 4])
def test_bonded_frame_is_not_known_well_by_sensors_at_feet(rig: Rig, sensors: int) -> None:
    """Modes stiffened along the edges (bending +80 %, mass +35 %) leave chi² below 2.

    Nothing is promised of such a plate. Of an uneven one, whose fields are known, all is.
    """
    found = []
    for kind, seed in (("frame", 1), ("uneven", 3)):
        values = draw(kind, seed).measured(FREQUENCIES, np.random.default_rng([seed, 1]), sensors)
        heard = [Sensor(era.name, era.name) for era in rig.eras[:sensors]]
        found.append(identify(rig, Measurement(heard, FREQUENCIES, values)))
    frame, uneven = found
    assert frame.chi2 < 2
    assert not frame.is_explained
    assert frame.rig.uncertainty == rig.uncertainty
    assert identification_json(frame, [])["known_well"] is False
    assert uneven.is_explained


TEXT = """\
plate: {length: 400 mm, width: 300 mm, thickness: 6.4 mm, material: plywood}
eras:
  A: {at: [72 mm, 72 mm], stiffness: 10 kN/m, amplifier: card, channel: 0}
  B: {at: [316 mm, 51 mm], stiffness: 10 kN/m, amplifier: card, channel: 1}
  C: {at: [336 mm, 234 mm], stiffness: 10 kN/m, amplifier: card, channel: 2}
  D: {at: [108 mm, 243 mm], stiffness: 10 kN/m, amplifier: card, channel: 3}
amplifiers: {card: {url: "sim://"}}
uncertainty: {modulus: 10 %}
limits: {frequency: [60, 300]}
"""
HIDDEN = {"E1": 1.01, "E2": 0.98, "G12": 1.07}
"""Factors on the moduli of the rig's plywood, of which no single one on all gives its modes."""


@pytest.mark.long
def test_moduli_along_across_and_of_shear_are_found() -> None:
    """Each within 3 % from responses of a finer solution, and written into the rig's file.

    The thickness weighs the board and is known; all else of the board is that of the rig.
    """
    document = parse_document("board.yaml", TEXT)
    rig = rig_of(document)
    own = rig.plate.material
    moduli = {key: HIDDEN.get(key, 1.0) * each for key, each in own.moduli.items()}
    E = moduli.pop("E1")
    material = replace(own, E=E, orthotropy=Orthotropy(*(each / E for each in moduli.values())))
    mesh = SpectralMesh(18, 15, 0.4, 0.3)
    free = solve_free_plate(replace(rig.plate, material=material), mesh, frequency_max=300.0)
    tones, places = np.linspace(60.0, 300.0, 41), [[era.x, era.y] for era in rig.eras]
    responses = free.acceleration(rig.eras, tones, np.array(places)).swapaxes(1, 2)
    noise = np.random.default_rng(1).standard_normal((*responses.shape, 2)) @ [1, 1j]
    responses = responses * (1 + 0.005 * noise) / rig.eras[0].stroke
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    found = identify(rig, Measurement(sensors, tones, responses))
    assert found.is_explained
    known = found.rig.plate
    # A thicker board of a smaller modulus has the same modes: rigidities are what is found.
    for key, factor in HIDDEN.items():
        rigidity = known.material.moduli[key] * known.thickness**3
        before = own.moduli[key] * rig.plate.thickness**3
        assert rigidity / before == pytest.approx(factor, rel=0.03)
    assert any("E2" in row for row in fit_rows(found))
    back = rig_of(stated(found.rig))
    assert back.plate.material.moduli == pytest.approx(known.material.moduli, rel=1e-5)


LATE = 30e-6
"""Delay of amplifier b [s]."""

OF = np.array([0, 0, 1, 1])


def halves() -> tuple[Rig, list[Sensor]]:
    """The paper's plate on two amplifiers of two ERAs, each with sensors at these."""
    rig = load_rig(example_rig_path())
    wiring = {era.name: Channel("ab"[OF[n]], n % 2) for n, era in enumerate(rig.eras)}
    rig = replace(rig, wiring=wiring, amplifiers={"a": "sim://", "b": "sim://"})
    sensors = [Sensor(era, era, amplifier=at.amplifier) for era, at in wiring.items()]
    return rig, sensors


@pytest.fixture(scope="module")
def clocks_found() -> Identification:
    """Identified by tones that b plays late and, with the same clock, hears as early."""
    rig, sensors = halves()
    values = draw("form", 1).measured(SETTLED_PATTERNS_FREQUENCIES, np.random.default_rng(1))
    late = LATE * (OF[None, :] - OF[:, None])
    values = values * np.exp(-2j * math.pi * SETTLED_PATTERNS_FREQUENCIES[:, None, None] * late)
    measurement = Measurement(sensors, SETTLED_PATTERNS_FREQUENCIES, values)
    return identify(rig, replace(measurement, clock_errors={"a": 4e-6, "b": 4e-6}))


def test_a_constant_delay_is_found_and_taken_off(clocks_found: Identification) -> None:
    """Within 5 us of 30, far below the 60 degrees of a gain; the rig's gains of b turn by it."""
    (clock,) = clock_estimates(clocks_found)
    assert clock.amplifier == "b"
    assert clock.delay_us == pytest.approx(1e6 * LATE, abs=5)
    assert clock.error_us < 3
    assert clocks_found.is_explained
    (shown,) = identification_json(clocks_found, ())["clocks"]
    assert shown["delay_us"] == clock.delay_us
    tones = np.array([100.0, 400.0])
    for era in clocks_found.rig.eras[2:]:
        low, high = np.angle(era.gain(tones))
        slope = math.remainder(high - low, 2 * math.pi) / (2 * math.pi * 300.0)
        assert slope == pytest.approx(-LATE, abs=5e-6)
    assert all(len(era.gains) == 1 for era in clocks_found.rig.eras[:2])


@pytest.mark.parametrize(
    ("late", "is_believed"),
    [
        pytest.param(19.9, True, id="late"),
        pytest.param(-20.1, False, id="early"),
    ],
)
def test_a_delay_within_four_standard_errors_is_believed(late: float, is_believed: bool) -> None:
    """Of an estimate known to 3 us and clocks that state 4 us: 5 us together, so up to 20 us."""
    assert ClockEstimate("b", late, 3.0, 4.0).is_believed == is_believed


@pytest.mark.parametrize(("stated", "is_believed"), [(4e-6, False), (17e-6, True)])
def test_a_clock_that_is_off_by_more_than_is_stated_is_accused(
    clocks_found: Identification, stated: float, is_believed: bool
) -> None:
    """30 us are more than four times what two clocks of 4 us make, and less than of 17."""
    measurement = replace(clocks_found.fitted.measurement, clock_errors={"a": stated, "b": stated})
    fitted = replace(clocks_found.fitted, measurement=measurement)
    claimed = replace(clocks_found, fitted=fitted)
    (clock,) = clock_estimates(claimed)
    assert clock.is_believed == is_believed
    assert len(clock_rows(claimed)) == 1 + (not is_believed)


def test_phases_turn_with_the_delays_of_who_plays_and_who_hears() -> None:
    """By hand: exp(-2 pi i f d) between amplifiers, nothing within one; slopes by differences."""
    rig, sensors = halves()
    space = space_of(rig, [each.name for each in sensors], rig.uncertainty, amplifiers=["a", "b"])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    tones = np.array([60.0, 240.0])
    model = ForwardModel(rig, sensors, tones, space, free, amplifiers=["a", "b"])
    x = np.zeros(space.size)
    exact = model.at(x).responses
    number = space.index("delay of amplifier b")
    x[number] = LATE / space.std[number]
    turned = np.angle(model.at(x).responses / exact)
    by_hand = -2 * math.pi * tones[:, None, None] * LATE * (OF[None, :] - OF[:, None])
    np.testing.assert_allclose(turned, by_hand, atol=1e-9)
    assert space.std[space.index("delay of amplifier a")] == 0
