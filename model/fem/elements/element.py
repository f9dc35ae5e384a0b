"""Plate elements: node positions and matrices."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from model.arrays import FloatArray
from model.structure.plate import Plate

DOF_PER_NODE = 3
SHEAR_CORRECTION = 5 / 6

ElementMatrix = Callable[[Plate, float, float], FloatArray]


@dataclass(frozen=True)
class Element:
    """A rectangle of (order + 1)² nodes with the degrees of freedom w, beta_x, beta_y at each.

    side: node positions along a side, from -1 to 1, (order + 1,); the same along x and y.
    Nodes are numbered row by row from the lower left, x running first; the deflection is the tensor
    product of the Lagrange polynomials of the side. stiffness(plate, dx, dy) [N/m, N, N m] and
    mass(plate, dx, dy) [kg, kg m, kg m²] give the matrices (3 n, 3 n) of a dx by dy rectangle [m];
    beta_x, beta_y are the rotations of paper Eq. 1.
    """

    name: str
    side: tuple[float, ...]
    stiffness: ElementMatrix = field(compare=False)
    mass: ElementMatrix = field(compare=False)

    @property
    def order(self) -> int:
        """Polynomial order of the deflection along a side."""
        return len(self.side) - 1

    @cached_property
    def _coefficients(self) -> FloatArray:
        """Monomial coefficients of the Lagrange polynomials, a column for each node of a side."""
        return np.asarray(np.linalg.inv(np.vander(self.side, increasing=True)))

    def shape(self, xi: FloatArray) -> FloatArray:
        """Lagrange polynomials of a side at xi (n,) in -1..1: (n, order + 1), rows sum to 1."""
        return np.asarray(np.vander(xi, self.order + 1, increasing=True) @ self._coefficients)


def rigidities(plate: Plate) -> tuple[FloatArray, float, FloatArray]:
    """Bending (3, 3) [N m], shear [N/m] and inertia (3, 3) [kg/m², -, kg] of a plate's section.

    Paper Eq. 5 to 7, 17 and 20: D C_b, kappa G h and H.
    """
    nu, rho, h = plate.material.nu, plate.material.rho, plate.thickness
    bending = plate.flexural_rigidity * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
    inertia = np.diag([rho * h, rho * h**3 / 12, rho * h**3 / 12])
    return bending, SHEAR_CORRECTION * plate.material.shear_modulus * h, inertia
