"""A fingertip on the plate: a disc, sampled at points with weights."""

import numpy as np

from model.arrays import FloatArray
from model.finger.disc import FINE_POINTS, DiscRule
from model.structure.plate import Plate

# A contact of 5 mm radius, the mean of index fingers on touch screens, and the 8 mm by which a
# finger may move before its pattern changes (docs/concepts/people.md).
FINGERTIP_RADIUS = 0.013


def fingertips_on(
    centres: FloatArray, *, length: float, width: float, rule: DiscRule = FINE_POINTS
) -> tuple[FloatArray, FloatArray]:
    """Points [m] (k, p, 2) under fingertips centred at (k, 2) [m] on a plate, weights (..., k, p).

    The weighted sum over a fingertip's points is the mean over its disc, or over the part of it
    that is on the plate. All points are on the plate and under the fingertip.
    """
    low = -centres / FINGERTIP_RADIUS
    high = ([length, width] - centres) / FINGERTIP_RADIUS
    points, weights = rule.cut(low, high)
    return centres[:, None] + FINGERTIP_RADIUS * points, weights


def fingertip_points(x: float, y: float, plate: Plate) -> FloatArray:
    """Points [m] (p, 2) under a fingertip centred at x, y [m] on the plate."""
    return np.asarray(_one(x, y, plate)[0][0])


def fingertip_weights(x: float, y: float, plate: Plate) -> FloatArray:
    """Weights (p,) of `fingertip_points` in the mean over the fingertip."""
    return np.asarray(_one(x, y, plate)[1][0])


def _one(x: float, y: float, plate: Plate) -> tuple[FloatArray, FloatArray]:
    return fingertips_on(np.array([[x, y]]), length=plate.length, width=plate.width)
