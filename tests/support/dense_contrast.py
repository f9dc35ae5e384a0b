"""Contrast of a layout by its definition, with dense systems of equations."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.finger.disc import FIVE_POINTS
from model.finger.fingertip import fingertips_on
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.dynamic_stiffness import attached_stiffness, drive_forces

GAINS = Uncertainty(0.05, 5.0, 0.0, 0.0, 1.0, 0.0)
"""Errors of the gains only, 5 % and 5 degrees."""


def dense_score(
    rig: Rig,
    places: FloatArray,
    sets: Sequence[FloatArray],
    frequencies: FloatArray,
    *,
    damping: float = 1.0,
) -> float:
    """Mean score [dB] by the definition: one dense system for each set, frequency and finger.

    With errors of the gains only and one quiet finger; the best weights are an eigenvector.
    damping: factor on that of the ERAs, which are like the rig's first, at places (n, 2) [m].
    """
    plate = rig.plate
    free = solve_free_plate(plate, rig.mesh, frequency_max=float(frequencies.max()))
    like = replace(rig.eras[0], damping=damping * rig.eras[0].damping)
    eras = [replace(like, name=str(n), x=x, y=y) for n, (x, y) in enumerate(places)]
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
            fields = []
            for finger, points in zip(contacts, tips, strict=True):
                at = np.vstack([places, finger])
                between, to = free.receptances(at, points, frequencies[row : row + 1])
                stiffness = np.diag([*z[row], tip[row]])
                applied = np.vstack([np.diag(force[row]), np.zeros(len(places))])
                forces = np.linalg.solve(np.eye(len(at)) + stiffness @ between[0], applied)
                fields.append(-(omega[row] ** 2) * to[0].T @ forces)
            target = weights[0] @ fields[0]
            quiet = np.sqrt(weights[1])[:, None] * fields[1]
            R = quiet.conj().T @ quiet
            R += sigma2 * np.diag((np.abs(quiet) ** 2).sum(axis=0))
            # Largest |h w|² / w^H R w is the one eigenvalue of R^-1 h* h^T.
            values = np.linalg.eigvals(np.linalg.solve(R, np.outer(target.conj(), target)))
            best.append(10 * np.log10(np.abs(values).max()))
        found.append(max(best))
    return float(np.mean(found))
