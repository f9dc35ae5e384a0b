"""A fingertip on the plate: a disc, sampled at fixed points."""

import numpy as np

from model.arrays import FloatArray
from model.finger.disc import FINE_POINTS, DiscRule
from model.structure.plate import Plate

# Contact of an adult's index finger pressed lightly is 10 to 15 mm across; the disc takes in the
# skin around it that the vibration reaches, and a little of where the touch sensor may be wrong.
FINGERTIP_RADIUS = 0.013


def _unit_disc() -> FloatArray:
    """Nineteen points: the centre, six at half the radius, twelve on the rim, (19, 2)."""
    rings = [(0.0, 1, 0.0), (0.5, 6, 0.0), (1.0, 12, np.pi / 12)]
    return np.concatenate(
        [
            radius * np.column_stack([np.cos(angles), np.sin(angles)])
            for radius, count, start in rings
            for angles in [start + 2 * np.pi * np.arange(count) / count]
        ]
    )


UNIT_DISC = _unit_disc()


def fingertip_points(x: float, y: float, plate: Plate) -> FloatArray:
    """Points [m] of the plate under a fingertip centred at x, y; those off the plate are excluded.

    (n, 2) with n up to 19; at a corner a quarter of the disc remains. The centre must be on it.
    """
    points = np.array([x, y]) + FINGERTIP_RADIUS * UNIT_DISC
    on_plate = (points >= 0).all(axis=1) & (points <= [plate.length, plate.width]).all(axis=1)
    return points[on_plate]


def fingertips_on(
    centres: FloatArray, plate: Plate, rule: DiscRule = FINE_POINTS
) -> tuple[FloatArray, FloatArray]:
    """Points [m] (k, p, 2) under fingertips centred at (k, 2) [m] on the plate, weights (k, p).

    The weighted sum over a fingertip's points is the mean over its disc, or over the part of it
    that is on the plate. All points are on the plate and under the fingertip.
    """
    low = -centres / FINGERTIP_RADIUS
    high = ([plate.length, plate.width] - centres) / FINGERTIP_RADIUS
    points, weights = rule.cut(low, high)
    return centres[:, None] + FINGERTIP_RADIUS * points, weights
