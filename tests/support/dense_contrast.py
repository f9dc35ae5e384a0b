"""Contrast of a layout by its definition, with dense systems of equations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.finger.fingertip import FIVE_POINTS, fingertips_on
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import attached_stiffness, drive_forces

GAINS = Uncertainty(0.05, 5.0, 0.0, 0.0, 1.0, 0.0)
"""Errors of the gains only, 5 % and 5 degrees."""


def dense_score(
    rig: Rig,
    places: FloatArray,
    sets: Sequence[FloatArray],
    frequencies: FloatArray,
) -> float:
    """Mean score [dB] by the definition: one dense system for each set, frequency and finger.

    With errors of the gains and of the thickness only, whose plates are solved anew, and one quiet
    finger; the best weights are an eigenvector. ERAs at places (n, 2) [m] are like the first.
    """
    plate, std = rig.plate, rig.uncertainty.thickness
    plates = [
        solve_free_plate(
            replace(plate, thickness=h * plate.thickness),
            rig.mesh,
            frequency_max=float(frequencies.max()),
        )
        for h in ((1, 1 + std, 1 - std) if std else (1,))
    ]
    eras = [replace(rig.eras[0], name=str(n), x=x, y=y) for n, (x, y) in enumerate(places)]
    omega = 2 * np.pi * frequencies
    z, force = attached_stiffness(eras, (), omega), drive_forces(eras, omega)
    assert rig.fingertip is not None
    tip = rig.fingertip.dynamic_stiffness(omega)
    sigma2, found = rig.uncertainty.gain_variance, []
    for contacts in sets:
        best = []
        tips, weights = fingertips_on(
            contacts, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        for row in range(len(frequencies)):
            attached = z[row], tip[row], force[row]
            target, quiet = (
                [
                    _field(free, places, finger, points, frequencies[row], attached)
                    for free in plates
                ]
                for finger, points in zip(contacts, tips, strict=True)
            )
            mean = weights[0] @ target[0]
            root = np.sqrt(weights[1])[:, None]
            changes = [root * (other - quiet[0]) for other in quiet[1:]]
            R = sum((0.5 * each.conj().T @ each for each in changes), 0)
            R = R + (root * quiet[0]).conj().T @ (root * quiet[0])
            R += sigma2 * np.diag((np.abs(root * quiet[0]) ** 2).sum(axis=0))
            # Largest |h w|² / w^H R w is the one eigenvalue of R^-1 h* h^T.
            values = np.linalg.eigvals(np.linalg.solve(R, np.outer(mean.conj(), mean)))
            best.append(10 * np.log10(np.abs(values).max()))
        found.append(max(best))
    return float(np.mean(found))


def _field(
    free: FreePlate,
    places: FloatArray,
    finger: FloatArray,
    points: FloatArray,
    frequency: float,
    attached: tuple[ComplexArray, complex, ComplexArray],
) -> ComplexArray:
    """Acceleration at points (p, 2) under a finger on the plate, of each ERA alone: (p, n).

    attached: dynamic stiffness of the ERAs (n,) and of the finger, force of the ERAs (n,).
    """
    z, tip, force = attached
    at = np.vstack([places, finger])
    between, to = free.receptances(at, points, np.array([frequency]))
    applied = np.vstack([np.diag(force), np.zeros(len(places))])
    forces = np.linalg.solve(np.eye(len(at)) + np.diag([*z, tip]) @ between[0], applied)
    return np.asarray(-((2 * np.pi * frequency) ** 2) * to[0].T @ forces)
