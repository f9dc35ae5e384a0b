"""The four symmetry classes of a rectangular plate, each solved on a quarter of it.

Every field on a uniform free rectangle is the sum of four fields, even or odd about its middle
lines, that are not coupled: four problems of a quarter of the size with half the bandwidth.
Mirrored along x, the deflection and beta_y of an even field keep their sign and beta_x changes it.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy import sparse

from model.arrays import FloatArray, IntArray
from model.fem.assembly import ElementMatrices, element_dofs
from model.fem.elements import DOF_PER_NODE
from model.fem.mesh import Mesh

CLASSES = tuple(product((1, -1), (1, -1)))
"""Parity about the middle along x and along y: 1 even, -1 odd."""

# Sign of each degree of freedom of a node in the mirror image of an even field.
_SIGN_X = np.array([1, -1, 1])
_SIGN_Y = np.array([1, 1, -1])


@dataclass(frozen=True, eq=False)
class SymmetryClass:
    """Fields of one parity: the whole plate's degrees of freedom from a quarter's.

    A field of the whole plate is sign * quarter[place] / 2, so that stiffness and mass of the
    quarter are those of the whole. place (dof,): indices into the quarter's degrees of freedom;
    sign (dof,): 1, -1, or 0 for a degree of freedom that is zero by symmetry (place is then
    meaningless); size: number of the quarter's degrees of freedom.
    """

    mesh: Mesh
    place: IntArray
    sign: FloatArray
    size: int

    @cached_property
    def expansion(self) -> sparse.csr_array:
        """Map of a quarter's field to the deflection at all nodes, (node_count, size)."""
        place, sign = self.place[::DOF_PER_NODE], self.sign[::DOF_PER_NODE]
        rows = np.flatnonzero(sign)
        shape = (self.mesh.node_count, self.size)
        return sparse.csr_array((sign[rows] / 2, (rows, place[rows])), shape=shape)

    def deflection_at(self, points: FloatArray) -> sparse.csr_array:
        """Map of a quarter's field to the deflection at points [m] (p, 2), (p, size)."""
        return sparse.csr_array(self.mesh.interpolation(points) @ self.expansion)

    def assemble(
        self, elements: ElementMatrices, shift: float
    ) -> tuple[sparse.coo_array, sparse.coo_array]:
        """Assemble K + shift M and M of the quarter, (size, size), entries not yet summed."""
        count_x, count_y = self.mesh.element_counts
        weight_x, weight_y = _quarter_weights(count_x), _quarter_weights(count_y)
        column, row = np.meshgrid(np.arange(len(weight_x)), np.arange(len(weight_y)))
        chosen = (row * count_x + column).ravel()
        weight = np.outer(weight_y, weight_x).ravel()
        dofs = element_dofs(self.mesh)[chosen]
        place, sign = self.place[dofs], self.sign[dofs]
        size = elements.size[chosen]

        def whole(matrices: FloatArray) -> sparse.coo_array:
            a, b = np.nonzero(matrices.any(axis=0))
            # Degrees of freedom that are zero by symmetry add zeros within the band.
            values = matrices[:, a, b][size] * sign[:, a] * sign[:, b] * weight[:, None]
            places = (place[:, a].ravel(), place[:, b].ravel())
            return sparse.coo_array((values.ravel(), places), shape=(self.size, self.size))

        return whole(elements.stiffness + shift * elements.mass), whole(elements.mass)


def symmetry_class(mesh: Mesh, parity: tuple[int, int]) -> SymmetryClass:
    """Make one of the four classes; parity is one of CLASSES."""
    fold_x, side_x = _fold(mesh.columns)
    fold_y, side_y = _fold(mesh.rows)
    # Numbered along the shorter side first: smallest bandwidth.
    quarter_x, quarter_y = (mesh.columns + 1) // 2, (mesh.rows + 1) // 2
    if quarter_x >= quarter_y:
        node = fold_x * quarter_y + fold_y[:, None]
    else:
        node = fold_y[:, None] * quarter_x + fold_x
    sign_x = _sign(side_x, parity[0] * _SIGN_X)
    sign_y = _sign(side_y, parity[1] * _SIGN_Y)
    sign = (sign_y[:, None, :] * sign_x[None, :, :]).reshape(-1)
    dof = (DOF_PER_NODE * node[:, :, None] + np.arange(DOF_PER_NODE)).reshape(-1)

    used = np.zeros(DOF_PER_NODE * quarter_x * quarter_y, dtype=bool)
    used[dof[sign != 0]] = True
    number = np.cumsum(used) - 1
    return SymmetryClass(mesh, number[dof], sign.astype(float), int(used.sum()))


def _fold(count: int) -> tuple[IntArray, IntArray]:
    """Index of each node of a row folded into the first half, and its side, (count,) each.

    The side is 1 before the middle, 0 on it, -1 beyond.
    """
    index = np.arange(count)
    mirrored = count - 1 - index
    return np.minimum(index, mirrored), np.sign(mirrored - index)


def _sign(side: IntArray, mirror_sign: IntArray) -> IntArray:
    """Signs (nodes, 3) of a row: mirror_sign beyond the middle, on it 0 where mirror_sign is -1."""
    on_middle = (mirror_sign + 1) // 2
    side = side[:, None]
    return np.where(side == 1, 1, np.where(side == -1, mirror_sign, on_middle))


def _quarter_weights(count: int) -> FloatArray:
    """Weights of a row's elements in the half that is summed: 1/2 for one across the middle."""
    weights = np.ones((count + 1) // 2)
    if count % 2:
        weights[-1] = 0.5
    return weights
