"""The plate in a few dozen coordinates, for solving it in time.

Modes of the free plate, and for every attachment three static vectors with what the modes already
carry taken out: the truncated modes' answer to a force there, and how it grows with omega. Without
them the modes converge slowly near a point force. Where a force comes or goes while the plate
vibrates, it is reduced anew, and its motion is carried over.
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
    """What a plate was reduced from: the solved free plate, for forces at points (n, 2) [m].

    moments: what the truncated modes add between those points (`model.reduction.attachments`);
    mixture (STATIC_VECTORS n, s): its static coordinates by the residual vectors of the points.
    """

    free: FreePlate
    points: FloatArray
    moments: FloatArray
    mixture: FloatArray

    def moments_with(self, other: "Origin") -> FloatArray:
        """The same between its points and another's, (m, n, k)."""
        # Most are among its own, as when a finger comes or goes: no need to solve for them again.
        same = (self.points[:, None] == other.points).all(axis=2)
        moments = self.moments[:, :, same.argmax(axis=0)]
        missing = ~same.any(axis=0)
        if missing.any():
            solver = self.free.attachments
            moments[:, :, missing] = solver.moments(self.points, other.points[missing])
        return moments


@dataclass(frozen=True, eq=False)
class ReducedPlate:
    """The free plate in coordinates where its mass is the identity and its stiffness is diagonal.

    omega: (r,) [rad/s], the rigid-body modes 0, the last ones pseudo-modes that carry the static
    corrections; shapes: (node_count, r) deflection at the nodes [1/sqrt(kg)]; origin: None where
    the coordinates are all that is known.
    """

    plate: Plate
    mesh: Mesh
    omega: FloatArray
    shapes: FloatArray
    origin: Origin | None = None

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points [m] (p, 2) of the plate, (p, r)."""
        return np.asarray(self.mesh.interpolation(points) @ self.shapes)

    def with_forces_at(self, points: FloatArray) -> "ReducedPlate":
        """The same plate, ready for forces at further points [m] (n, 2).

        Itself where its origin is not known: forces then reach it by the shapes it has.
        """
        if self.origin is None or not len(points):
            return self
        return reduce_free_plate(self.origin.free, np.vstack([self.origin.points, points]))

    def carried_over_from(self, other: "ReducedPlate") -> FloatArray:
        """Its coordinates are this (r, other's r) times those of another reduction, mass-weighted.

        Nothing is lost where it answers for all points of the other; what it has no coordinates for
        is left out. Both must come from one free plate.
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
    """Solve the free plate once, for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: up to where the response shall hold; modes well above it are kept.
    """
    return reduce_free_plate(
        solve_free_plate(plate, mesh, frequency_max=frequency_max), attachments
    )


def reduce_free_plate(free: FreePlate, attachments: FloatArray) -> ReducedPlate:
    """Reduce a free plate that has been solved, for forces at the attachments [m] (n, 2)."""
    attached = free.attachments.solve(attachments)
    basis = free.attachments.basis(attached, free.mesh.nodes)
    modes = len(free.eigenvalues)
    mass = _products(attached.moments, power=1)
    shifted = _products(attached.moments, power=0)

    size = 1 / np.sqrt(np.diagonal(mass))
    strength, mix = linalg.eigh(mass * np.outer(size, size))
    apart = strength > _SAME * strength[-1]
    mix = size[:, None] * mix[:, apart] / np.sqrt(strength[apart])
    inverse_u, turn = linalg.eigh(mix.T @ shifted @ mix)
    omega = np.sqrt(inverse_u / free.largest_truncated - free.shift)
    mixture = mix @ turn
    return ReducedPlate(
        free.plate,
        free.mesh,
        np.concatenate([np.sqrt(free.eigenvalues), omega]),
        np.hstack([basis[:, :modes], basis[:, modes : modes + len(mass)] @ mixture]),
        Origin(free, np.asarray(attachments, dtype=float), attached.moments, mixture),
    )


def _products(moments: FloatArray, *, power: int) -> FloatArray:
    """Products of static vectors a and b with mass (power 1) or stiffness + shift * mass (0).

    They are known already: sums over the truncated modes of phi phi u^(a + b + power), (n, m) for
    each pair of vectors, (STATIC_VECTORS n, STATIC_VECTORS m).
    """
    a = np.arange(STATIC_VECTORS)
    several = moments[np.add.outer(a, a) + power].transpose(0, 2, 1, 3)
    rows, columns = moments.shape[1:]
    return np.asarray(several.reshape(STATIC_VECTORS * rows, STATIC_VECTORS * columns))
