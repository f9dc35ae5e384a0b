"""Form errors of a plate: their derivatives, and intervals that hold the truth despite them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.calibration.hidden_plates import (
    FORM,
    SENSORS,
    draw_plate,
    field_deviations,
    fields_of,
    measure,
    true_values,
)
from model.arrays import FloatArray
from model.calibration.calibrate import calibrate
from model.calibration.fit import sensed_plate
from model.diagnosis.verdict import check_consistency
from model.identification.parameters import KINDS, MASS_CELLS, reduced_modes
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig
from model.spectral.modes import stretched
from model.structure.attachments import PointLoad

FREQUENCIES = np.arange(50.0, 491.0, 40.0)

CELL = 10

USUAL = {
    "place": 1.5e-3,
    "side": 0.5e-3,
    "poisson": 0.01,
    "sensor_place": 0.3e-3,
    "sensor_scale": 0.005,
    "mass": 0.01,
}
"""Form errors of a plate that was built with some care, as `FORM`."""


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate as its file has it."""
    return load_rig(example_rig_path())


def _longer(rig: Rig) -> Rig:
    """The rig with a plate 1 mm longer, all that is on it moved and grown in proportion.

    No response tells of a factor on all masses, springs and dampers.
    """
    share = 1 + 1e-3 / rig.plate.length
    plate = replace(rig.plate, length=share * rig.plate.length)
    eras = tuple(
        replace(
            era,
            x=share * era.x,
            stiffness=share * era.stiffness,
            damping=share * era.damping,
            bolt_mass=share * era.bolt_mass,
        )
        for era in rig.eras
    )
    masses = tuple(replace(one, x=share * one.x, mass=share * one.mass) for one in rig.masses)
    return replace(rig, plate=plate, mesh=stretched(rig.mesh, plate), eras=eras, masses=masses)


def _of_another_ratio(rig: Rig) -> Rig:
    """The rig with 0.02 more of Poisson's ratio."""
    material = replace(rig.plate.material, nu=rig.plate.material.nu + 0.02)
    return replace(rig, plate=replace(rig.plate, material=material))


def _heavier_in_one_cell(rig: Rig) -> Rig:
    """The rig with 0.5 % of its plate's mass taken from all of it, and put on a cell."""
    plate = rig.plate
    material = replace(plate.material, rho=0.995 * plate.material.rho)
    x, y = MASS_CELLS.centres(plate)[CELL]
    load = PointLoad(float(x), float(y), mass=0.005 * plate.mass)
    return replace(rig, plate=replace(plate, material=material), masses=(*rig.masses, load))


def _moved(rig: Rig) -> Rig:
    """The rig with its first ERA half a millimetre inwards along both sides."""
    first = replace(rig.eras[0], x=rig.eras[0].x + 5e-4, y=rig.eras[0].y + 5e-4)
    return replace(rig, eras=(first, *rig.eras[1:]))


@pytest.mark.parametrize(
    ("kind", "values", "other"),
    [
        ("side", [1e-3, 0.0], _longer),
        ("poisson", [0.02], _of_another_ratio),
        ("foreign_mass", 0.005 * np.eye(48)[CELL], _heavier_in_one_cell),
        ("place", [5e-4, 5e-4, *[0.0] * 6], _moved),
        ("sensor_place", np.tile([5e-4, -5e-4], 12), lambda rig: rig),
    ],
    ids=["longer", "another ratio", "heavier in one cell", "ERA moved", "sensors moved"],
)
def test_form_errors_are_those_of_a_plate_solved_anew(
    rig: Rig, kind: str, values: list[float] | FloatArray, other: Callable[[Rig], Rig]
) -> None:
    """They move the responses as on a plate that is built so, to a fifth of what that changes.

    ERAs move by slopes alone here, and a mass couples modes up to twice the highest frequency.
    Without form errors responses in coordinates of the reduced plate are those of the free plate's
    modes, also with a mass on it and where modes deviate from their theory.
    """
    points = SENSORS * [rig.plate.length, rig.plate.width]
    rig = replace(rig, masses=(PointLoad(0.1, 0.05, mass=0.004),))
    plate = replace(rig.plate, loss_exponent=0.3, mode_deviations=((0.02, 0.3), (-0.01, 0.0)))
    rig = replace(rig, plate=plate)
    sensed = sensed_plate(rig, points, FREQUENCIES, has_form=True)
    nominal = sensed_plate(rig, points, FREQUENCIES).responses()
    np.testing.assert_allclose(sensed.responses(), nominal, atol=2e-5 * np.abs(nominal).max())

    space, z = sensed.model.space, np.zeros(sensed.model.space.size)
    z[space.groups[kind]] = values / space.std[space.groups[kind]]
    found = np.swapaxes(sensed.model.at(z).responses, 1, 2)
    built = other(rig)
    points = points * [built.plate.length / plate.length, 1]
    if kind == "sensor_place":
        points += np.array([5e-4, -5e-4])
    change = sensed_plate(built, points, FREQUENCIES).responses() - nominal
    np.testing.assert_allclose(found - nominal, change, atol=0.2 * np.abs(change).max())


def test_stiffening_does_not_depend_on_rounding(rig: Rig) -> None:
    """Moduli that differ in the eleventh digit give derivatives by the sides that agree to 1e-4.

    Relative to the modes' own stiffness, as couplings are that move a mode's frequency.
    """

    def couplings(share: float) -> FloatArray:
        material = replace(rig.plate.material, E=rig.plate.material.E * (1 + share))
        other = replace(rig, plate=replace(rig.plate, material=material))
        modes = reduced_modes(other, solve_free_plate(other.plate, other.mesh))
        size = np.sqrt(modes.eigenvalues + 4e4)  # of a rigid body on springs of some 30 Hz
        return np.abs(modes.stiffening) / np.outer(size, size)

    exact = couplings(0.0)
    for share in (1e-11, 2e-11, 3e-11):
        np.testing.assert_allclose(couplings(share), exact, atol=1e-4)


def test_a_fit_allows_for_what_plates_are_drawn_with() -> None:
    """The mass of one place is that of all cells together, in the root mean square."""
    allowed = {kind: KINDS[kind].std for kind in FORM if kind != "mass"}
    allowed["mass"] = KINDS["foreign_mass"].std * MASS_CELLS.cell_count**0.5
    assert allowed == pytest.approx(FORM)


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
    So do three in four of the gains and phases of what ERAs do to the plate within the interval of
    90 % by the uncertainty of the new rig, which says within a factor of two how far its fields are
    off besides. No sensor within its tolerance counts as one of a wrong scale. The benchmark has
    more plates.
    """
    deviations, fields = [], []
    for seed in range(plates):
        hidden = draw_plate(rig, USUAL, seed=seed, frequencies=FREQUENCIES)
        responses = measure(hidden, rig, seed=seed, frequencies=FREQUENCIES, count=sensors)
        found = calibrate(rig, responses, check_consistency(rig, responses))
        assert found.outlier_count == 0
        assert found.scales == ()
        fields.append(field_deviations(found.rig, fields_of(hidden)))
        for one, true in zip(found.parameters, true_values(hidden.rig), strict=True):
            if one.standard_error is not None:
                deviations.append(abs(one.value - true) / one.standard_error)
    assert len(deviations) > 12 * plates
    assert np.mean(np.array(deviations) < 2) > share
    assert max(deviations) < 4
    gains, phases, besides = np.stack(fields, axis=1)
    assert np.mean(np.array([gains, phases]) < 1.645) > 0.75
    assert 0.5 < np.sqrt(np.mean(besides**2)) < 2
