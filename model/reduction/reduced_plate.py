"""The plate in a few dozen coordinates, for its solution in time.

Modes of the free plate, and for every attachment three residual vectors, orthogonal to them: the
response of the truncated modes to a force there, and its growth with omega. Without these the modes
converge slowly near a point force. Where an attachment comes or goes while the plate vibrates, the
plate is reduced again and its motion is projected.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.spectral.mesh import PlateMesh
from model.structure.dispersion import Dispersion
from model.structure.footprint import as_footprints
from model.structure.plate import Plate

RESIDUAL_VECTORS = 3  # for each attachment

# Residual vectors below this share of their squared norm are linear combinations of the others.
_DEPENDENT = 1e-9


@dataclass(frozen=True, eq=False)
class ReductionBasis:
    """Source of a reduction: the solved free plate and the footprints (n, 3) [m].

    truncated_terms: between those points (`model.reduction.free_modes`); residual_transform
    (RESIDUAL_VECTORS n, s): from the residual vectors of the points to the coordinates.
    """

    free: FreePlate
    points: FloatArray
    truncated_terms: FloatArray
    residual_transform: FloatArray

    def terms_with(self, other: "ReductionBasis") -> FloatArray:
        """Its `truncated_terms`, between its points and another's, (m, n, k)."""
        # Most are shared, as when a finger comes or goes, and need no solve.
        same = (self.points[:, None] == other.points).all(axis=2)
        truncated_terms = self.truncated_terms[:, :, same.argmax(axis=0)]
        missing = ~same.any(axis=0)
        if missing.any():
            solver = self.free.modes
            truncated_terms[:, :, missing] = solver.truncated_terms(
                self.points, other.points[missing]
            )
        return truncated_terms


@dataclass(frozen=True, eq=False)
class ReducedPlate:
    """The free plate in coordinates with M = I and K = diag(omega²).

    omega: (r,) [rad/s], 0 for rigid-body modes, the last ones of the residual vectors; losses:
    (r,) [rad²/s²] beside those of the plate's loss factor; at: shapes at points (p, 2) or
    footprints (p, 3) [m], (p, r) [1/sqrt(kg)]; origin: None where only the coordinates are known;
    dispersion: how omega² changes with frequency, None where it does not.
    """

    plate: Plate
    omega: FloatArray
    losses: FloatArray
    at: Callable[[FloatArray], FloatArray]
    origin: ReductionBasis | None = None
    dispersion: Dispersion | None = None

    def with_attachments_at(self, points: FloatArray) -> "ReducedPlate":
        """Reduce the same plate for further points of attachment [m] (n, 2).

        Returns itself where its origin is not known: its shapes are then all there is.
        """
        if self.origin is None or not len(points):
            return self
        together = np.vstack([self.origin.points, as_footprints(points)])
        return reduce_free_plate(self.origin.free, together)

    def unknowns(self) -> tuple[FloatArray, ...]:
        """Its coordinates (r,) in the unknowns of the free plate, by symmetry class, (n, r)."""
        if self.origin is None:
            raise ValueError("only the coordinates of the plate are known")
        modes, transform = self.origin.free.modes, self.origin.residual_transform
        own = slice(len(modes.eigenvalues))
        residual = slice(own.stop, own.stop + len(transform))
        return tuple(
            np.hstack([each[:, own], each[:, residual] @ transform])
            for each in modes.unknowns(modes.solve_at(self.origin.points))
        )

    def projection_from(self, other: "ReducedPlate") -> FloatArray:
        """M-orthogonal projection of another reduction's coordinates onto its own, (r, other's r).

        Exact where it has all points of the other. Both must come from one free plate.
        """
        if self.origin is None or other.origin is None:
            return np.eye(len(self.omega))
        modes = len(self.origin.free.modes.eigenvalues)
        projection = np.zeros((len(self.omega), len(other.omega)))
        projection[:modes, :modes] = np.eye(modes)
        mass = _products(self.origin.terms_with(other.origin), power=1)
        projection[modes:, modes:] = (
            self.origin.residual_transform.T @ mass @ other.origin.residual_transform
        )
        return projection


def reduce_plate(
    plate: Plate, mesh: PlateMesh, attachments: FloatArray, *, frequency_max: float = 500.0
) -> ReducedPlate:
    """Solve and reduce a plate for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: upper limit of the response.
    """
    return reduce_free_plate(
        solve_free_plate(plate, mesh, frequency_max=frequency_max), attachments
    )


def reduce_free_plate(free: FreePlate, attachments: FloatArray) -> ReducedPlate:
    """Reduce a solved free plate for forces at the attachments [m] (n, 2)."""
    attached = free.modes.solve_at(as_footprints(attachments))
    modes = len(free.modes.eigenvalues)
    mass = _products(attached.truncated_terms, power=1)
    shifted = _products(attached.truncated_terms, power=0)

    # Orthonormal combinations of the residual vectors, then the eigenvectors among these.
    scale = 1 / np.sqrt(np.diagonal(mass))
    squared_norms, vectors = linalg.eigh(mass * np.outer(scale, scale))
    independent = squared_norms > _DEPENDENT * squared_norms.max(initial=0.0)
    orthonormal = scale[:, None] * vectors[:, independent] / np.sqrt(squared_norms[independent])
    shifted_eigenvalues, rotation = linalg.eigh(orthonormal.T @ shifted @ orthonormal)
    omega = np.sqrt(shifted_eigenvalues / free.modes.largest_truncated - free.shift)
    residual_transform = orthonormal @ rotation

    def shapes(points: FloatArray) -> FloatArray:
        places = np.atleast_2d(np.asarray(points, dtype=float))
        basis = free.modes.basis(attached, places)
        return np.hstack(
            [basis[:, :modes], basis[:, modes : modes + len(mass)] @ residual_transform]
        )

    return ReducedPlate(
        free.plate,
        np.concatenate([np.sqrt(free.modes.eigenvalues), omega]),
        np.concatenate([free.modes.losses, np.zeros(len(omega))]),
        shapes,
        ReductionBasis(free, attached.points, attached.truncated_terms, residual_transform),
        free.modes.dispersion and free.modes.dispersion.padded(len(omega)),
    )


def _products(truncated_terms: FloatArray, *, power: int) -> FloatArray:
    """Products of residual vectors a and b with M (power 1) or K + shift M (power 0).

    Sums over the truncated modes of phi phi u^(a + b + power), (n, m) for each pair of vectors:
    (RESIDUAL_VECTORS n, RESIDUAL_VECTORS m).
    """
    a = np.arange(RESIDUAL_VECTORS)
    several = truncated_terms[np.add.outer(a, a) + power].transpose(0, 2, 1, 3)
    rows, columns = truncated_terms.shape[1:]
    return np.asarray(several.reshape(RESIDUAL_VECTORS * rows, RESIDUAL_VECTORS * columns))
