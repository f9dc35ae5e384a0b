"""A nine-node Reissner-Mindlin rectangle whose transverse shear strain is that of MITC9.

Bucalem and Bathe, Int. J. Num. Meth. Eng. 36 (1993) 3729-3754. The slope of a quadratic deflection
is linear along its own direction, a quadratic rotation is not, and a thin plate would lock where
they must be equal everywhere. So the strain is taken at two points along and three across.
"""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from numpy.polynomial.legendre import leggauss

from era_haptics.plugins.elements import Element, FloatArray, Plate, rigidities

SIDE = (-1.0, 0.0, 1.0)
Rule: TypeAlias = tuple[FloatArray, FloatArray]  # points and weights
TWO, THREE = leggauss(2), leggauss(3)


def along(s: float) -> tuple[FloatArray, FloatArray]:
    """The three Lagrange polynomials of a side at s, and their slopes."""
    value = np.array([s * (s - 1) / 2, 1 - s**2, s * (s + 1) / 2])
    return value, np.array([s - 0.5, -2 * s, s + 0.5])


def by_row(up: FloatArray, across: FloatArray) -> FloatArray:
    """Products at all nodes, row by row as they are numbered."""
    return (up[:, np.newaxis] * across).ravel()


def fields(
    xi: float, eta: float, dx: float, dy: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape functions of the nine nodes and their derivatives along x and y, (9,) each."""
    (x, slope_x), (y, slope_y) = along(xi), along(eta)
    return by_row(y, x), by_row(y, slope_x) * 2 / dx, by_row(slope_y, x) * 2 / dy


def points(
    across: Rule, up: Rule, dx: float, dy: float
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, float]]:
    """Every point of a Gauss rule, with its share of the area."""
    for xi, weight_x in zip(*across, strict=True):
        for eta, weight_y in zip(*up, strict=True):
            yield *fields(xi, eta, dx, dy), weight_x * weight_y * dx * dy / 4


def row(w: FloatArray, beta_x: FloatArray, beta_y: FloatArray) -> FloatArray:
    """A strain as a row over the 27 degrees of freedom: w, beta_x, beta_y of each node."""
    return np.stack([w, beta_x, beta_y], axis=1).ravel()


def stiffness(plate: Plate, dx: float, dy: float) -> FloatArray:
    """Stiffness of a dx by dy rectangle [m]."""
    bending, shear, _ = rigidities(plate)
    none = np.zeros(9)
    total = np.zeros((27, 27))
    for _, by_x, by_y, area in points(THREE, THREE, dx, dy):
        curvature = np.array([row(none, by_x, none), row(none, none, by_y), row(none, by_y, by_x)])
        total += area * curvature.T @ bending @ curvature
    for shape, by_x, _, area in points(TWO, THREE, dx, dy):
        strain = row(by_x, -shape, none)
        total += area * shear * np.outer(strain, strain)
    for shape, _, by_y, area in points(THREE, TWO, dx, dy):
        strain = row(by_y, none, -shape)
        total += area * shear * np.outer(strain, strain)
    return total


def mass(plate: Plate, dx: float, dy: float) -> FloatArray:
    """Consistent mass with rotary inertia."""
    _, _, inertia = rigidities(plate)
    total = np.zeros((27, 27))
    for shape, _, _, area in points(THREE, THREE, dx, dy):
        total += area * np.kron(np.outer(shape, shape), inertia)
    return total


MITC9 = Element("MITC9", SIDE, stiffness, mass)
