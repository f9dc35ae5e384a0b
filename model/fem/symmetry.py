"""The four symmetry classes of a rectangular plate, each solved on a quarter of it.

A uniform free rectangle is its own mirror image in both of its middle lines. Every field on it is
the sum of four that are even or odd about these lines, and the plate does not couple them: in place
of one problem there are four of a quarter of the size, whose bands are half as wide. Mirrored along
x, the deflection and beta_y keep their sign in an even field and beta_x changes it.
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

# How each degree of freedom of a node turns in an even field, mirrored along x and along y.
_TURN_X = np.array([1, -1, 1])
_TURN_Y = np.array([1, 1, -1])


@dataclass(frozen=True, eq=False)
class SymmetryClass:
    """Fields of one parity, and how the whole plate's degrees of freedom follow from a quarter's.

    place: (dof,) which of the quarter's degrees of freedom each of the plate's follows, and sign:
    (dof,) how: 1, -1, or 0 for what is zero by symmetry (place is then meaningless). size: how many
    a quarter has. A field of the whole plate is sign * quarter[place] / 2, so that stiffness and
    mass of the quarter are those of the whole.
    """

    mesh: Mesh
    place: IntArray
    sign: FloatArray
    size: int

    @cached_property
    def spread(self) -> sparse.csr_array:
        """Deflection at every node of the plate from a quarter's field, (node_count, size)."""
        place, sign = self.place[::DOF_PER_NODE], self.sign[::DOF_PER_NODE]
        rows = np.flatnonzero(sign)
        shape = (self.mesh.node_count, self.size)
        return sparse.csr_array((sign[rows] / 2, (rows, place[rows])), shape=shape)

    def assemble(
        self, elements: ElementMatrices, shift: float
    ) -> tuple[sparse.coo_array, sparse.coo_array]:
        """Stiffness + shift * mass and the mass, (size, size), entries not yet summed."""
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
            # What is zero by symmetry adds zeros somewhere near.
            values = matrices[:, a, b][size] * sign[:, a] * sign[:, b] * weight[:, None]
            places = (place[:, a].ravel(), place[:, b].ravel())
            return sparse.coo_array((values.ravel(), places), shape=(self.size, self.size))

        return whole(elements.stiffness + shift * elements.mass), whole(elements.mass)


def symmetry_class(mesh: Mesh, parity: tuple[int, int]) -> SymmetryClass:
    """One of the four classes; parity is one of CLASSES."""
    fold_x, side_x = _fold(mesh.columns)
    fold_y, side_y = _fold(mesh.rows)
    # The shorter side runs first: the band is then at its narrowest.
    quarter_x, quarter_y = (mesh.columns + 1) // 2, (mesh.rows + 1) // 2
    if quarter_x >= quarter_y:
        node = fold_x * quarter_y + fold_y[:, None]
    else:
        node = fold_y[:, None] * quarter_x + fold_x
    sign_x = _sign(side_x, parity[0] * _TURN_X)
    sign_y = _sign(side_y, parity[1] * _TURN_Y)
    sign = (sign_y[:, None, :] * sign_x[None, :, :]).reshape(-1)
    dof = (DOF_PER_NODE * node[:, :, None] + np.arange(DOF_PER_NODE)).reshape(-1)

    used = np.zeros(DOF_PER_NODE * quarter_x * quarter_y, dtype=bool)
    used[dof[sign != 0]] = True
    number = np.cumsum(used) - 1
    return SymmetryClass(mesh, number[dof], sign.astype(float), int(used.sum()))


def _fold(count: int) -> tuple[IntArray, IntArray]:
    """Of each node of a row: its mirror image in the first half, and on which side it lies.

    Both (count,); the side is 1 before the middle, 0 on it, -1 beyond.
    """
    index = np.arange(count)
    mirrored = count - 1 - index
    return np.minimum(index, mirrored), np.sign(mirrored - index)


def _sign(side: IntArray, turn: IntArray) -> IntArray:
    """Signs (nodes, 3) of a row: turned beyond the middle, zero on it where it would turn."""
    return np.where(side[:, None] == 1, 1, np.where(side[:, None] == -1, turn, (turn + 1) // 2))


def _quarter_weights(count: int) -> FloatArray:
    """Weights of a row's elements in the half that is summed: the middle one is its own image."""
    weights = np.ones((count + 1) // 2)
    if count % 2:
        weights[-1] = 0.5
    return weights
