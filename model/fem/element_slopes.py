"""How the stiffness of finite elements changes with a plate's sides and Poisson's ratio, exactly.

As `model.spectral.shape_stiffness`, whose reasons hold for the elements' functions, too.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.fem.assembly import element_matrices, element_sizes
from model.fem.elements import DOF_PER_NODE
from model.fem.mesh import Mesh
from model.fem.symmetry import CLASSES, symmetry_class
from model.structure.plate import Plate

NUS = (0.0, 0.4)
"""Poisson's ratios of a difference: any two, since the stiffness is linear in between."""

SQUARES = (0.5, 1.5)
"""Squares of s of a difference, about 1."""


def element_slopes(plate: Plate, mesh: Mesh, unknowns: Sequence[FloatArray]) -> FloatArray:
    """Derivatives of the stiffness between shapes (r,) of a plate on a mesh, (3, r, r).

    By the logarithms of length and width, at the same mass, and by Poisson's ratio. unknowns: of
    the shapes, by symmetry class, (n, r).
    """
    elements, sizes, element = element_matrices(plate, mesh), element_sizes(mesh), mesh.element
    slopes = np.zeros((3, *elements.stiffness.shape))
    for axis in range(2):
        for square, share in zip(SQUARES, (2.0, -2.0), strict=True):  # d s² / d ln side = -2
            s = np.ones(DOF_PER_NODE)
            s[1 + axis] = square**0.5
            nodal = np.tile(s, elements.stiffness.shape[1] // DOF_PER_NODE)
            stretched = [
                element.stiffness(plate, dx / s[1], dy / s[2]) * s.prod() for dx, dy in sizes
            ]
            slopes[axis] += share * np.array(stretched) * np.outer(nodal, nodal)
    nu, material = plate.material.nu, plate.material
    slopes[2] = 2 * nu * elements.stiffness
    for other, share in zip(NUS, (-1.0, 1.0), strict=True):
        changed = replace(plate, material=replace(material, nu=other))
        factor = share * (1 - other**2) / (NUS[1] - NUS[0])
        slopes[2] += factor * np.array([element.stiffness(changed, *size) for size in sizes])
    slopes[2] /= 1 - nu**2
    found = np.zeros((3, *2 * unknowns[0].shape[1:]))
    for parity, v in zip(CLASSES, unknowns, strict=True):
        symmetry = symmetry_class(mesh, parity)
        for slope, total in zip(slopes, found, strict=True):
            K, _ = symmetry.assemble(replace(elements, stiffness=slope), 0.0)
            total += v.T @ (K @ v)
    return found
