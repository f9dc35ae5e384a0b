"""Responses of the identified plate and their derivatives, against the plate solved anew."""

from dataclasses import replace

import numpy as np
import pytest

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import by_mass_at, jacobian
from model.identification.forward import ForwardModel, RestingFinger, Sensor
from model.identification.parameters import (
    FINGER_PARTS,
    Space,
    Values,
    inwards,
    rig_with,
    space_by_sheets,
    space_of,
)
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig, mesh_of
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh
from model.structure.attachments import Fingertip, FingertipLoad, PointLoad, Support
from model.structure.exciter import Exciter
from model.structure.plate import Bond, Laminate, LaminateLayer, Material, equivalent_plate

FREQUENCIES = np.array([60.0, 140.0, 222.0, 350.0, 480.0])
PAD = Sensor("pad", x=0.1, y=0.07)
FINGER = RestingFinger(0.2, 0.05, Fingertip())


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate."""
    return load_rig(example_rig_path())


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
            rig.eras, values.stiffness, values.damping, values.bolt_mass, values.places, strict=True
        )
    )
    material = replace(rig.plate.material, E=values.modulus * rig.plate.material.E)
    plate = replace(
        rig.plate,
        material=material,
        loss_factor=values.loss_factor,
        loss_exponent=values.loss_exponent,
    )
    ((mass, at_x, at_y),) = values.masses
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
    x, step = somewhere(model.space, 2), 1e-4
    found = jacobian(model.at(x))
    for number in np.flatnonzero(model.space.uncertain):
        sides = []
        for sign in (1, -1):
            moved = x.copy()
            moved[number] += sign * step
            sides.append(model.at(moved).responses)
        slope = (sides[0] - sides[1]) / (2 * step)
        error = np.abs(found[..., number] - slope).max() / np.abs(slope).max()
        assert error < 1e-4, model.space.names[number]


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
            found = rig_with(rig, Values.of(rig, space, x), known)
            assert 0 <= found.plate.loss_factor <= 1
            for era in found.eras:
                if isinstance(era, Exciter):
                    current = (era.force_factor / era.loop_resistance) ** 2 * era.inductance
                    assert current <= 0.1 * era.magnet_mass * (1 + 1e-9)
