"""Modes of the free plate, and its truncated ones at points: on a mesh, or in polynomials.

On a mesh the truncated ones are solved for on demand. All modes of the polynomials of the
deflection are known, so that the sums over the truncated ones are taken as they stand.
"""

import math
from copy import copy
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.fem import (
    DOF_PER_NODE,
    RIGID_BODY_MODES,
    Mesh,
    PlateMatrices,
    assemble,
    factorise,
    lowest_modes,
)
from model.reduction.truncation import RESIDUAL_ORDER
from model.spectral.functions import CLASSES, deflections_by_class
from model.spectral.local_compliance import (
    UnresolvedCompliance,
    compliance_between,
    uncertain_compliance,
    unresolved_at,
)
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import Band, SpectralPlate
from model.structure.footprint import check_on_plate
from model.structure.laminate_section import short_wave_plate
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate

_MAX_CACHED = 4  # sets of points whose residual vectors, or shapes, are kept
_MAX_KEPT_BYTES = 1 << 26  # of residual vectors: those of a map's raster are solved for it alone


class FiniteElementModes:
    """All modes of a free plate on a mesh below a cut-off; see `FreeModes`.

    shift [rad²/s²]: of the factorisation; cutoff_frequency [Hz].
    """

    def __init__(self, plate: Plate, mesh: Mesh, *, shift: float, cutoff_frequency: float) -> None:
        self._matrices = matrices = assemble(plate, mesh)
        self._factor = factorise(matrices.stiffness + shift * matrices.mass)
        cut = (2 * math.pi * cutoff_frequency) ** 2
        count = plate.modes_below(cutoff_frequency) + RIGID_BODY_MODES + 4
        while True:
            count = min(count, mesh.dof)
            eigenvalues, vectors = lowest_modes(
                matrices.stiffness, matrices.mass, count, shift=shift
            )
            if eigenvalues[-1] >= cut or count == mesh.dof:
                break
            count += count // 3 + 1
        eigenvalues[:RIGID_BODY_MODES] = 0.0
        vectors[:, :RIGID_BODY_MODES] = _rigid_modes(matrices)
        products = np.linalg.cholesky(vectors.T @ (matrices.mass @ vectors))  # a solver is 1e-7 off
        vectors = linalg.solve_triangular(products, vectors.T, lower=True).T
        kept = int(np.searchsorted(eigenvalues, cut))
        self.eigenvalues, self._vectors = eigenvalues[:kept], vectors[:, :kept]
        self.losses = np.zeros(kept)
        self.dispersion: Dispersion | None = None
        self.largest_truncated = 1 / (float(eigenvalues[min(kept, len(eigenvalues) - 1)]) + shift)
        self._known: dict[tuple[tuple[int, ...], bytes], FloatArray] = {}

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return np.asarray(self._matrices.deflection_at(points) @ self._vectors)

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2)."""
        own, other = self._residuals(points), self._residuals(others)
        heavy = np.array([self._matrices.mass @ each.T for each in other])
        terms = np.empty((2 * RESIDUAL_ORDER, own.shape[1], other.shape[1]))
        terms[0] = self._matrices.deflection_at(points) @ other[0].T
        for power in range(2, 2 * RESIDUAL_ORDER + 1):
            terms[power - 1] = own[power // 2 - 1] @ heavy[(power + 1) // 2 - 1]
        return terms

    def basis(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Deflection at others of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        (unknowns,) = self.unknowns(points)
        return np.asarray(self._matrices.deflection_at(others) @ unknowns)

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` in degrees of freedom, in one part."""
        residuals = self._residuals(points).reshape(-1, self._matrices.mesh.dof)
        return (np.hstack([self._vectors, residuals.T]),)

    def _residuals(self, points: FloatArray) -> FloatArray:
        """Residual vectors of forces at points or footprints, (RESIDUAL_ORDER, n, dof)."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.shape, points.tobytes()
        known = self._known.get(key)
        if known is None:
            force = self._matrices.deflection_at(points).T.toarray()
            mass, vectors = self._matrices.mass, self._vectors
            known = np.empty((RESIDUAL_ORDER, *force.T.shape))
            for term in known:
                # Modes that are kept would outweigh the others a million times in the solution.
                force -= mass @ (vectors @ (vectors.T @ force))
                found = self._factor.solve(force)
                found -= vectors @ (vectors.T @ (mass @ found))
                term[:] = found.T / self.largest_truncated
                force = mass @ term.T
            if known.nbytes <= _MAX_KEPT_BYTES:
                self._known[key] = known
                if len(self._known) > _MAX_CACHED:
                    self._known.pop(next(iter(self._known)))
        return known


def _rigid_modes(matrices: PlateMatrices) -> FloatArray:
    """Up and down, and both tilts, (dof, 3): a solver's are some mixture of them."""
    nodes, plate = matrices.mesh.nodes, matrices.plate
    modes = np.zeros((len(nodes), DOF_PER_NODE, RIGID_BODY_MODES))
    modes[:, 0, 0] = 1
    modes[:, 0, 1:] = nodes - [plate.length / 2, plate.width / 2]
    modes[:, 1, 1] = modes[:, 2, 2] = 1
    found = modes.reshape(matrices.mesh.dof, RIGID_BODY_MODES)
    return np.asarray(found / np.sqrt((found * (matrices.mass @ found)).sum(axis=0)))


@dataclass(frozen=True, eq=False)
class _PointShapes:
    """At p points: shapes of the modes (p, r) and truncated ones (p, t), unresolved compliance."""

    shapes: FloatArray
    truncated: FloatArray
    unresolved: UnresolvedCompliance


class SpectralModes:
    """All modes of a free plate below a cut-off, by class; see `FreeModes`.

    shift [rad²/s²]: of the order of the lowest modes; cutoff_frequency [Hz]; frequency_max [Hz]: of
    responses.
    """

    def __init__(
        self,
        plate: Plate,
        mesh: SpectralMesh,
        *,
        shift: float,
        cutoff_frequency: float,
        frequency_max: float,
    ) -> None:
        self._plate = plate
        self._mesh = mesh
        band = Band(math.sqrt(shift) / (2 * math.pi), frequency_max)
        spectral = SpectralPlate(plate, (mesh.nx, mesh.ny), band.middle)
        cut = (2 * math.pi * cutoff_frequency) ** 2
        self._classes = classes = tuple(
            spectral.modes(each, shift=shift, cut=cut, band=band) for each in CLASSES
        )
        # The homogeneous plate that yields under a force in waves that the mesh does not resolve.
        shortest = 2 * math.pi / mesh.shortest_wavelength
        self._local_plate = short_wave_plate(plate, shortest, band.middle)
        self.eigenvalues = np.concatenate([part.eigenvalues for part in classes])
        self.losses = np.concatenate([part.losses for part in classes])
        dispersion = np.hstack([part.dispersion for part in classes])
        self.dispersion = Dispersion(band.frequencies, dispersion) if dispersion.any() else None
        u = 1 / (np.concatenate([part.truncated for part in classes]) + shift)
        self.largest_truncated = float(u.max())
        # u / u_c of each truncated mode to the powers 1, 2, ...
        self._powers = (u / u.max()) ** np.arange(1, 2 * RESIDUAL_ORDER + 1)[:, None]
        # By shape and content, of which either alone may be those of others.
        self._known: dict[tuple[tuple[int, ...], bytes], _PointShapes] = {}
        self._is_softer = False

    def softer(self) -> "SpectralModes":
        """The plate as soft under every force as its polynomials leave possible."""
        found = copy(self)
        found._is_softer = True
        return found

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._observe(points).shapes

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and others (m, 2)."""
        own, other = self._observe(points), self._observe(others)
        terms = (own.truncated * self._powers[:, None]) @ other.truncated.T
        terms[0] += self._local(own, other)
        return np.asarray(terms)

    def basis(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Deflection at others of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        own, at = self._observe(points), self._observe(others)
        extra = self._residuals(own) @ at.truncated.T
        extra[: len(own.shapes)] += self._local(own, at)
        return np.hstack([at.shapes, extra.T])

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` by symmetry class, without the local compliance."""
        count, mode, rest, found = len(self.eigenvalues), 0, 0, []
        residuals = self._residuals(self._observe(points))
        for part in self._classes:
            modes, rests = len(part.eigenvalues), len(part.truncated)
            own = np.zeros((len(part.shapes), count + len(residuals)))
            own[:, mode : mode + modes] = part.shapes[:, :modes]
            own[:, count:] = part.shapes[:, modes:] @ residuals[:, rest : rest + rests].T
            found.append(own)
            mode, rest = mode + modes, rest + rests
        return tuple(found)

    def _residuals(self, at: _PointShapes) -> FloatArray:
        """Residual vectors in truncated modes, term by term, (RESIDUAL_ORDER n, t)."""
        return np.concatenate(at.truncated * self._powers[:RESIDUAL_ORDER, None])

    def _local(self, own: _PointShapes, other: _PointShapes) -> FloatArray:
        """Compliance in waves that the polynomials do not resolve, in units of u_c."""
        places = self._local_plate, own.unresolved, other.unresolved
        missing = compliance_between(*places)
        if self._is_softer:
            missing = missing + uncertain_compliance(*places)
        return missing / self.largest_truncated

    def _observe(self, points: FloatArray) -> _PointShapes:
        """What is known of points or footprints on the plate, cached."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        key = points.shape, points.tobytes()
        if key not in self._known:
            check_on_plate(points, length=self._mesh.length, width=self._mesh.width)
            if len(self._known) >= _MAX_CACHED:
                self._known.pop(next(iter(self._known)))
            degrees = (self._mesh.nx, self._mesh.ny)
            bases = deflections_by_class((self._plate.length, self._plate.width), degrees, points)
            found = [
                np.split(own @ part.shapes, [len(part.eigenvalues)], axis=1)
                for own, part in zip(bases, self._classes, strict=True)
            ]
            shapes, truncated = (np.hstack(each) for each in zip(*found, strict=True))
            unresolved = unresolved_at(self._local_plate, degrees, points)
            self._known[key] = _PointShapes(shapes, truncated, unresolved)
        return self._known[key]


FreeModes: TypeAlias = SpectralModes | FiniteElementModes
"""Modes phi of a free plate up to a cut-off, and all truncated ones together by their sums.

A truncated mode of eigenvalue lambda counts with u = 1 / (lambda + shift), in units of
largest_truncated, u_c, that of the lowest [s²/rad²]. eigenvalues omega² (r,) [rad²/s²], and losses
(r,), their imaginary part beside the plate's own loss factor; dispersion: how they change with
frequency, None where they do not. Between points (n, 2) and others (m, 2), or footprints (n, 3):

- shapes_at(points): of the modes, (n, r);
- truncated_terms(points, others): sums of phi phi' (u / u_c)^j over the truncated modes, j = 1, 2,
  ..., (TERMS, n, m);
- basis(points, others): deflection at others of modes and of the RESIDUAL_ORDER residual vectors of
  forces at the points, term by term, (m, r + RESIDUAL_ORDER n); unknowns(points): its columns in
  the unknowns of the plate, by symmetry class.
"""
