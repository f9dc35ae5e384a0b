"""Fingertips on the plate in time, against SciPy's matrix exponential."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from model.arrays import FloatArray
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import FingertipLoad, footprints_of
from model.transients.base_motion import Term
from resting_fingers import FINGERTIP, resting
from sim.plant.plant import Plant

PLACES = ((0.11, 0.07), (0.3048, 0.1))
POINTS = np.array([*PLACES, (0.03, 0.2)])
FREQUENCY, STROKE, RATE = 137.0, 1e-4, 10_000.0


@pytest.fixture(scope="module")
def lossless(coarse_rig: Rig) -> Rig:
    """The paper's plate, damped by its ERAs alone."""
    return replace(coarse_rig, plate=replace(coarse_rig.plate, loss_factor=0.0))


@pytest.fixture(scope="module")
def reduced(lossless: Rig) -> ReducedPlate:
    """With the static vectors of the fingers' places, so that both solutions have the same ones."""
    attached = np.vstack([footprints_of(lossless.eras), [(*place, 0.0) for place in PLACES]])
    return reduce_plate(lossless.plate, lossless.mesh, attached)


def by_hand(
    rig: Rig, reduced: ReducedPlate, fingers: Mapping[str, FingertipLoad], duration: float
) -> FloatArray:
    """Accelerations (n, p) at POINTS from rest by the matrix exponential, one ERA driven by a sine.

    Every force is written out: bones are masses of their own, held by joints and pushed by pulps;
    the sine is two further states.
    """
    r, n = len(reduced.omega), len(fingers)
    M, C, K = np.eye(r + n), np.zeros((r + n, r + n)), np.zeros((r + n, r + n))
    K[:r, :r] = np.diag(reduced.omega**2)
    for era in rig.eras:
        phi = reduced.at(np.array([[era.x, era.y]]))[0]
        K[:r, :r] += era.stiffness * np.outer(phi, phi)
        C[:r, :r] += era.damping * np.outer(phi, phi)
    for bone, each in enumerate(fingers.values(), start=r):
        tip, phi = each.fingertip, reduced.at(np.array([[each.x, each.y]]))[0]
        M[:r, :r] += tip.contact_mass * np.outer(phi, phi)
        M[bone, bone] = tip.phalanx_mass
        for matrix, pulp, joint in (
            (K, tip.stiffness, tip.joint_stiffness),
            (C, tip.damping, tip.joint_damping),
        ):
            matrix[:r, :r] += pulp * np.outer(phi, phi)
            matrix[:r, bone] -= pulp * phi
            matrix[bone, :r] -= pulp * phi
            matrix[bone, bone] += pulp + joint
    w, size = 2 * np.pi * FREQUENCY, r + n
    era = rig.eras[0]
    phi = np.pad(reduced.at(np.array([[era.x, era.y]]))[0], (0, n))
    A = np.zeros((2 * size + 2, 2 * size + 2))
    A[:size, size : 2 * size] = np.eye(size)
    A[size : 2 * size, :size] = -linalg.solve(M, K)
    A[size : 2 * size, size : 2 * size] = -linalg.solve(M, C)
    A[size : 2 * size, -2] = linalg.solve(M, era.stiffness * phi)
    A[size : 2 * size, -1] = linalg.solve(M, era.damping * phi)
    A[-2, -1], A[-1, -2] = 1.0, -(w**2)
    state = np.zeros(2 * size + 2)
    state[-1] = w * STROKE  # y = stroke sin(w t)
    step, samples = linalg.expm(A / RATE), []
    for _ in range(round(duration * RATE)):
        state = step @ state
        samples.append((A @ state)[size : size + r])
    return np.asarray(np.array(samples) @ reduced.at(POINTS).T)


@pytest.mark.parametrize("phalanx_mass", [0.005, 0.1])
def test_plant_under_fingertips_agrees_with_a_matrix_exponential(
    lossless: Rig, reduced: ReducedPlate, phalanx_mass: float
) -> None:
    """From rest on, two fingers of unlike tips: 1e-8 of the largest acceleration, always."""
    tip = replace(FINGERTIP, phalanx_mass=phalanx_mass)
    fingers = resting(PLACES[0], fingertip=tip) | {"b": FingertipLoad(*PLACES[1], FINGERTIP)}
    plant = Plant(reduced, lossless.eras)
    plant.set_contacts(fingers)
    plant.set_input(0, [Term(0.0, np.inf, 2 * np.pi * FREQUENCY, STROKE)])
    _, found = plant.advance(0.1, sample_rate=RATE, shapes=plant.reduced.at(POINTS))
    expected = by_hand(lossless, reduced, fingers, 0.1)
    # A jump of the base's velocity at time 0 passes an impulse through the damper; not modelled.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
