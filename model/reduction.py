"""The plate in a few dozen coordinates, for solving it in time.

Modes of the free plate, and for every attachment three static vectors with what the modes already
carry taken out: the truncated modes' answer to a force there, and how it grows with omega. Without
them the modes converge slowly near a point force.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.free_plate import solve_free_plate
from model.mesh import Mesh
from model.plate import Plate

STATIC_VECTORS = 3  # for each attachment

# Static vectors of less than this share (squared) of their own size are another's to rounding.
_SAME = 1e-9


@dataclass(frozen=True)
class ReducedPlate:
    """The free plate in coordinates where its mass is the identity and its stiffness is diagonal.

    omega: (r,) [rad/s], the rigid-body modes 0, the last ones pseudo-modes that carry the static
    corrections; shapes: (node_count, r) deflection at the nodes [1/sqrt(kg)].
    """

    plate: Plate
    mesh: Mesh
    omega: FloatArray
    shapes: FloatArray

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points [m] (p, 2) of the plate, (p, r)."""
        return np.asarray(self.mesh.interpolation(points) @ self.shapes)


def reduce_plate(
    plate: Plate, mesh: Mesh, attachments: FloatArray, *, frequency_max: float = 500.0
) -> ReducedPlate:
    """Solve the free plate once, for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: up to where the response shall hold; modes well above it are kept.
    """
    free = solve_free_plate(plate, mesh, frequency_max=frequency_max)
    attached = free.attachments.solve(attachments)
    basis = free.attachments.basis(attached, mesh.nodes)
    modes = len(free.squared)
    count = len(attached.shapes)

    # Products of vectors a and b with mass and with stiffness + shift * mass are known already: the
    # sums over the truncated modes of phi phi u^(a + b) and u^(a + b - 1).
    power = np.add.outer(np.arange(STATIC_VECTORS), np.arange(STATIC_VECTORS))
    shape = (STATIC_VECTORS * count, STATIC_VECTORS * count)
    mass = attached.moments[power + 1].transpose(0, 2, 1, 3).reshape(shape)
    shifted = attached.moments[power].transpose(0, 2, 1, 3).reshape(shape)

    size = 1 / np.sqrt(np.diagonal(mass))
    strength, mix = linalg.eigh(mass * np.outer(size, size))
    apart = strength > _SAME * strength[-1]
    mix = size[:, None] * mix[:, apart] / np.sqrt(strength[apart])
    inverse_u, turn = linalg.eigh(mix.T @ shifted @ mix)
    omega = np.sqrt(inverse_u / free.largest_truncated - free.shift)
    static = basis[:, modes : modes + shape[0]] @ mix @ turn
    return ReducedPlate(
        plate,
        mesh,
        np.concatenate([np.sqrt(free.squared), omega]),
        np.hstack([basis[:, :modes], static]),
    )
