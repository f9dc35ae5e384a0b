"""Modes of a free plate in polynomials, by symmetry class; all modes of the deflection are known.

The truncated modes are summed directly. Waves that the polynomials do not resolve add a local
compliance (`model.spectral.unresolved_compliance`).
"""

import math
from copy import copy
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.reduction.point_cache import PointCache
from model.reduction.surface_modes import RESIDUAL_ORDER
from model.spectral.modes import MaterialBand, SpectralPlate
from model.spectral.plate_mesh import SpectralMesh
from model.spectral.polynomials import CLASSES, deflections_by_class
from model.spectral.unresolved_compliance import UnresolvedCompliance, unresolved_at
from model.structure.footprints import check_footprints_on_plate
from model.structure.laminate_bending import short_wave_plate
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import Plate

_MAX_CACHED = 4  # sets of points whose shapes are kept


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
        band = MaterialBand(math.sqrt(shift) / (2 * math.pi), frequency_max)
        spectral = SpectralPlate(plate, (mesh.nx, mesh.ny), band.middle)
        cut = (2 * math.pi * cutoff_frequency) ** 2
        self._classes = classes = tuple(
            spectral.modes(parity, shift=shift, cut=cut, band=band) for parity in CLASSES
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
        self._cache = PointCache[_PointShapes](_MAX_CACHED)
        self._is_softer = False

    def alternatives(self) -> list["SpectralModes"]:
        """The plate as soft under every force as its polynomials leave possible."""
        softer = copy(self)
        softer._is_softer = True
        return [softer]

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2) or footprints (p, 3), (p, r)."""
        return self._observe(points).shapes

    def truncated_terms(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Sums between points (n, 2) and receivers (m, 2)."""
        shapes = self._observe(points)
        receiver_shapes = self._observe(receivers)
        terms = (shapes.truncated * self._powers[:, None]) @ receiver_shapes.truncated.T
        terms[0] += self._local(shapes, receiver_shapes)
        return np.asarray(terms)

    def basis(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Deflection at receivers of modes and residual vectors, (m, r + RESIDUAL_ORDER n)."""
        shapes = self._observe(points)
        receiver_shapes = self._observe(receivers)
        residuals = self._residuals(shapes) @ receiver_shapes.truncated.T
        residuals[: len(shapes.shapes)] += self._local(shapes, receiver_shapes)
        return np.hstack([receiver_shapes.shapes, residuals.T])

    def unknowns(self, points: FloatArray) -> tuple[FloatArray, ...]:
        """The columns of `basis` by symmetry class, without the local compliance."""
        count = len(self.eigenvalues)
        residuals = self._residuals(self._observe(points))
        first_mode = 0
        first_truncated = 0
        columns = list[FloatArray]()
        for part in self._classes:
            mode_count = len(part.eigenvalues)
            modes = slice(first_mode, first_mode + mode_count)
            truncated = slice(first_truncated, first_truncated + len(part.truncated))
            of_class = np.zeros((len(part.shapes), count + len(residuals)))
            of_class[:, modes] = part.shapes[:, :mode_count]
            of_class[:, count:] = part.shapes[:, mode_count:] @ residuals[:, truncated].T
            columns.append(of_class)
            first_mode = modes.stop
            first_truncated = truncated.stop
        return tuple(columns)

    def _residuals(self, at: _PointShapes) -> FloatArray:
        """Residual vectors in truncated modes, term by term, (RESIDUAL_ORDER n, t)."""
        return np.concatenate(at.truncated * self._powers[:RESIDUAL_ORDER, None])

    def _local(self, sources: _PointShapes, receivers: _PointShapes) -> FloatArray:
        """Compliance in waves that the polynomials do not resolve, in units of u_c."""
        missing = sources.unresolved.shared_with(receivers.unresolved)
        if self._is_softer:
            missing = missing + sources.unresolved.uncertainty(receivers.unresolved)
        return missing / self.largest_truncated

    def _observe(self, points: FloatArray) -> _PointShapes:
        """Return the cached shapes at points or footprints on the plate."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        point_shapes = self._cache.get(points)
        if point_shapes is None:
            check_footprints_on_plate(points, length=self._mesh.length, width=self._mesh.width)
            degrees = (self._mesh.nx, self._mesh.ny)
            bases = deflections_by_class((self._plate.length, self._plate.width), degrees, points)
            shapes = list[FloatArray]()
            truncated = list[FloatArray]()
            for basis, part in zip(bases, self._classes, strict=True):
                class_shapes = basis @ part.shapes
                mode_count = len(part.eigenvalues)
                shapes.append(class_shapes[:, :mode_count])
                truncated.append(class_shapes[:, mode_count:])
            point_shapes = _PointShapes(
                shapes=np.hstack(shapes),
                truncated=np.hstack(truncated),
                unresolved=unresolved_at(self._local_plate, degrees, points),
            )
            self._cache.put(points, point_shapes)
        return point_shapes
