"""A rig identified in place: refusals, repeatability, the new rig and its file.

Boards with moduli or exciters of their own and amplifiers whose clocks are off are found from their
responses. These, and their derivatives, are those of the plate solved anew.
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kit.direct_plate import direct_acceleration
from kit.plates import as_sold, exciter_rig, exciter_rig_text
from kit.thin_plates import Hidden, draw, parameters_held
from model.arrays import ComplexArray, FloatArray
from model.config.document import parse_document
from model.errors import InputError
from model.estimate.forward import (
    SENSOR_FOOT,
    ForwardModel,
    Sensor,
)
from model.estimate.identification_report import fit_rows, identification_json, parameter_rows
from model.estimate.identify import (
    MAX_CHI2,
    Identification,
    identification_errors,
    identify,
)
from model.estimate.measurement import Measurement, Repeat
from model.estimate.parameter_space import PlateValues, Space
from model.estimate.parameters import jacobian
from model.estimate.rig_parameters import inwards, rig_with, space_of
from model.fem import ELEMENTS, Mesh, assemble
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig, rig_of
from model.rig.rig_mesh import mesh_of
from model.rig.rig_writing import document_for, save_fitted
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.plate_mesh import SpectralMesh
from model.structure.attachments import PointLoad
from model.structure.exciter import Exciter
from model.structure.material import Material, Orthotropy
from model.structure.plate import Bond, Laminate, LaminateLayer, equivalent_plate
from model.study.expected_contrast import expected_contrast

FREQUENCIES = np.linspace(40.0, 500.0, 21)
ONE_ROUND = (np.arange(len(FREQUENCIES))[:, None] + np.arange(4)) % 4 == 0


def at_eras(
    rig: Rig, plate: Hidden, tones: FloatArray, *, seed: int | list[int], sensors: int = 4
) -> Measurement:
    """What sensors at ERAs read of a hidden plate."""
    values = plate.measured(tones, np.random.default_rng(seed), sensors)
    return Measurement([Sensor(era.name, era.name) for era in rig.eras[:sensors]], tones, values)


@pytest.fixture(scope="module")
def measurement(rig: Rig) -> Measurement:
    """Interleaved tones of a thin plate with places and a mass of its own."""
    whole = at_eras(rig, draw("form", 3), FREQUENCIES, seed=3)
    return whole.part(np.broadcast_to(ONE_ROUND[:, None], whole.values.shape))


@pytest.fixture(scope="module")
def found(rig: Rig, measurement: Measurement) -> Identification:
    """The rig as the measurement shows it."""
    return identify(rig, measurement)


def test_identified_rig_states_less_uncertainty_but_for_fingers(
    found: Identification, measurement: Measurement
) -> None:
    """Thickness and springs are known better; drives repeat to 1 %; fingers are as they were.

    So are harmonics, of which responses to single tones say nothing. Of means of four drives and of
    four sensors, 5 % each, only the product is measured: without any error of measurement
    0.05 / sqrt(4) / sqrt(2) is left of either. Every third tone again tells little more of what is
    known to a fraction of what is built.
    """
    before, after = found.before.uncertainty, found.rig.uncertainty
    assert after.thickness < before.thickness / 5
    assert after.stiffness < before.stiffness / 5
    assert 0.01 <= after.gain < before.gain
    assert (after.fingertip, after.harmonic) == (before.fingertip, before.harmonic)
    assert after.common_gain == pytest.approx(0.05 / np.sqrt(8), rel=0.05)
    few = measurement.part(np.arange(len(FREQUENCIES))[:, None, None] % 3 == 0)
    again = identify(found.rig, few).rig.uncertainty
    assert again.stiffness < 0.02
    assert again.thickness < 0.005


@pytest.mark.long
def test_the_same_data_again_tell_no_more_of_the_level(rig: Rig) -> None:
    """What is unknown of the level stays, and the level itself, since the sensors may be the same.

    Drives that repeat to 1 % each add 0.5 % of their mean. A fit that takes the sensors for new
    ones moves half of their own level into that of the drives, each time.
    """
    read = at_eras(rig, draw("plain", 3), np.linspace(40.0, 500.0, 47), seed=3)
    same = replace(read, values=1.1 * read.values)
    once = identify(rig, same)
    again = identify(once.rig, same)
    first, second = (each.rig.uncertainty.common_gain for each in (once, again))
    assert first <= second <= np.hypot(first, 0.006)
    level, moved = (np.log(np.abs(each.values["gain"])).mean() for each in (once, again))
    assert level > 0.03
    assert abs(moved) < 0.1 * level


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        pytest.param(
            lambda right: replace(right, values=right.values / 9.80665),
            r"must be acceleration in m/s².* responses of about 0\.1.* check the units",
            id="in g",
        ),
        pytest.param(
            lambda right: replace(right, values=-right.values),
            "must be acceleration in m/s²",
            marks=pytest.mark.long,
            id="all upside down",
        ),
        pytest.param(
            lambda right: replace(right, values=right.values * [[1.0], [1.0], [-1.0], [1.0]]),
            "must be acceleration in m/s²",
            id="one sensor upside down",
        ),
        pytest.param(
            lambda right: right.part(np.arange(4) != 1),
            r"gain SE: .*, before 4\.3 %; play ERA SE at.*phase SE: .*, before 4\.3°; play ERA SE",
            id="no SE",
        ),
        pytest.param(
            lambda right: Measurement(
                right.sensors,
                right.frequencies,
                np.where(np.arange(4)[:, None] == 1, 0, right.values),
            ),
            "std must be above zero",
            id="a sensor that reads exactly nothing",
        ),
        pytest.param(
            lambda right: replace(right, values=np.full_like(right.values, np.nan)),
            "at least .* values, got 0",
            id="no values",
        ),
        pytest.param(
            lambda right: replace(right, frequencies=right.frequencies[::-1]),
            "frequencies must ascend",
            id="backwards",
        ),
    ],
)
def test_measurements_that_tell_nothing_true_are_refused(
    rig: Rig,
    measurement: Measurement,
    wrong: Callable[[Measurement], Measurement],
    said: str,
) -> None:
    """Of units and signs the fit explains each by gains that nothing has.

    Without tones of SE its gain is unknown: the advice is to play SE. Relative to the mean of four
    drives, a gain known to 5 % and a phase known to 5° are known to sqrt(3/4) of that. A sensor
    that reads exactly nothing has no error.
    """
    with pytest.raises(InputError, match=said):
        identify(rig, wrong(measurement))


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


@pytest.mark.long
def test_uneven_plate_is_promised_less(rig: Rig, found: Identification) -> None:
    """A thickness that differs by 3 % over the plate is what no parameter explains: it is written.

    Fields off by more than 1 % at quiet fingers leave less to promise to one; the report says it.
    Without harmonics of ERAs: at 1 % these alone keep promises near to where such fields have them.
    """
    uneven = identify(rig, at_eras(rig, draw("uneven", 3), FREQUENCIES, seed=3))
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
    # The disagreement of held-out paths is stated once, as an error of fields.
    assert uneven.uncertainty(known.field) == known
    assert fit_rows(uneven)[3:]
    assert not fit_rows(found)[3:]


@pytest.mark.long
def test_errors_of_an_uneven_plate_are_as_wide_as_paths_disagree(rig: Rig) -> None:
    """On four uneven plates 60 % of springs and gains are within two standard errors, and not 30.

    Relative to the plate's mass, and to the gains' mean; 95 % where the model is right.
    """
    errors: list[float] = []
    for seed in (2, 3, 4, 5):
        plate = draw("uneven", seed)
        identified = identify(rig, at_eras(rig, plate, FREQUENCIES, seed=seed))
        off = parameters_held(identified, plate.mounted)
        errors += [*np.abs(off["stiffness"]), *np.abs(off["gain"])]
    assert np.mean(np.array(errors) < 2) > 0.6


def test_file_with_identified_values_reads_back(found: Identification, tmp_path: Path) -> None:
    """The rig that stands beside the file is the one identified, with the errors of the table."""
    shutil.copy(example_rig_path(), tmp_path / "rig.yaml")
    path, before = tmp_path / "identified.yaml", load_rig(tmp_path / "rig.yaml")
    save_fitted(path, before, found.rig, comment="identified", errors=identification_errors(found))
    back, rows = load_rig(path), identification_json(found, [])["parameters"]
    printed = {each["name"]: each for each in rows}
    written: Any = back.document.over.data["standard_errors"]
    values = {"thickness": before.plate.thickness, "loss_factor": before.plate.loss_factor}
    for key, value in values.items():
        error = 100 * written["plate"][key] / value
        assert error == pytest.approx(printed[key.replace("_", " ")]["standard_error"], rel=0.01)
    for era, other, expected in zip(before.eras, back.eras, found.rig.eras, strict=True):
        row = printed[f"stiffness {era.name}"]
        error = 100 * written["eras"][era.name]["stiffness"] / era.stiffness
        assert error == pytest.approx(row["standard_error"], rel=0.01)
        difference = 100 * (other.stiffness / era.stiffness - 1)
        assert row["difference"] == pytest.approx(difference, rel=1e-3)
        np.testing.assert_allclose([other.x, other.y], [expected.x, expected.y], atol=1e-6)
        np.testing.assert_allclose(other.gains, expected.gains, atol=1e-4)
        assert other.damping == pytest.approx(expected.damping, rel=1e-5)
    plate = found.rig.plate
    assert back.plate.thickness == pytest.approx(plate.thickness, rel=1e-5)
    assert pytest.approx(plate.material.E, rel=1e-5) == back.plate.material.E
    assert back.plate.loss_exponent == pytest.approx(plate.loss_exponent, rel=1e-5)
    np.testing.assert_allclose(back.plate.mode_deviations, plate.mode_deviations, atol=1e-4)
    assert back.masses[0].mass == pytest.approx(found.rig.masses[0].mass, rel=1e-5)
    assert back.uncertainty.stiffness == pytest.approx(found.rig.uncertainty.stiffness, rel=1e-5)


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
    sizes = np.abs(measurement.values)
    row, _, era = np.argwhere(sizes == np.nanmax(sizes))[0]
    name, values = rig.eras[era].name, measurement.values[row, :, era]
    refused, taken = (
        replace(measurement, **{kind: (Repeat(name, FREQUENCIES[row], values, by * values),)})
        for by in (change, allowed)
    )
    taken.check()
    with pytest.raises(InputError):
        refused.check()


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
    frame, uneven = (
        identify(rig, at_eras(rig, draw(kind, seed), FREQUENCIES, seed=[seed, 1], sensors=sensors))
        for kind, seed in (("frame", 1), ("uneven", 3))
    )
    assert frame.chi2 < 2
    assert not frame.is_explained
    assert "does not explain" in fit_rows(frame)[0]
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
    back = rig_of(document_for(found.rig))
    assert back.plate.material.moduli == pytest.approx(known.material.moduli, rel=1e-5)


FORWARD_FREQUENCIES = np.array([60.0, 140.0, 222.0, 350.0, 480.0])
PAD = Sensor("pad", x=0.1, y=0.07)


@pytest.fixture(scope="module")
def model(rig: Rig) -> ForwardModel:
    """That plate with sensors at its ERAs and elsewhere, and an additional mass."""
    sensors = [*(Sensor(era.name, era.name) for era in rig.eras), PAD]
    names = [sensor.name for sensor in sensors]
    space = space_of(rig, names, rig.uncertainty, drives_lag=True, masses=1)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    return ForwardModel(rig, sensors, FORWARD_FREQUENCIES, space, free)


def somewhere(space: Space, seed: int) -> FloatArray:
    """Parameters that all differ from the rig's, within their bounds."""
    x = 0.5 * np.random.default_rng(seed).standard_normal(space.size)
    x[space.groups["masses"].start] = 1.0
    lag = space.of("inertia", "drag")
    x[lag] = np.abs(x[lag])
    x = np.clip(x, space.lower + 0.1, space.upper - 0.1) * space.uncertain
    return inwards(space, x, by=0.6)


def of_a_laminate(model: ForwardModel) -> ForwardModel:
    """The model with a plate of glass, whose modes lose in a soft layer."""
    glass = Material("glass", E=70e9, rho=2500.0, nu=0.23)
    soft = Material("soft", E=6e6, rho=1000.0, nu=0.49)
    laminate = Laminate(
        (
            LaminateLayer(glass, 1e-3),
            LaminateLayer(soft, 0.5e-3, loss_factor=0.5),
            LaminateLayer(glass, 1e-3),
        ),
        bond=Bond.FULL,
    )
    plate = equivalent_plate(laminate, length=0.3048, width=0.2286, frequency=500.0)
    mesh = mesh_of("auto", plate, frequency_max=500.0, stiffness=17_000.0)
    free = solve_free_plate(plate, mesh, frequency_max=500.0)
    assert free.modes.losses.any()
    rig = replace(model.rig, plate=plate, laminate=laminate)
    return replace(model, rig=rig, free=free)


def test_drive_lags_as_an_actuator_with_a_resonance(model: ForwardModel) -> None:
    """By hand: at its resonance of 500 Hz, with a damping ratio of 0.3, 1 / (2 i 0.3) times."""
    space, x = model.space, np.zeros(model.space.size)
    for name, value in (("inertia of drive SE", 4.0), ("drag of drive SE", 1.2)):
        x[space.index(name)] = value / space.std[space.index(name)]
    at_resonance = replace(model, frequencies=np.array([500.0]))
    lagging, rigid = (at_resonance.at(each).responses[0] for each in (x, np.zeros(space.size)))
    np.testing.assert_allclose(lagging[:, 1], rigid[:, 1] / 0.6j)
    np.testing.assert_allclose(lagging[:, [0, 2, 3]], rigid[:, [0, 2, 3]])


def test_rig_with_a_lagging_drive_keeps_its_measured_gains(model: ForwardModel) -> None:
    """By hand: the measured gain times the lag of a resonance at 500 Hz."""
    space, x = model.space, np.zeros(model.space.size)
    for name, value in (("inertia of drive SE", 4.0), ("drag of drive SE", 1.2)):
        x[space.index(name)] = value / space.std[space.index(name)]
    values = PlateValues(model.rig, space, x)
    gains = ((60.0, 0.8, 0.3), (500.0, 1.2, -0.5))
    eras = [replace(era, gains=gains) if era.name == "SE" else era for era in model.rig.eras]
    measured = replace(model.rig, eras=tuple(eras))
    frequencies = np.array([100.0, 300.0, 400.0])
    found = rig_with(measured, values, model.rig.uncertainty).eras[1].gain(frequencies)
    kilohertz = 1e-3 * frequencies
    expected = eras[1].gain(frequencies) / (1 - 4.0 * kilohertz**2 + 1.2j * kilohertz)
    np.testing.assert_allclose(found, expected, rtol=1e-3)


KEYS = "type: DAEX25FHE-4, power: 1 W"
PARTS = "uncertainty: {gain: 0.2, phase_deg: 10, stiffness: 0.2, modulus: 0.1, thickness: 0.02}"
FEET = (
    "supports: {rubber: {at: [0.12, 0.1], kind: rubber, foot: 5 mm}, "
    "gauze: {at: [0.2, 0.06], stiffness: 1}}"
)
FOAM = "supports: {foam: {at: [0.12, 0.1], kind: foam, foot: 5 mm}}"
TONES = np.array([42.0, 80.0, 150.0, 250.0])
MASS = 2e-3
MOVED = Sensor("moved", x=0.2, y=0.15, mass=MASS)


def model_of(rig: Rig) -> ForwardModel:
    """The board with a sensor beside exciters, one that is moved, and one that is moved to one."""
    sensors = [Sensor("fixed", x=0.1, y=0.07), MOVED, Sensor("SW", "SW", mass=MASS)]
    names = [sensor.name for sensor in sensors]
    space = space_of(rig, names, rig.uncertainty, masses=1)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    return ForwardModel(rig, sensors, TONES, space, free)


@pytest.mark.parametrize("kind", ["ERAs", "laminate", "free", "held"])
def test_derivatives_are_slopes_of_the_responses(model: ForwardModel, kind: str) -> None:
    """Every analytic derivative is that of a central difference, to 1e-4, of lossy modes too.

    Of exciters by suspension, magnet, coil, force factor and a foot, with a sensor moved: a magnet
    that a frame holds has no weight that is felt.
    """
    if kind == "laminate":
        model = of_a_laminate(model)
    elif kind != "ERAs":
        keys = f"{KEYS}, magnet: {kind}"
        model = model_of(exciter_rig(keys, frequency="[40, 300]", more=f"{PARTS}\n{FOAM}"))
    space, step = model.space, 1e-4
    x = somewhere(space, 2)
    found, size = jacobian(model.at(x)), np.abs(model.at(x).responses).max()
    for number in np.flatnonzero(space.uncertain):
        moved = step * np.eye(space.size)[number]
        slope = (model.at(x + moved).responses - model.at(x - moved).responses) / (2 * step)
        error = np.abs(found[..., number] - slope).max() / max(np.abs(slope).max(), 1e-6 * size)
        assert error < 1e-4, space.names[number]
    if kind in ("free", "held"):
        assert {"magnet mass SW", "force factor NE"} <= {*space.names}
        assert space.std[space.index("stiffness of foot foam")] == 0.3
        assert found[..., space.groups["magnet_mass"]].any() == (kind == "free")


def test_copied_model_with_another_plate_has_the_shapes_of_that_plate(model: ForwardModel) -> None:
    """A laminate responds as its own solution does, after the rig's plate at the same positions."""
    known = np.zeros(model.space.size)
    _ = model.at(known).responses
    other = of_a_laminate(model)
    rig = other.rig
    pad = np.array([[PAD.x, PAD.y]])
    solved = other.free.acceleration(rig.eras, FORWARD_FREQUENCIES, pad, loads=rig.masses)
    expected = solved[..., 0] / [era.full_level for era in rig.eras]
    np.testing.assert_allclose(other.at(known).responses[:, -1], expected, rtol=1e-5)


def test_moved_sensor_weighs_on_the_plate_where_it_measures() -> None:
    """As a mass there in a solution of its own, 1.5 % of the response; elsewhere as without it."""
    rig = exciter_rig(KEYS, frequency="[40, 300]", more=PARTS)
    assert isinstance(rig.mesh, SpectralMesh)

    def solved(place: list[float], *loads: PointLoad) -> ComplexArray:
        found = direct_spectral_acceleration(
            rig.plate, rig.mesh, rig.eras, TONES, np.array([place]), loads=[*rig.masses, *loads]
        )
        return found.swapaxes(1, 2)[:, 0] / [era.full_level for era in rig.eras]

    model = model_of(rig)
    responses = model.at(np.zeros(model.space.size)).responses
    at = [MOVED.x, MOVED.y, SENSOR_FOOT]
    expected = solved(at, PointLoad(MOVED.x, MOVED.y, mass=MASS, foot=SENSOR_FOOT))
    np.testing.assert_allclose(responses[:, 1], expected, atol=1e-6 * np.abs(expected).max())
    assert np.abs(expected - solved(at)).max() > 0.01 * np.abs(expected).max()
    alone = solved([0.1, 0.07, 0.0])
    np.testing.assert_allclose(responses[:, 0], alone, atol=1e-6 * np.abs(alone).max())


def measured(rig: Rig, tones: FloatArray, places: FloatArray) -> Measurement:
    """What a moved sensor of 2 g reads of a board, by finite elements, with 0.2 % of noise."""
    rng, plate = np.random.default_rng(9), rig.plate
    matrices = assemble(plate, Mesh(6, 5, plate.length, plate.width, ELEMENTS["Q4"]))
    values = []
    for x, y in places.tolist():
        load = PointLoad(x, y, mass=MASS, foot=SENSOR_FOOT)
        found = direct_acceleration(
            matrices, rig.eras, tones, np.array([[x, y]]), loads=[*rig.masses, load]
        )
        values.append(found[..., 0] / [era.full_level for era in rig.eras])
    responses = np.array(values).swapaxes(0, 1)
    noise = rng.standard_normal((2, *responses.shape))
    sensors = [Sensor(f"P{n}", x=x, y=y, mass=MASS) for n, (x, y) in enumerate(places.tolist())]
    noisy = responses + 0.002 * np.abs(responses) * (noise[0] + 1j * noise[1])
    return Measurement(sensors, tones, noisy)


@pytest.mark.long
def test_identified_board_has_the_parts_that_it_was_built_of() -> None:
    """Stiffness within 2 %, magnet within 5 % and force within 1 %, from a rig file to a rig file.

    Parts are off by 20 %; the level of all is shared with the sensor's, of which 3 % are left. The
    file has the values found in place of a type's resonance and quality. A foot of rubber is found
    within 5 %, and of one of 1 N/m the report says that it is not.
    """
    text = exciter_rig_text(KEYS, frequency="[40, 300]", more=f"{PARTS}\n{FEET}")
    document = parse_document("board.yaml", text)
    rig = rig_of(document)
    sold = as_sold(rig, np.random.default_rng(4), modulus=0.05)
    feet = tuple(
        replace(each, stiffness=each.stiffness / (1 + 0.2 * each.is_foot)) for each in rig.masses
    )
    built = replace(sold, plate=replace(sold.plate, loss_factor=0.06), masses=feet)
    places = np.array([[0.06, 0.05], [0.17, 0.04], [0.26, 0.09], [0.05, 0.17], [0.15, 0.12]])
    places = np.vstack([places, [[0.24, 0.2]]])
    found = identify(rig, measured(built, np.linspace(42.0, 298.0, 13), places))
    assert found.is_explained
    again = rig_of(document_for(found.rig))
    forces = []
    for true, after in zip(built.eras, again.eras, strict=True):
        assert isinstance(true, Exciter)
        assert isinstance(after, Exciter)
        assert after.stiffness == pytest.approx(true.stiffness, rel=0.02)
        assert after.magnet_mass == pytest.approx(true.magnet_mass, rel=0.05)
        omega = np.array([2 * np.pi * 200])
        forces.append(after.force(omega)[0] / true.force(omega)[0])
    rubber = again.masses[again.feet[again.foot_names.index("rubber")]]
    assert rubber.stiffness == pytest.approx(30e3 / 1.2, rel=0.05)
    rows = [row for row in parameter_rows(found) if "foot" in row]
    assert [row.split("  ")[0] for row in rows] == [
        "stiffness of foot rubber",
        "stiffness of foot gauze",
    ]
    assert ["not identified" in row for row in rows] == [False, True]
    common = np.mean(forces)
    assert abs(common - 1) < 0.03
    np.testing.assert_allclose(np.array(forces) / common, 1.0, atol=0.01)
