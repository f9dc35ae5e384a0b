"""Reduced plate: a few dozen coordinates q in place of all unknowns of the free plate.

    w(p) = phi(p)' q,    q'' + diag(omega²) q = sum_a phi(p_a) F_a

with the displacement w at a point p, and forces F_a at the points of attachment p_a. The first
coordinates belong to the modes of the free plate up to a cut-off. The truncated modes, with
eigenvalues lambda, yield little; each attachment adds RESIDUAL_VECTORS residual vectors for them,

    r_a,j(p) = sum_truncated u^j phi(p) phi(p_a),    u = 1 / (lambda + shift),    j = 1, 2, 3.

r_1 is the static response of the truncated modes (residual flexibility, [1]) and r_2 the response
to its inertia [2]. Without them the modes converge slowly near a point force. Their inner products
follow from sums over the truncated modes at the attachments:

    r_a,j' M r_b,k = sum u^(j + k) phi(p_a) phi(p_b)
    r_a,j' (K + shift M) r_b,k = sum u^(j + k - 1) phi(p_a) phi(p_b)

The residual coordinates are the eigenvectors of this pair of matrices, so M = I and K is diagonal.
If an attachment is added or removed while the plate vibrates, the plate is reduced again and its
motion is projected onto the new coordinates.

[1] R. H. MacNeal, A hybrid method of component mode synthesis, Computers & Structures 1 (1971).
[2] S. Rubin, Improved component-mode representation for structural dynamic analysis, AIAA Journal
    13 (1975).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.spectral.plate_mesh import PlateMesh
from model.structure.footprints import as_footprints
from model.structure.modal_elasticity import Dispersion, ModalElasticity
from model.structure.plate import Plate

RESIDUAL_VECTORS = 3
"""Number of residual vectors for each attachment."""

_DEPENDENT = 1e-9
"""Share of the largest squared norm below which a combination of residual vectors is dropped: they
are linearly dependent, for example at two attachments with equal positions."""

_MIN_SHIFTED = 0.99
"""Lowest eigenvalue of K + shift M that is kept, relative to the lowest truncated mode's. The local
compliance between many near points is an approximation: it leaves a few eigenvalues below, also
negative ones, whose vectors yield next to nothing."""


@dataclass(frozen=True, eq=False)
class ReductionBasis:
    """Source of a reduction: the solved free plate and the footprints (n, 3) [m].

    residual_transform (RESIDUAL_VECTORS n, s): from the residual vectors of the points to the
    coordinates.
    """

    free: FreePlate
    points: FloatArray
    residual_transform: FloatArray

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Return the shapes of the coordinates at points (p, 2) or footprints (p, 3), (p, r)."""
        observed = np.atleast_2d(np.asarray(points, dtype=float))
        return self._coordinates(self.free.modes.basis(self.points, observed))

    def unknowns(self) -> tuple[FloatArray, ...]:
        """Return the coordinates in the unknowns of the plate, by symmetry class, (n, r)."""
        return tuple(map(self._coordinates, self.free.modes.unknowns(self.points)))

    def _coordinates(self, columns: FloatArray) -> FloatArray:
        """Combine columns of modes and residual vectors (n, ...) to coordinates (n, r)."""
        mode_count = len(self.free.modes.eigenvalues)
        residual_end = mode_count + len(self.residual_transform)
        residuals = columns[:, mode_count:residual_end] @ self.residual_transform
        return np.hstack([columns[:, :mode_count], residuals])


@dataclass(frozen=True, eq=False)
class ReducedPlate:
    """The free plate in coordinates with M = I and K = diag(omega²).

    omega: (r,) [rad/s], 0 for rigid-body modes, residual vectors last; losses: (r,) [rad²/s²] in
    addition to the plate's loss factor; at: shapes at points (p, 2) or footprints (p, 3) [m], (p,
    r) [1/sqrt(kg)]; origin: None if only the coordinates are known; dispersion: change of omega²
    with frequency, None without any.
    """

    plate: Plate
    omega: FloatArray
    losses: FloatArray
    at: Callable[[FloatArray], FloatArray]
    origin: ReductionBasis | None = None
    dispersion: Dispersion | None = None

    @cached_property
    def elasticity(self) -> ModalElasticity:
        """Stiffness and loss of the coordinates, constant over frequency."""
        return ModalElasticity.of(self.plate, self.omega**2, self.losses)

    def with_attachments_at(self, points: FloatArray) -> "ReducedPlate":
        """Reduce the same plate for further points of attachment [m] (n, 2).

        Returns itself if its origin is not known: no other shapes are available then.
        """
        if self.origin is None or not len(points):
            return self
        all_points = np.vstack([self.origin.points, as_footprints(points)])
        return reduce_free_plate(self.origin.free, all_points)

    def projection_from(self, other: "ReducedPlate") -> FloatArray:
        """M-orthogonal projection of another reduction's coordinates onto its own, (r, other's r).

        Exact if it has all points of the other. Both must come from the same free plate. If only
        the coordinates of both are known, they are the same ones.
        """
        if self.origin is None and other.origin is None:
            return np.eye(len(self.omega))
        if self.origin is None or other.origin is None:
            raise ValueError("only the coordinates of one of the plates are known")
        free_modes = self.origin.free.modes
        mode_count = len(free_modes.eigenvalues)
        truncated_terms = free_modes.truncated_terms(self.origin.points, other.origin.points)
        residual_mass = _inner_products(truncated_terms, power=1)
        projection = np.zeros((len(self.omega), len(other.omega)))
        projection[:mode_count, :mode_count] = np.eye(mode_count)
        projection[mode_count:, mode_count:] = (
            self.origin.residual_transform.T @ residual_mass @ other.origin.residual_transform
        )
        return projection


def reduce_plate(
    plate: Plate, mesh: PlateMesh, attachments: FloatArray, *, frequency_max: float = 500.0
) -> ReducedPlate:
    """Solve and reduce a plate for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: upper limit of the response.
    """
    free = solve_free_plate(plate, mesh, frequency_max=frequency_max)
    return reduce_free_plate(free, attachments)


def reduce_free_plate(free: FreePlate, attachments: FloatArray) -> ReducedPlate:
    """Reduce a solved free plate for forces at the attachments [m] (n, 2)."""
    modes = free.modes
    attached = as_footprints(attachments)
    truncated_terms = modes.truncated_terms(attached, attached)
    mass = _inner_products(truncated_terms, power=1)
    shifted_stiffness = _inner_products(truncated_terms, power=0)
    orthonormal = _orthonormal(mass)
    shifted, rotation = linalg.eigh(orthonormal.T @ shifted_stiffness @ orthonormal)
    is_physical = shifted > _MIN_SHIFTED
    residual_omega = np.sqrt(shifted[is_physical] / modes.largest_truncated - free.shift)
    count = len(residual_omega)
    basis = ReductionBasis(free, attached, orthonormal @ rotation[:, is_physical])
    dispersion = modes.dispersion
    return ReducedPlate(
        plate=free.plate,
        omega=np.concatenate([np.sqrt(modes.eigenvalues), residual_omega]),
        losses=np.concatenate([modes.losses, np.zeros(count)]),
        at=basis.shapes_at,
        origin=basis,
        dispersion=None if dispersion is None else dispersion.padded(count),
    )


def _orthonormal(mass: FloatArray) -> FloatArray:
    """Return M-orthonormal combinations (n, s) of n vectors with inner products `mass` (n, n)."""
    scale = 1 / np.sqrt(np.diagonal(mass))
    scaled_mass = mass * np.outer(scale, scale)
    squared_norms, vectors = linalg.eigh(scaled_mass)
    is_independent = squared_norms > _DEPENDENT * squared_norms.max(initial=0.0)
    norms = np.sqrt(squared_norms[is_independent])
    return np.asarray(scale[:, None] * vectors[:, is_independent] / norms)


def _inner_products(truncated_terms: FloatArray, *, power: int) -> FloatArray:
    """Inner products of residual vectors with M (power 1) or K + shift M (power 0).

    truncated_terms (TERMS, n, m): see `FreeModes`. Returns (RESIDUAL_VECTORS n, RESIDUAL_VECTORS
    m), term by term.
    """
    order = np.arange(RESIDUAL_VECTORS)
    products = truncated_terms[np.add.outer(order, order) + power].transpose(0, 2, 1, 3)
    rows, columns = truncated_terms.shape[1:]
    return np.asarray(products.reshape(RESIDUAL_VECTORS * rows, RESIDUAL_VECTORS * columns))
