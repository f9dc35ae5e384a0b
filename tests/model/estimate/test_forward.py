"""Responses of the identified plate and their derivatives, against the plate solved anew.

Exciters on a board: derivatives, a sensor that is moved, and parts as the board shows them.
"""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.arrays import ComplexArray, FloatArray
from model.config.document import parse_document
from model.estimate.fit_report import parameter_rows
from model.estimate.forward import (
    FINGER_PARTS,
    SENSOR_FOOT,
    ForwardModel,
    RestingFinger,
    Sensor,
    Space,
    Values,
    by_mass_at,
    jacobian,
)
from model.estimate.identify import identify
from model.estimate.measurement import Measurement
from model.estimate.space import inwards, rig_with, space_by_sheets, space_of
from model.fem import ELEMENTS, Mesh, assemble
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig, mesh_of, rig_of
from model.rig.rig_writing import stated
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh
from model.structure.attachments import Fingertip, FingertipLoad, PointLoad, Support
from model.structure.exciter import Exciter
from model.structure.material import Material
from model.structure.plate import Bond, Laminate, LaminateLayer, equivalent_plate
from plates import exciter_rig, exciter_rig_text

FREQUENCIES = np.array([60.0, 140.0, 222.0, 350.0, 480.0])
PAD = Sensor("pad", x=0.1, y=0.07)
FINGER = RestingFinger(0.2, 0.05, Fingertip())


@pytest.fixture(scope="module")
def model(rig: Rig) -> ForwardModel:
    """That plate with sensors at its ERAs and elsewhere, an additional mass and a finger."""
    sensors = [*(Sensor(era.name, era.name) for era in rig.eras), PAD]
    names = [sensor.name for sensor in sensors]
    space = space_of(rig, names, rig.uncertainty, drives_lag=True, masses=1)
    space = space.and_further("fingers", [f"{part} of finger" for part in FINGER_PARTS])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    return ForwardModel(rig, sensors, FREQUENCIES, space, free, [FINGER])


def somewhere(space: Space, seed: int) -> FloatArray:
    """Parameters that all differ from the rig's, within their bounds."""
    x = 0.5 * np.random.default_rng(seed).standard_normal(space.size)
    x[space.groups["masses"].start] = 1.0
    lag = space.of("inertia", "drag")
    x[lag] = np.abs(x[lag])
    x = np.clip(x, space.lower + 0.1, space.upper - 0.1) * space.uncertain
    return inwards(space, x, by=0.6)


def direct(rig: Rig, loads: list[Support]) -> ComplexArray:
    """Responses at ERAs and pad per base displacement (f, s, n), from the rig solved directly."""
    assert isinstance(rig.mesh, SpectralMesh)
    points = np.array([*((era.x, era.y) for era in rig.eras), (PAD.x, PAD.y)])
    found = direct_spectral_acceleration(
        rig.plate, rig.mesh, rig.eras, FREQUENCIES, points, loads=loads
    )
    return found.swapaxes(1, 2) / [era.stroke for era in rig.eras]


def test_deviating_rig_is_solved_without_solving_it_again(rig: Rig, model: ForwardModel) -> None:
    """Springs, bolts, places, modulus, loss and a mass move the responses as a solution anew."""
    space = model.space
    x = somewhere(space, 1)
    x[space.of("thickness", "mode_shifts", "mode_losses", "sensor_gain", "sensor_phase")] = 0
    x[space.of("gain", "phase", "inertia", "drag", "fingers")] = 0
    values = model.at(x).values
    eras = tuple(
        replace(era, stiffness=k, damping=c, bolt_mass=m, x=place[0], y=place[1])
        for era, k, c, m, place in zip(
            rig.eras,
            values["stiffness"],
            values["damping"],
            values["bolt_mass"],
            values["place"],
            strict=True,
        )
    )
    material = replace(rig.plate.material, E=values["modulus"] * rig.plate.material.E)
    plate = replace(
        rig.plate,
        material=material,
        loss_factor=values["loss"],
        loss_exponent=values["loss_exponent"],
    )
    ((mass, at_x, at_y),) = values["masses"]
    loads: list[Support] = [
        PointLoad(at_x, at_y, mass=mass),
        FingertipLoad(FINGER.x, FINGER.y, FINGER.fingertip),
    ]
    expected = direct(replace(rig, plate=plate, eras=eras), loads)
    found = model.at(x).responses
    np.testing.assert_allclose(found, expected, atol=3e-4 * np.abs(expected).max())


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
    return replace(model, rig=rig, free=free, last_places={})


@pytest.mark.parametrize("is_layered", [False, True], ids=["one material", "laminate"])
def test_derivatives_are_the_slopes_of_the_responses(model: ForwardModel, is_layered: bool) -> None:
    """Every analytic derivative is that of a central difference, of lossy modes too."""
    model = of_a_laminate(model) if is_layered else model
    slopes_by_differences(model, somewhere(model.space, 2))


def slopes_by_differences(model: ForwardModel, x: FloatArray) -> ComplexArray:
    """Slopes at x of all that is uncertain, checked by central differences to 1e-4."""
    space, step = model.space, 1e-4
    found, size = jacobian(model.at(x)), np.abs(model.at(x).responses).max()
    for number in np.flatnonzero(space.uncertain):
        moved = step * np.eye(space.size)[number]
        slope = (model.at(x + moved).responses - model.at(x - moved).responses) / (2 * step)
        error = np.abs(found[..., number] - slope).max() / max(np.abs(slope).max(), 1e-6 * size)
        assert error < 1e-4, space.names[number]
    return found


def test_drive_lags_as_an_actuator_with_a_resonance(model: ForwardModel) -> None:
    """By hand: at its resonance of 500 Hz, with a damping ratio of 0.3, 1 / (2 i 0.3) times."""
    space, x = model.space, np.zeros(model.space.size)
    for name, value in (("inertia of drive SE", 4.0), ("drag of drive SE", 1.2)):
        x[space.index(name)] = value / space.std[space.index(name)]
    at_resonance = replace(model, frequencies=np.array([500.0]))
    lagging, rigid = (at_resonance.at(each).responses[0] for each in (x, np.zeros(space.size)))
    np.testing.assert_allclose(lagging[:, 1], rigid[:, 1] / 0.6j)
    np.testing.assert_allclose(lagging[:, [0, 2, 3]], rigid[:, [0, 2, 3]])


def test_mass_anywhere_changes_responses_as_derived(rig: Rig, model: ForwardModel) -> None:
    """The derivative by a mass at a point is the change that a small load there makes."""
    space = model.space
    x = np.zeros(space.size)
    point, mass = np.array([[0.21, 0.16]]), 1e-6
    finger = FingertipLoad(FINGER.x, FINGER.y, FINGER.fingertip)
    change = direct(rig, [finger, PointLoad(*point[0], mass=mass)]) - direct(rig, [finger])
    found = mass * by_mass_at(model.at(x), point)[..., 0]
    np.testing.assert_allclose(found, change, atol=2e-3 * np.abs(change).max())


def test_finger_of_known_parts_has_its_dynamic_stiffness(model: ForwardModel) -> None:
    """A finger with twice the pulp and half the phalanx loads the plate as such a fingertip."""
    x = np.zeros(model.space.size)
    x[model.space.groups["fingers"]] = np.log([1.0, 2.0, 0.5, 1.0]) / 0.5
    tip = FINGER.fingertip
    other = replace(
        tip,
        stiffness=2 * tip.stiffness,
        damping=2 * tip.damping,
        phalanx_mass=tip.phalanx_mass / 2,
    )
    same = replace(model, fingers=[replace(FINGER, fingertip=other)], last_places={})
    expected = same.at(np.zeros(model.space.size)).responses
    np.testing.assert_allclose(model.at(x).responses, expected, rtol=1e-10)


@pytest.mark.parametrize("name", ["paper_plate", "glass_panel", "weekend/rig"])
@pytest.mark.parametrize("of", ["fit", "sheets"])
def test_values_that_a_search_tries_are_those_of_a_rig(name: str, of: str) -> None:
    """Ten standard deviations off, within the space's bounds: no value that a file could not have.

    A loss factor beyond 1, or a coil whose current does not follow its back EMF, would be refused
    as if a person had given them.
    """
    rig = load_rig(example_rig_path().parent / f"{name}.yaml")
    rig = replace(rig, plate=replace(rig.plate, loss_factor=0.6))
    known = rig.uncertainty
    space = space_of(rig, ["P"], known, masses=1) if of == "fit" else space_by_sheets(rig, ["P"], 3)
    rng = np.random.default_rng(0)
    for size in (1, 10):
        for x in rng.normal(0, size, (50, space.size)).clip(space.lower, space.upper):
            found = rig_with(rig, Values(rig, space, x), known)
            assert 0 <= found.plate.loss_factor <= 1
            for era in found.eras:
                if isinstance(era, Exciter):
                    current = (era.force_factor / era.loop_resistance) ** 2 * era.inductance
                    assert current <= 0.1 * era.magnet_mass * (1 + 1e-9)


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


def board(keys: str = KEYS) -> Rig:
    """Acrylic with four exciters, of parts as they are sold."""
    return exciter_rig(keys, frequency="[40, 300]", more=PARTS)


def model_of(rig: Rig) -> ForwardModel:
    """The board with a sensor beside exciters, one that is moved, and one that is moved to one."""
    sensors = [Sensor("fixed", x=0.1, y=0.07), MOVED, Sensor("SW", "SW", mass=MASS)]
    names = [sensor.name for sensor in sensors]
    space = space_of(rig, names, rig.uncertainty, masses=1)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    return ForwardModel(rig, sensors, TONES, space, free)


@pytest.mark.parametrize("magnet", ["free", "held"])
def test_derivatives_are_slopes_of_the_responses(magnet: str) -> None:
    """By central differences, of suspension, magnet, coil, force factor and a foot, a sensor moved.

    A magnet that a frame holds has no weight that is felt.
    """
    keys = f"{KEYS}, magnet: {magnet}"
    model = model_of(exciter_rig(keys, frequency="[40, 300]", more=f"{PARTS}\n{FOAM}"))
    space = model.space
    x = 0.5 * np.random.default_rng(2).standard_normal(space.size)
    x[space.groups["masses"].start] = 1.0
    x = np.clip(x, space.lower + 0.1, space.upper - 0.1) * space.uncertain
    assert {"magnet mass SW", "force factor NE"} <= {*space.names}
    assert space.std[space.index("stiffness of foot foam")] == 0.3
    found = slopes_by_differences(model, x)
    magnets = found[..., space.groups["magnet_mass"]]
    assert magnets.any() == (magnet == "free")


def test_moved_sensor_weighs_on_the_plate_where_it_measures() -> None:
    """As a mass there in a solution of its own, 1.5 % of the response; elsewhere as without it."""
    rig = board()
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


def as_built(rig: Rig, seed: int) -> Rig:
    """A board of which parts differ as sold ones do, with another rigidity."""
    rng = np.random.default_rng(seed)

    def factor(deviation: float) -> float:
        return float(np.exp(deviation * rng.standard_normal()))

    eras = []
    for era in rig.eras:
        assert isinstance(era, Exciter)
        eras.append(
            replace(
                era,
                stiffness=factor(0.2) * era.stiffness,
                magnet_mass=factor(0.2) * era.magnet_mass,
                force_factor=factor(0.2) * era.force_factor,
                gains=((100.0, factor(0.2), float(np.radians(10) * rng.standard_normal())),),
            )
        )
    plate = replace(rig.plate.scaled(modulus=factor(0.05)), loss_factor=0.06)
    feet = [
        replace(each, stiffness=each.stiffness / (1 + 0.2 * each.is_foot)) for each in rig.masses
    ]
    return replace(rig, plate=plate, eras=tuple(eras), masses=tuple(feet))


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
    built = as_built(rig, 4)
    places = np.array([[0.06, 0.05], [0.17, 0.04], [0.26, 0.09], [0.05, 0.17], [0.15, 0.12]])
    places = np.vstack([places, [[0.24, 0.2]]])
    found = identify(rig, measured(built, np.linspace(42.0, 298.0, 13), places))
    assert found.is_explained
    again = rig_of(stated(found.rig))
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
