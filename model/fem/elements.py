"""Reissner-Mindlin rectangles: MITC4, the paper's element, and Q3 to Q5 of high order.

Every integral over a rectangle is the product of an integral along x and one along y. From the
third order on, on Gauss-Lobatto nodes, thin plates do not lock. The four-node element would: its
shear strain along x is assumed constant along x, that along y constant along y (Bathe and Dvorkin,
Int. J. Num. Meth. Eng. 21 (1985) 367-383), which on a rectangle takes rotations by their mean along
the strain. Narrow elements at a free edge resolve the boundary layer, as wide as the plate is
thick, that limits elements of low order to linear convergence (Babuška and Li, Comput. Methods
Appl. Mech. Engrg. 100 (1992) 249-273; Häggblad and Bathe, Int. J. Num. Meth. Eng. 30 (1990)
981-1011).
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.plate import Plate

DOF_PER_NODE = 3
SHEAR_CORRECTION = 5 / 6


@dataclass(frozen=True)
class Element:
    """A rectangle of (order + 1)² nodes with the degrees of freedom w, beta_x, beta_y at each.

    side: node positions along a side, from -1 to 1, (order + 1,); the same along x and y. Nodes are
    numbered row by row from the lower left, x running first; each field is the tensor product of
    the Lagrange polynomials of the side; beta_x, beta_y are the rotations of paper Eq. 1.
    """

    name: str
    side: tuple[float, ...]

    @property
    def order(self) -> int:
        """Polynomial order along a side."""
        return len(self.side) - 1

    def shape(self, xi: FloatArray) -> FloatArray:
        """Lagrange polynomials of a side at xi (n,) in -1..1: (n, order + 1), rows sum to 1."""
        return np.asarray(np.vander(xi, self.order + 1, increasing=True) @ self._coefficients())

    def stiffness(self, plate: Plate, dx: float, dy: float) -> FloatArray:
        """Stiffness (3 n, 3 n) [N/m, N, N m] of a dx by dy rectangle [m] (paper Eq. 17)."""
        bending, shear, _ = rigidities(plate)
        bend, coupled, twist = bending[0, 0], bending[0, 1], bending[2, 2]
        value, slope_value, slope = self._integrals()
        means = value.sum(axis=1)
        tied = np.outer(means, means) / 2 if self.order == 1 else value
        n = len(self.side) ** 2
        total = np.zeros((n, 3, n, 3))

        # kron(A, B): integral of A along y times integral of B along x, over the element's nodes.
        area = dx * dy / 4
        along_x = np.kron(value, slope) * dy / dx
        along_y = np.kron(slope, value) * dx / dy
        total[:, 0, :, 0] = shear * (along_x + along_y)
        total[:, 0, :, 1] = -shear * np.kron(value, slope_value) * dy / 2
        total[:, 0, :, 2] = -shear * np.kron(slope_value, value) * dx / 2
        total[:, 1, :, 1] = shear * np.kron(value, tied) * area + bend * along_x + twist * along_y
        total[:, 2, :, 2] = shear * np.kron(tied, value) * area + bend * along_y + twist * along_x
        total[:, 1, :, 2] = coupled * np.kron(slope_value.T, slope_value)
        total[:, 1, :, 2] += twist * np.kron(slope_value, slope_value.T)
        for row, column in ((0, 1), (0, 2), (1, 2)):
            total[:, column, :, row] = total[:, row, :, column].T
        return total.reshape(3 * n, 3 * n)

    def mass(self, plate: Plate, dx: float, dy: float) -> FloatArray:
        """Consistent mass (3 n, 3 n) with rotary inertia of a rectangle [m] (paper Eq. 19)."""
        value, _, _ = self._integrals()
        return np.asarray(np.kron(np.kron(value, value) * dx * dy / 4, rigidities(plate)[2]))

    def _coefficients(self) -> FloatArray:
        """Monomial coefficients of the Lagrange polynomials, a column for each node of a side."""
        return np.asarray(np.linalg.inv(np.vander(self.side, increasing=True)))

    def _integrals(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Integrals over -1..1 of N_i N_j, N_i' N_j and N_i' N_j', exact, (n, n) each."""
        points, weights = legendre.leggauss(len(self.side))
        powers = np.arange(len(self.side))
        shape = self.shape(points)
        slope = powers * points[:, None] ** np.maximum(powers - 1, 0) @ self._coefficients()
        weighted = (slope.T * weights) @ slope
        return (shape.T * weights) @ shape, (slope.T * weights) @ shape, weighted


def rigidities(plate: Plate) -> tuple[FloatArray, float, FloatArray]:
    """Bending (3, 3) [N m], shear [N/m] and inertia (3, 3) [kg/m², -, kg] of a plate's section.

    Paper Eq. 5 to 7, 17 and 20: D C_b, kappa G h and H.
    """
    nu, rho, h = plate.material.nu, plate.material.rho, plate.thickness
    bending = plate.flexural_rigidity * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
    inertia = np.diag([rho * h, rho * h**3 / 12, rho * h**3 / 12])
    return bending, SHEAR_CORRECTION * plate.material.shear_modulus * h, inertia


def _gauss_lobatto(order: int) -> tuple[float, ...]:
    """The order + 1 nodes: the ends and the extrema of the Legendre polynomial."""
    inner = legendre.Legendre.basis(order).deriv().roots().real
    return (-1.0, *sorted(inner.tolist()), 1.0)


MITC4 = Element("MITC4", (-1.0, 1.0))
Q3, Q4, Q5 = (Element(f"Q{order}", _gauss_lobatto(order)) for order in (3, 4, 5))

ELEMENTS = {element.name: element for element in (MITC4, Q3, Q4, Q5)}
"""All of them, by name."""


def element_of(name: str) -> Element:
    """Look up an element; raises InputError."""
    if name not in ELEMENTS:
        raise InputError(f"element must be one of {', '.join(ELEMENTS)}, got {name[:40]!r}")
    return ELEMENTS[name]
