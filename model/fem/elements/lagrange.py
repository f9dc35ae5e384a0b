"""Q3 to Q5: Reissner-Mindlin rectangles of high order on Gauss-Lobatto nodes, fully integrated.

From the third order on thin plates do not lock and no shear strain needs to be assumed. Every
integral over the rectangle is the product of an integral along x and one along y. Narrow elements
at a free edge also resolve the boundary layer, as wide as the plate is thick, that limits elements
of low order to linear convergence
(Babuška and Li, Comput. Methods Appl. Mech. Engrg. 100 (1992) 249-273; Häggblad and Bathe, Int. J.
Num. Meth. Eng. 30 (1990) 981-1011).
"""

from functools import partial

import numpy as np
from numpy.polynomial import legendre

from model.arrays import FloatArray
from model.fem.elements.element import Element, rigidities
from model.structure.plate import Plate


def _gauss_lobatto(order: int) -> tuple[float, ...]:
    """The order + 1 nodes: the ends and the extrema of the Legendre polynomial."""
    inner = legendre.Legendre.basis(order).deriv().roots().real
    return (-1.0, *sorted(inner.tolist()), 1.0)


def _side_integrals(side: tuple[float, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Integrals over -1..1 of N_i N_j, N_i' N_j and N_i' N_j', exact, (n, n) each."""
    points, weights = legendre.leggauss(len(side))
    coefficients = np.linalg.inv(np.vander(side, increasing=True))
    powers = np.arange(len(side))
    shape = points[:, None] ** powers @ coefficients
    slope = powers * points[:, None] ** np.maximum(powers - 1, 0) @ coefficients
    weighted = (slope.T * weights) @ slope
    return (shape.T * weights) @ shape, (slope.T * weights) @ shape, weighted


def _stiffness(side: tuple[float, ...], plate: Plate, dx: float, dy: float) -> FloatArray:
    """Element stiffness of a dx by dy rectangle [m] (paper Eq. 17)."""
    (bend, coupled, twist), shear = _bending_terms(plate)
    value, slope_value, slope = _side_integrals(side)
    n = len(side) ** 2
    total = np.zeros((n, 3, n, 3))

    # kron(A, B)_ij: integral of A along y times integral of B along x, over the element's nodes.
    area = np.kron(value, value) * dx * dy / 4
    along_x = np.kron(value, slope) * dy / dx
    along_y = np.kron(slope, value) * dx / dy
    total[:, 0, :, 0] = shear * (along_x + along_y)
    total[:, 0, :, 1] = -shear * np.kron(value, slope_value) * dy / 2
    total[:, 0, :, 2] = -shear * np.kron(slope_value, value) * dx / 2
    total[:, 1, :, 1] = shear * area + bend * along_x + twist * along_y
    total[:, 2, :, 2] = shear * area + bend * along_y + twist * along_x
    total[:, 1, :, 2] = coupled * np.kron(slope_value.T, slope_value)
    total[:, 1, :, 2] += twist * np.kron(slope_value, slope_value.T)
    for row, column in ((0, 1), (0, 2), (1, 2)):
        total[:, column, :, row] = total[:, row, :, column].T
    return total.reshape(3 * n, 3 * n)


def _bending_terms(plate: Plate) -> tuple[tuple[float, float, float], float]:
    """D, nu D and (1 - nu) D / 2 [N m], and the shear rigidity [N/m]."""
    bending, shear, _ = rigidities(plate)
    return (bending[0, 0], bending[0, 1], bending[2, 2]), shear


def _mass(side: tuple[float, ...], plate: Plate, dx: float, dy: float) -> FloatArray:
    """Consistent element mass with rotary inertia (paper Eq. 19)."""
    value, _, _ = _side_integrals(side)
    return np.asarray(np.kron(np.kron(value, value) * dx * dy / 4, rigidities(plate)[2]))


def _lagrange(order: int) -> Element:
    side = _gauss_lobatto(order)
    return Element(f"Q{order}", side, partial(_stiffness, side), partial(_mass, side))


Q3, Q4, Q5 = (_lagrange(order) for order in (3, 4, 5))
