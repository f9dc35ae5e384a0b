"""Responses of a plate with other values, without solving it again."""

from dataclasses import replace

import numpy as np
import pytest

from model.calibration.fit import SensedPlate, sensed_plate
from model.rig.rig import Rig
from model.spectral.modes import SpectralMesh
from model.structure.attachments import PointLoad
from plates import make_paper_rig

FINGER = PointLoad(0.1, 0.08, stiffness=500.0, damping=2.0, mass=0.003)
PAPER = make_paper_rig(12, 9)
RIG = replace(
    PAPER,
    mesh=SpectralMesh(12, 9, PAPER.plate.length, PAPER.plate.width),
    masses=(FINGER,),
)
FREQUENCIES = np.arange(60.0, 321.0, 10.0)
POINTS = np.random.default_rng(0).uniform(0.01, 0.2, (30, 2))


@pytest.fixture(scope="module")
def solved() -> SensedPlate:
    """Solved as the rig has it."""
    return sensed_plate(RIG, POINTS, FREQUENCIES)


def _with(rig: Rig, *, modulus: float = 1.0, thickness: float = 1.0, loss: float = 1.0) -> Rig:
    """Rig with factors on values of its plate."""
    of = rig.plate
    material = replace(of.material, E=modulus * of.material.E)
    return replace(
        rig,
        plate=replace(
            of,
            material=material,
            thickness=thickness * of.thickness,
            loss_factor=loss * of.loss_factor,
        ),
    )


def _mounted(rig: Rig, *, stiffness: float, damping: float, mass: float) -> Rig:
    """Rig with factors on the values of its ERAs and fingers."""

    def factors(stiffness_of: float, damping_of: float) -> dict[str, float]:
        return {"stiffness": stiffness * stiffness_of, "damping": damping * damping_of}

    eras = tuple(
        replace(era, **factors(era.stiffness, era.damping), bolt_mass=mass * era.bolt_mass)
        for era in rig.eras
    )
    masses = tuple(
        replace(load, **factors(load.stiffness, load.damping), mass=mass * load.mass)
        for load in rig.masses
    )
    return replace(rig, eras=eras, masses=masses)


@pytest.mark.parametrize(
    ("other", "within"),
    [
        (_with(RIG, modulus=1.15, loss=3.0), 1e-4),
        (_mounted(RIG, stiffness=0.7, damping=2.0, mass=1.5), 1e-4),
        (_with(RIG, thickness=1.01), 1e-3),
        (_with(RIG, thickness=0.95), 5e-3),
    ],
    ids=["modulus and loss", "ERAs and finger", "1 % thicker", "5 % thinner"],
)
def test_responses_are_those_of_a_new_solve(solved, other, within):
    """Relative L2 over frequencies, ERAs and points; shear and rotary inertia limit thickness."""
    found = solved.of(other).responses()
    exact = sensed_plate(other, POINTS, FREQUENCIES).responses()
    assert np.linalg.norm(found - exact) / np.linalg.norm(exact) < within


@pytest.mark.parametrize("loss_factor", np.linspace(0.001, 0.05, 20).tolist())
def test_lower_bounds_are_no_loss_and_no_damping(solved, loss_factor):
    """A fit that ends at them has a rig: by rounding values would be just below zero."""
    eras = [
        replace(era, damping=1e3 * loss_factor * share)
        for era, share in zip(RIG.eras, (0.02, 0.03, 0.07, 0.11), strict=True)
    ]
    plate = replace(RIG.plate, loss_factor=loss_factor)
    other = solved.of(replace(RIG, plate=plate, eras=tuple(eras)))
    values = other.values(other.model.space.lower)
    is_factor = [row.is_factor for row in other.rows]
    np.testing.assert_allclose(values[np.logical_not(is_factor)], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        # ln 3 / ln 1.7, since 70 % is what sheets leave; -0.5 / 0.7; ln 1.2 / (0.1² + 0.02²)^½
        (RIG.uncertainty, (2.070, -0.714, 1.788)),
        # ln 3 / (ln² 3 + 0.2²)^½, -0.5 of that, ln 1.2 / (0.3² + 0.02²)^½
        (replace(RIG.uncertainty, damping=3.0, stiffness=0.3), (0.984, -0.448, 0.606)),
    ],
    ids=["as sheets leave", "as the rig states"],
)
def test_deviations_are_those_of_factors_where_losses_are_more(solved, stated, expected):
    """A damper three times as strong, one half as strong, and a spring 20 % stiffer."""
    plate = solved.of(replace(RIG, uncertainty=stated))
    z = np.zeros(plate.model.space.size)
    z[plate.model.space.groups["damping_added"]] = 2.0 / 0.7, -0.5 / 0.7, 0.0, 0.0
    stiffer = np.log(1.2) / max(stated.stiffness, 0.1)
    z[plate.model.space.groups["stiffness"]] = 0.0, 0.0, stiffer, 0.0
    by_name = dict(zip([row.name for row in plate.rows], plate.deviations(z), strict=True))
    first, second, third, _ = (era.name for era in RIG.eras)
    found = [by_name[f"{first} damping"], by_name[f"{second} damping"]]
    found.append(by_name[f"{third} stiffness"])
    np.testing.assert_allclose(found, expected, atol=1e-3)
