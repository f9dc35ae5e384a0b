"""A fingertip on the plate: a disc, sampled at points with weights.

The points and weights are a cubature over a disc, for the mean of a field: rings about the centre,
along the radius Gauss-Lobatto points of the radius squared, so that the outermost ring is the rim
and the largest value over the points is close to that over the disc; evenly spaced around (product
rules: Stroud, Approximate Calculation of Multiple Integrals, 1971, section 2.6). Where an edge of
the plate cuts the disc, the mean is that over what remains of it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.structure.plate import Plate

GAUSS_LEGENDRE = np.column_stack(np.polynomial.legendre.leggauss(8))
"""Points and weights (8, 2) over -1..1."""


@dataclass(frozen=True, eq=False)
class DiscRule:
    """Points (p, 2) of the unit disc with weights (..., p), which sum to 1 over the points.

    Exact for the mean over the disc of polynomials up to a degree.
    """

    points: FloatArray
    weights: FloatArray

    def cut(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (k, p, 2) and weights (..., k, p) for the disc's parts in rectangles.

        low, high (k, 2): the rectangles' corners, in radii from the disc's centre, which they
        contain. Points outside move to the nearest place inside and weigh nothing; the weights of
        the others make the mean of linear functions exact.
        """
        weights = self.weights[..., None, :].repeat(len(low), axis=-2)
        if low.max() <= -1 and high.min() >= 1:
            return self.points[None].repeat(len(low), axis=0), weights
        inside = np.minimum(np.maximum(self.points, low[:, None]), high[:, None])
        is_kept = (inside == self.points).all(axis=2)
        is_cut = ~is_kept.all(axis=1)
        if is_cut.any():
            weights[..., is_cut, :] = self._refit(is_kept[is_cut], low[is_cut], high[is_cut])
        return inside, weights

    def _refit(self, is_kept: NDArray[np.bool_], low: FloatArray, high: FloatArray) -> FloatArray:
        """Weights (..., k, p): those kept, times the linear function that makes linear means exact.

        The few that would become negative are zero; the mean is exact but for that.
        """
        weights = self.weights[..., None, :] * is_kept
        weights /= weights.sum(axis=-1, keepdims=True)
        linear = np.column_stack([np.ones(len(self.points)), self.points])
        gram = (weights[..., None, :] * linear.T) @ linear
        means = np.concatenate([np.ones((len(low), 1)), _centroids(low, high)], axis=1)
        # Definite also where the points kept lie on a line, in parts narrower than a fingertip.
        tilt = np.linalg.solve(gram + 1e-9 * np.eye(3), means[:, :, None])[..., 0]
        fitted = np.maximum(weights * (tilt @ linear.T), 0)
        return np.asarray(fitted / fitted.sum(axis=-1, keepdims=True))


def _rings(*rings: tuple[float, int, float]) -> DiscRule:
    """A rule of rings: radius, number of points, and weight of all of them together."""
    points, weights = [], []
    for radius, count, weight in rings:
        angles = 2 * np.pi * np.arange(count) / count
        points.append(radius * np.column_stack([np.cos(angles), np.sin(angles)]))
        weights.append(np.full(count, weight / count))
    # Rounded, for points that shall lie on the axes.
    return DiscRule(np.concatenate(points).round(15), np.concatenate(weights))


FIVE_POINTS = _rings((0.0, 1, 1 / 2), (1.0, 4, 1 / 2))
"""The centre and four points of the rim, exact to degree 3: for searches."""

FINE_POINTS = _rings((0.0, 1, 1 / 6), (np.sqrt(0.5), 8, 4 / 6), (1.0, 12, 1 / 6))
"""Twenty-one points, twelve of them on the rim, exact to degree 7: for figures."""

FIVE_AND_FINE = DiscRule(
    np.concatenate([FIVE_POINTS.points, FINE_POINTS.points]),
    np.stack([np.pad(FIVE_POINTS.weights, (0, 21)), np.pad(FINE_POINTS.weights, (5, 0))]),
)
"""Both, the five points first: weights (2, 26) for the mean by either."""


def _centroids(low: FloatArray, high: FloatArray) -> FloatArray:
    """Centroids (k, 2) of the unit disc's parts in rectangles that hold its centre.

    Integrals over y are exact; over x by Gauss-Legendre points of the angle asin(x), piecewise
    between the corners where rim and rectangle meet.
    """
    low, high = np.maximum(low, -1), np.minimum(high, 1)
    first, last = np.arcsin(low[:, 0]), np.arcsin(high[:, 0])
    corners = np.arccos(np.abs(np.column_stack([low[:, 1], high[:, 1]])))
    ends = np.column_stack([first, -corners, corners, last])
    ends = np.sort(np.minimum(np.maximum(ends, first[:, None]), last[:, None]), axis=1)
    half = np.diff(ends, axis=1)[..., None] / 2
    angles = (ends[:, :-1, None] + half + half * GAUSS_LEGENDRE[:, 0]).reshape(len(low), -1)
    x, rim = np.sin(angles), np.cos(angles)
    widths = (half * GAUSS_LEGENDRE[:, 1]).reshape(len(low), -1) * rim
    bottom, top = np.maximum(-rim, low[:, 1:]), np.minimum(rim, high[:, 1:])
    area = (widths * (top - bottom)).sum(axis=1)
    along_x = (widths * x * (top - bottom)).sum(axis=1)
    along_y = (widths * (top**2 - bottom**2) / 2).sum(axis=1)
    return np.asarray(np.column_stack([along_x, along_y]) / area[:, None])


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
