"""Exact Jacobians of searches, against extrapolated differences of their residuals.

Responses of a plate with other values, without solving it again.

Form errors of a plate: their derivatives, and intervals that hold the truth despite them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import optimize

from benchmarks.calibration.hidden_plates import (
    FORM,
    SENSORS,
    draw_plate,
    field_deviations,
    fields_of,
    measure,
    true_values,
)
from model.arrays import ComplexArray, FloatArray
from model.estimate import plate_match
from model.estimate.calibrate import calibrate
from model.estimate.fit import SensedPlate, fit, sensed_plate
from model.estimate.forward import MASS_CELLS
from model.estimate.measurement import Measurement, sensors_at
from model.estimate.space import KINDS
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduced_modes
from model.rig.rig import Rig
from model.spectral.modes import SpectralMesh, stretched
from model.structure.attachments import PointLoad, footprints_of
from plates import extrapolated_slopes, make_paper_rig

RIG = make_paper_rig(12, 9)
POINTS = np.random.default_rng(0).uniform(0.02, 0.2, (5, 2))
NAMES = tuple(f"P{number}" for number in range(len(POINTS)))
FREQUENCIES = np.array([70.0, 130.0, 260.0, 410.0])


def measured(rig: Rig) -> ComplexArray:
    """Responses (f, e, s) of the rig with other gains, noise, and one value left out."""
    rng = np.random.default_rng(3)
    values = sensed_plate(rig, sensors_at(POINTS), FREQUENCIES).responses().swapaxes(1, 2)
    values = values * rng.uniform(0.8, 1.2, (*values.shape[:2], 1))
    values = values * (1 + 0.1 * rng.standard_normal(values.shape))
    values[1, 2, 3] = np.nan
    return np.asarray(values)


def fit_a_rig() -> None:
    """Search with gains free, and with a prior that holds the mean of all scales."""
    plate = sensed_plate(RIG, sensors_at(POINTS), FREQUENCIES, has_form=True)
    values = measured(RIG).swapaxes(1, 2)
    measurement = Measurement(sensors_at(POINTS, NAMES), FREQUENCIES, values)
    space, count = plate.model.space, len(POINTS)
    covariance, own = np.eye(space.size), np.arange(space.size)[space.groups["sensor_scale"]]
    covariance[np.ix_(own, own)] += 1e2 * (np.eye(count) - 1 / count)
    fit(
        plate.model,
        replace(measurement, gain_std=np.inf),
        searched=space.uncertain & ~space.of("gain"),
        prior=(np.zeros(space.size), covariance),
    )


def match_a_plate() -> None:
    """Search for a plate with one channel that was not driven."""
    values = measured(replace(RIG, plate=RIG.plate.scaled(modulus=1.1)))
    values[:, 1] = np.nan
    plate = sensed_plate(RIG, sensors_at(POINTS), FREQUENCIES)
    plate_match.match_plate(plate, values.swapaxes(1, 2), drives=[0, 2, 1, 3])


@pytest.mark.parametrize(
    "searched",
    [fit_a_rig, match_a_plate],
    ids=["rig and all scales", "plate"],
)
def test_jacobians_of_searches_are_exact(
    searched: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By every argument at the first start of each size, to 1e-6 of the column's largest."""
    solver: Callable[..., Any] = vars(optimize)["least_squares"]
    checked: set[int] = set()

    def checking(
        residuals: Callable[[FloatArray], FloatArray],
        start: FloatArray,
        jacobian: Callable[[FloatArray], FloatArray],
        **options: Any,
    ) -> Any:
        if len(start) not in checked:
            at = start + 0.05
            exact = extrapolated_slopes(residuals, at, step=1e-3)
            size = np.abs(exact).max(axis=1, keepdims=True)
            np.testing.assert_allclose(jacobian(at).T / size, exact / size, atol=1e-6)
            checked.add(len(start))
        return solver(residuals, start, jacobian, **options)

    monkeypatch.setattr(optimize, "least_squares", checking)
    searched()
    assert checked


FINGER = PointLoad(0.1, 0.08, stiffness=500.0, damping=2.0, mass=0.003)
PAPER = make_paper_rig(12, 9)
SENSED_PLATE_RIG = replace(
    PAPER,
    mesh=SpectralMesh(12, 9, PAPER.plate.length, PAPER.plate.width),
    masses=(FINGER,),
)
SENSED_PLATE_FREQUENCIES = np.arange(60.0, 321.0, 10.0)
SENSED_PLATE_POINTS = np.random.default_rng(0).uniform(0.01, 0.2, (30, 2))


@pytest.fixture(scope="module")
def solved() -> SensedPlate:
    """Solved as the rig has it."""
    return sensed_plate(SENSED_PLATE_RIG, sensors_at(SENSED_PLATE_POINTS), SENSED_PLATE_FREQUENCIES)


@pytest.mark.parametrize(("factor", "within"), [(1.01, 1e-3), (0.95, 5e-3)])
def test_responses_are_those_of_a_new_solve(
    solved: SensedPlate, factor: float, within: float
) -> None:
    """Of another thickness, relative L2; shear and rotary inertia limit it."""
    of = SENSED_PLATE_RIG.plate
    other = replace(SENSED_PLATE_RIG, plate=replace(of, thickness=factor * of.thickness))
    found = solved.of(other).responses()
    exact = sensed_plate(other, solved.model.sensors, SENSED_PLATE_FREQUENCIES).responses()
    assert np.linalg.norm(found - exact) / np.linalg.norm(exact) < within


@pytest.mark.parametrize("loss_factor", np.linspace(0.001, 0.05, 20).tolist())
def test_lower_bounds_are_no_loss_and_no_damping(solved, loss_factor):
    """A fit that ends at them has a rig: by rounding values would be just below zero."""
    eras = [
        replace(era, damping=1e3 * loss_factor * share)
        for era, share in zip(SENSED_PLATE_RIG.eras, (0.02, 0.03, 0.07, 0.11), strict=True)
    ]
    plate = replace(SENSED_PLATE_RIG.plate, loss_factor=loss_factor)
    other = solved.of(replace(SENSED_PLATE_RIG, plate=plate, eras=tuple(eras)))
    values = other.values(other.model.space.lower)
    is_factor = [row.is_factor for row in other.rows]
    np.testing.assert_allclose(values[np.logical_not(is_factor)], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        # ln 3 / ln 1.7, since 70 % is what sheets leave; -0.5 / 0.7; ln 1.2 / (0.1² + 0.02²)^½
        (SENSED_PLATE_RIG.uncertainty, (2.070, -0.714, 1.788)),
        # ln 3 / (ln² 3 + 0.2²)^½, -0.5 of that, ln 1.2 / (0.3² + 0.02²)^½
        (replace(SENSED_PLATE_RIG.uncertainty, damping=3.0, stiffness=0.3), (0.984, -0.448, 0.606)),
    ],
    ids=["as sheets leave", "as the rig states"],
)
def test_deviations_are_those_of_factors_where_losses_are_more(solved, stated, expected):
    """A damper three times as strong, one half as strong, and a spring 20 % stiffer."""
    plate = solved.of(replace(SENSED_PLATE_RIG, uncertainty=stated))
    z = np.zeros(plate.model.space.size)
    z[plate.model.space.groups["damping_added"]] = 2.0 / 0.7, -0.5 / 0.7, 0.0, 0.0
    stiffer = np.log(1.2) / max(stated.stiffness, 0.1)
    z[plate.model.space.groups["stiffness"]] = 0.0, 0.0, stiffer, 0.0
    by_name = dict(zip([row.name for row in plate.rows], plate.deviations(z), strict=True))
    first, second, third, _ = (era.name for era in SENSED_PLATE_RIG.eras)
    found = [by_name[f"{first} damping"], by_name[f"{second} damping"]]
    found.append(by_name[f"{third} stiffness"])
    np.testing.assert_allclose(found, expected, atol=1e-3)


FORM_ERRORS_FREQUENCIES = np.arange(50.0, 491.0, 40.0)

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
    sensed = sensed_plate(rig, sensors_at(points), FORM_ERRORS_FREQUENCIES, has_form=True)
    nominal = sensed_plate(rig, sensors_at(points), FORM_ERRORS_FREQUENCIES).responses()
    np.testing.assert_allclose(sensed.responses(), nominal, atol=2e-5 * np.abs(nominal).max())

    space, z = sensed.model.space, np.zeros(sensed.model.space.size)
    z[space.groups[kind]] = values / space.std[space.groups[kind]]
    found = sensed.responses(z)
    built = other(rig)
    points = points * [built.plate.length / plate.length, 1]
    if kind == "sensor_place":
        points += np.array([5e-4, -5e-4])
    change = sensed_plate(built, sensors_at(points), FORM_ERRORS_FREQUENCIES).responses() - nominal
    np.testing.assert_allclose(found - nominal, change, atol=0.2 * np.abs(change).max())


def test_stiffening_does_not_depend_on_rounding(rig: Rig) -> None:
    """Moduli that differ in the eleventh digit give derivatives by the sides that agree to 1e-4.

    Relative to the modes' own stiffness, as couplings are that move a mode's frequency.
    """

    cells = MASS_CELLS.centres(rig.plate)

    def couplings(share: float) -> FloatArray:
        material = replace(rig.plate.material, E=rig.plate.material.E * (1 + share))
        other = replace(rig, plate=replace(rig.plate, material=material))
        free = solve_free_plate(other.plate, other.mesh)
        modes = reduced_modes(free, footprints_of(rig.eras, rig.masses), cells)
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
        hidden = draw_plate(rig, USUAL, seed=seed, frequencies=FORM_ERRORS_FREQUENCIES)
        responses = measure(
            hidden, rig, seed=seed, frequencies=FORM_ERRORS_FREQUENCIES, count=sensors
        )
        found = calibrate(rig, responses)
        assert found.outlier_count == 0
        assert found.scales == {}
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
