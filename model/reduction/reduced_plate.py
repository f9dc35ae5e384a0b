"""The plate in a few dozen coordinates, for its solution in time.

Modes of the free plate, and for every attachment three static vectors, orthogonal to them: the
response of the truncated modes to a force there, and its growth with omega. Without these the modes
converge slowly near a point force. Where an attachment comes or goes while the plate vibrates, the
plate is reduced again and its motion is projected.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.structure.plate import Plate

STATIC_VECTORS = 3  # for each attachment

# Static vectors below this share of their squared norm are linear combinations of the others.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Origin:
    """Source of a reduction: the solved free plate and the points of attachment (n, 2) [m].

    moments: of the truncated modes between those points (`model.reduction.attachments`);
    mixture (STATIC_VECTORS n, s): static coordinates by the residual vectors of the points.
    """

    free: FreePlate
    points: FloatArray
    moments: FloatArray
    mixture: FloatArray

    def moments_with(self, other: "Origin") -> FloatArray:
        """Moments between its points and another's, (m, n, k)."""
        # Most are shared, as when a finger comes or goes, and need no solve.
        same = (self.points[:, None] == other.points).all(axis=2)
        moments = self.moments[:, :, same.argmax(axis=0)]
        missing = ~same.any(axis=0)
        if missing.any():
            solver = self.free.attachments
            moments[:, :, missing] = solver.moments(self.points, other.points[missing])
        return moments


@dataclass(frozen=True, eq=False)
class ReducedPlate:
    """The free plate in coordinates with M = I and K = diag(omega²).

    omega: (r,) [rad/s], 0 for rigid-body modes, the last ones pseudo-modes of the static
    corrections; shapes: (node_count, r) deflection at the nodes [1/sqrt(kg)]; origin: None where
    only the coordinates are known.
    """

    plate: Plate
    mesh: Mesh
    omega: FloatArray
    shapes: FloatArray
    origin: Origin | None = None

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points [m] (p, 2) of the plate, (p, r)."""
        return np.asarray(self.mesh.interpolation(points) @ self.shapes)

    def with_attachments_at(self, points: FloatArray) -> "ReducedPlate":
        """Reduce the same plate for further points of attachment [m] (n, 2).

        Returns itself where its origin is not known: its shapes are then all there is.
        """
        if self.origin is None or not len(points):
            return self
        return reduce_free_plate(self.origin.free, np.vstack([self.origin.points, points]))

    def projection_from(self, other: "ReducedPlate") -> FloatArray:
        """M-orthogonal projection of another reduction's coordinates onto its own, (r, other's r).

        Exact where it has all points of the other. Both must come from one free plate.
        """
        if self.origin is None or other.origin is None:
            return np.eye(len(self.omega))
        modes = len(self.origin.free.eigenvalues)
        carried = np.zeros((len(self.omega), len(other.omega)))
        carried[:modes, :modes] = np.eye(modes)
        mass = _products(self.origin.moments_with(other.origin), power=1)
        carried[modes:, modes:] = self.origin.mixture.T @ mass @ other.origin.mixture
        return carried


def reduce_plate(
    plate: Plate, mesh: Mesh, attachments: FloatArray, *, frequency_max: float = 500.0
) -> ReducedPlate:
    """Solve and reduce a plate for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: upper limit of the response.
    """
    return reduce_free_plate(
        solve_free_plate(plate, mesh, frequency_max=frequency_max), attachments
    )


def reduce_free_plate(free: FreePlate, attachments: FloatArray) -> ReducedPlate:
    """Reduce a solved free plate for forces at the attachments [m] (n, 2)."""
    attached = free.attachments.solve(attachments)
    basis = free.attachments.basis(attached, free.mesh.nodes)
    modes = len(free.eigenvalues)
    mass = _products(attached.moments, power=1)
    shifted = _products(attached.moments, power=0)

    size = 1 / np.sqrt(np.diagonal(mass))
    strength, mix = linalg.eigh(mass * np.outer(size, size))
    apart = strength > _SAME * strength[-1]
    mix = size[:, None] * mix[:, apart] / np.sqrt(strength[apart])
    inverse_u, rotation = linalg.eigh(mix.T @ shifted @ mix)
    omega = np.sqrt(inverse_u / free.largest_truncated - free.shift)
    mixture = mix @ rotation
    return ReducedPlate(
        free.plate,
        free.mesh,
        np.concatenate([np.sqrt(free.eigenvalues), omega]),
        np.hstack([basis[:, :modes], basis[:, modes : modes + len(mass)] @ mixture]),
        Origin(free, np.asarray(attachments, dtype=float), attached.moments, mixture),
    )


def _products(moments: FloatArray, *, power: int) -> FloatArray:
    """Products of static vectors a and b with M (power 1) or K + shift M (power 0).

    Sums over the truncated modes of phi phi u^(a + b + power), (n, m) for each pair of vectors:
    (STATIC_VECTORS n, STATIC_VECTORS m).
    """
    a = np.arange(STATIC_VECTORS)
    several = moments[np.add.outer(a, a) + power].transpose(0, 2, 1, 3)
    rows, columns = moments.shape[1:]
    return np.asarray(several.reshape(STATIC_VECTORS * rows, STATIC_VECTORS * columns))
