"""MITC4: the four-node Reissner-Mindlin rectangle with assumed transverse shear strain.

Bathe and Dvorkin, Int. J. Num. Meth. Eng. 21 (1985) 367-383. Full integration of the shear locks,
one-point integration leaves spurious modes on ERAs; the assumed strain does neither. It is the
element of the founding paper.
"""

import numpy as np

from model.arrays import FloatArray
from model.fem.elements.element import Element, rigidities
from model.structure.plate import Plate

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
_GAUSS = np.array([[s, t] for t in (-1, 1) for s in (-1, 1)]) / np.sqrt(3)


def _shape(xi: float, eta: float) -> FloatArray:
    """Bilinear shape functions of the four nodes, (4,)."""
    return 0.25 * (1 + _CORNERS[:, 0] * xi) * (1 + _CORNERS[:, 1] * eta)


def _shape_gradient(xi: float, eta: float, dx: float, dy: float) -> tuple[FloatArray, FloatArray]:
    """Their derivatives along x and y [1/m], (4,) each."""
    along_x = 0.25 * _CORNERS[:, 0] * (1 + _CORNERS[:, 1] * eta) * 2 / dx
    along_y = 0.25 * _CORNERS[:, 1] * (1 + _CORNERS[:, 0] * xi) * 2 / dy
    return along_x, along_y


def _curvature(xi: float, eta: float, dx: float, dy: float) -> FloatArray:
    """Rows d(beta_x)/dx, d(beta_y)/dy, d(beta_x)/dy + d(beta_y)/dx of the 12 dof (paper Eq. 5)."""
    along_x, along_y = _shape_gradient(xi, eta, dx, dy)
    rows = np.zeros((3, 12))
    rows[0, 1::3] = along_x
    rows[1, 2::3] = along_y
    rows[2, 1::3] = along_y
    rows[2, 2::3] = along_x
    return rows


def _shear(xi: float, eta: float, dx: float, dy: float) -> FloatArray:
    """Rows dw/dx - beta_x and dw/dy - beta_y of the 12 dof (paper Eq. 3)."""
    along_x, along_y = _shape_gradient(xi, eta, dx, dy)
    shape = _shape(xi, eta)
    rows = np.zeros((2, 12))
    rows[0, 0::3] = along_x
    rows[0, 1::3] = -shape
    rows[1, 0::3] = along_y
    rows[1, 2::3] = -shape
    return rows


def _assumed_shear(xi: float, eta: float, dx: float, dy: float) -> FloatArray:
    """The shear strain tied at the middles of the sides and linear between opposite ones."""
    below, above = _shear(0, -1, dx, dy)[0], _shear(0, 1, dx, dy)[0]
    left, right = _shear(-1, 0, dx, dy)[1], _shear(1, 0, dx, dy)[1]
    return np.stack(
        [
            0.5 * (1 - eta) * below + 0.5 * (1 + eta) * above,
            0.5 * (1 - xi) * left + 0.5 * (1 + xi) * right,
        ]
    )


def stiffness(plate: Plate, dx: float, dy: float) -> FloatArray:
    """Element stiffness (12, 12) of a dx by dy rectangle [m] (paper Eq. 17)."""
    bending, shear, _ = rigidities(plate)
    area = dx * dy / 4  # of one Gauss point, whose weight is 1
    total = np.zeros((12, 12))
    for xi, eta in _GAUSS:
        curvature = _curvature(xi, eta, dx, dy)
        strain = _assumed_shear(xi, eta, dx, dy)
        total += area * (curvature.T @ bending @ curvature + shear * strain.T @ strain)
    return total


def mass(plate: Plate, dx: float, dy: float) -> FloatArray:
    """Consistent element mass (12, 12) of a dx by dy rectangle [m] (paper Eq. 19).

    With rotary inertia.
    """
    _, _, inertia = rigidities(plate)
    area = dx * dy / 4
    total = np.zeros((12, 12))
    for xi, eta in _GAUSS:
        fields = np.kron(_shape(xi, eta), np.eye(3))
        total += area * fields.T @ inertia @ fields
    return total


MITC4 = Element("MITC4", side=(-1.0, 1.0), stiffness=stiffness, mass=mass)
