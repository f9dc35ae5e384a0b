"""Assembly of the plate's sparse stiffness and mass matrices."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from model.arrays import FloatArray, IntArray
from model.errors import InputError
from model.fem.elements import DOF_PER_NODE
from model.fem.mesh import Mesh
from model.structure.plate import Plate


@dataclass(frozen=True)
class PlateMatrices:
    """Stiffness and mass of the free plate, CSC, (dof, dof), with its mesh.

    Degree of freedom 3 * node is the deflection, the next two are the rotations.
    """

    plate: Plate
    mesh: Mesh
    stiffness: sparse.csc_array
    mass: sparse.csc_array

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return DOF_PER_NODE * self.mesh.node_count

    def deflection_at(self, points: FloatArray) -> sparse.csr_array:
        """Map of the degrees of freedom to deflections at points [m] (n, 2), sparse (n, dof)."""
        pick = sparse.csr_array(np.array([[1.0, 0.0, 0.0]]))
        return sparse.csr_array(sparse.kron(self.mesh.interpolation(points), pick, format="csr"))


@dataclass(frozen=True)
class ElementMatrices:
    """Stiffness and mass of each size of element of a mesh, (sizes, n, n).

    size (elements,): index of each element's matrices.
    """

    stiffness: FloatArray
    mass: FloatArray
    size: IntArray


def element_matrices(plate: Plate, mesh: Mesh) -> ElementMatrices:
    """Compute the matrices of one size of element, or of four with strips along the edges.

    Raises InputError for a mesh of another plate, and for a plate of layers or with air behind it.
    """
    if plate.is_layered:
        what = "a laminate" if plate.laminate is not None else "a plate with an air gap"
        raise InputError(
            f"mesh: must be of polynomials for {what}, got {mesh}; finite elements are for "
            "homogeneous plates in a vacuum: use mesh auto, or Legendre with degrees"
        )
    sides = ((plate.length, mesh.length), (plate.width, mesh.width))
    if not all(math.isclose(*side) for side in sides):
        raise InputError(
            f"mesh: must cover the plate of {plate.length:g} x {plate.width:g} m, got "
            f"{mesh.length:g} x {mesh.width:g} m; make the mesh for this plate"
        )
    sizes = element_sizes(mesh)
    side_x, side_y = mesh.element_sides
    return ElementMatrices(
        stiffness=np.array([mesh.element.stiffness(plate, dx, dy) for dx, dy in sizes]),
        mass=np.array([mesh.element.mass(plate, dx, dy) for dx, dy in sizes]),
        size=((2 if mesh.strip else 1) * side_y[:, None] + side_x).ravel(),
    )


def element_sizes(mesh: Mesh) -> list[tuple[float, float]]:
    """Length and width [m] of each size of element."""
    widths = [(size, mesh.strip) if mesh.strip else (size,) for size in mesh.element_size]
    return [(dx, dy) for dy in widths[1] for dx in widths[0]]


def element_dofs(mesh: Mesh) -> IntArray:
    """Degrees of freedom of each element, node by node, (elements, 3 (order + 1)²)."""
    dofs = DOF_PER_NODE * mesh.connectivity[:, :, None] + np.arange(DOF_PER_NODE)
    return np.asarray(dofs.reshape(len(mesh.connectivity), -1))


def assemble(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """Assemble stiffness and mass of the free plate."""
    elements = element_matrices(plate, mesh)
    dofs = element_dofs(mesh)
    size = DOF_PER_NODE * mesh.node_count

    def whole(matrices: FloatArray) -> sparse.csc_array:
        row, column = np.nonzero(matrices.any(axis=0))
        values = matrices[:, row, column][elements.size]
        places = (dofs[:, row].ravel(), dofs[:, column].ravel())
        return sparse.csc_array(sparse.coo_array((values.ravel(), places), shape=(size, size)))

    return PlateMatrices(plate, mesh, whole(elements.stiffness), whole(elements.mass))
