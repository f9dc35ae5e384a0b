"""From one element to the whole plate: sparse stiffness and mass, and what holds them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from model.actuator import Era
from model.arrays import FloatArray
from model.elements import mitc4
from model.mesh import Mesh
from model.plate import Plate


@dataclass(frozen=True)
class PlateMatrices:
    """Stiffness and mass of the free plate, CSC, (dof, dof), with the mesh that they belong to.

    Degree of freedom 3 * node is the deflection, the next two are the rotations.
    """

    plate: Plate
    mesh: Mesh
    stiffness: sparse.csc_array
    mass: sparse.csc_array

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return mitc4.DOF_PER_NODE * self.mesh.node_count

    def deflection_at(self, points: FloatArray) -> sparse.csr_array:
        """Maps the degrees of freedom to deflections at points [m] (n, 2): sparse (n, dof)."""
        pick = sparse.csr_array(np.array([[1.0, 0.0, 0.0]]))
        return sparse.csr_array(sparse.kron(self.mesh.interpolation(points), pick, format="csr"))


def assemble(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """Assemble the free plate; all elements of a structured mesh share one element matrix."""
    dx, dy = mesh.element_size
    dofs = (3 * mesh.connectivity[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows = np.repeat(dofs, 12, axis=1).ravel()
    columns = np.tile(dofs, (1, 12)).ravel()
    size = 3 * mesh.node_count

    def whole(element: FloatArray) -> sparse.csc_array:
        values = np.tile(element.ravel(), len(dofs))
        return sparse.csc_array(sparse.coo_array((values, (rows, columns)), shape=(size, size)))

    return PlateMatrices(
        plate, mesh, whole(mitc4.stiffness(plate, dx, dy)), whole(mitc4.mass(plate, dx, dy))
    )


def era_positions(eras: Sequence[Era]) -> FloatArray:
    """Positions of ERAs [m], (n, 2)."""
    return np.array([[era.x, era.y] for era in eras], dtype=float).reshape(-1, 2)
