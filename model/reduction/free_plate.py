"""The free plate, solved once for all ERAs, fingers and masses that may be attached at points.

Modes of the free plate up to twice the highest frequency come from one factorisation for each
symmetry class; the contribution of the truncated modes (`model.reduction.truncation`) takes a few
more solves with the same factors for each point of attachment, cached. Solutions for points are
then a low-rank correction (`model.structure.attachments`): for each frequency a system as small as
their number, independent of the mesh.

Receptance. Modes and truncated modes of one solution serve for every modulus, thickness and loss
factor: with q = (1 + i eta) E h² / (E h²)_solved and modal masses that grow as h,

    h A = sum phi phi' g + sum T_j c_j,   g = 1 / (q lambda - w²),   c = weights(z + shift) / q,

z = w² / q, T_j the sums over the truncated modes. By q it changes as

    h dA / d ln q = sum phi phi' (-q lambda g²) + sum T_j (-(c + z dc / dz) / q).

All stiffness of a plate is taken as E h³ and all its mass as h (`model.structure.plate.SCALED`); a
plate with other parts is refused (`check_scales`). That is exact for a thin plate; by shear,
rotary inertia and the layer at its edges the response of the paper's plate then differs by 0.1 %
for 2 % of thickness, and 0.3 % for 5 %.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem import Mesh
from model.reduction.free_modes import FiniteElementModes, FreeModes, SpectralModes
from model.reduction.truncation import RESIDUAL_ORDER, truncation_slopes, truncation_weights
from model.spectral.mesh import PlateMesh
from model.structure.attachments import (
    Source,
    Support,
    attached_stiffness,
    coupled_forces,
    footprints_of,
    unit_accelerations,
)
from model.structure.footprint import as_footprints
from model.structure.modal_elasticity import (
    ModalElasticity,
    check_scales,
    loss_factors,
    modal_receptance,
)
from model.structure.plate import Plate

TERMS = 2 * RESIDUAL_ORDER
"""Truncated sums of a receptance between points."""


def between(modes: FreeModes, points: FloatArray, others: FloatArray) -> FloatArray:
    """Products of shapes at points and others [m], then truncated sums, (r + TERMS, n, m).

    Points (n, 2) or footprints (n, 3).
    """
    shapes, other_shapes = modes.shapes_at(points), modes.shapes_at(others)
    kept = shapes.T[:, :, None] * other_shapes.T[:, None]
    return np.concatenate([kept, modes.truncated_terms(points, others)])


def combined(functions: ComplexArray, products: FloatArray) -> ComplexArray:
    """Sum over r of complex functions (..., r) times real products (r, ...), (..., ...)."""
    flat, rows = functions.reshape(-1, len(products)), products.reshape(len(products), -1)
    found = np.empty((len(flat), rows.shape[1]), dtype=complex)
    found.real, found.imag = np.split(np.concatenate([flat.real, flat.imag]) @ rows, 2)
    return found.reshape(*functions.shape[:-1], *products.shape[1:])


@dataclass(frozen=True, eq=False)
class FreeReceptance:
    """What multiplies shapes and sums at frequencies (f,), for plates of some stiffness and mass.

    omega (f,) [rad/s]; with any number of cases in front of them: thickness (...), relative to that
    solved, q (..., f): see above, elastic (..., f, r): E lambda of each mode [rad²/s²] relative to
    the modulus solved, losses included; shift, largest: of the truncated sums.
    """

    omega: FloatArray
    thickness: FloatArray | float
    q: ComplexArray
    elastic: ComplexArray
    shift: float
    largest: float

    @cached_property
    def values(self) -> ComplexArray:
        """Of modes and of truncated sums, (..., f, r + TERMS) [s²/kg]."""
        return np.concatenate([self.modal, self.truncated(TERMS)], axis=-1)

    @cached_property
    def modal(self) -> ComplexArray:
        """Of each mode, (..., f, r) [s²/kg]."""
        return modal_receptance(self.elastic, self.omega, self.thickness)

    def truncated(self, terms: int) -> ComplexArray:
        """Of the first truncated sums, (..., f, terms) [s²/kg]."""
        weights = truncation_weights(self._shifted, self.largest, terms)
        return np.asarray(weights / self._scale)

    @cached_property
    def truncated_by_log_q(self) -> ComplexArray:
        """Derivative of the truncated sums by ln q, (..., f, TERMS)."""
        weights = truncation_weights(self._shifted, self.largest, TERMS)
        slopes = truncation_slopes(self._shifted, self.largest, TERMS)
        z = (self.omega**2 / self.q)[..., None]
        return np.asarray(-(weights + z * slopes) / self._scale)

    @property
    def _shifted(self) -> ComplexArray:
        return np.asarray(self.omega**2 / self.q + self.shift)

    @property
    def _scale(self) -> ComplexArray:
        return np.asarray(self.q[..., None] * np.asarray(self.thickness)[..., None, None])


FREQUENCY_MARGIN = 2.0
"""Modes are kept up to this multiple of frequency_max."""


@dataclass(frozen=True, eq=False)
class FreePlate:
    """Modes and factors of one plate on one mesh; see `solve_free_plate`.

    frequency_max [Hz]: upper limit of the response; shift [rad²/s²]: of the factorisations.
    """

    plate: Plate
    mesh: PlateMesh
    frequency_max: float
    shift: float
    modes: FreeModes

    def acceleration(
        self,
        sources: Sequence[Source],
        frequencies: FloatArray,
        points: FloatArray,
        *,
        loads: Sequence[Support] = (),
    ) -> ComplexArray:
        """Acceleration [m/s²] at points [m] (p, 2) per frequency [Hz] (f,) and source: (f, n, p).

        Each alone at full level and phase zero, the others at rest. Raises InputError for a
        frequency that is not above zero, above frequency_max or above what the mesh carries, and
        for points off the plate.
        """
        omega = self._omega(frequencies)
        at = footprints_of(sources, loads)
        return unit_accelerations(
            sources,
            loads,
            omega,
            lambda held, driven: self._moved(omega, at, held, driven, points)[1],
        )

    def receptances(
        self,
        places: FloatArray,
        points: FloatArray,
        frequencies: FloatArray,
        *,
        loads: Sequence[Support] = (),
        thickness: FloatArray | float = 1.0,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Receptances [m/N] between places (..., f, c, c), and from them to points (..., f, c, p).

        places (c, 2) or footprints (c, 3), points (p, 2) [m]; of the free plate with its loads, and
        of plates so many times as thick (...). Layouts of ERAs at these places are then solved by
        systems as small as their number of ERAs. Raises InputError as `acceleration`.
        """
        omega, count = self._omega(frequencies), len(places)
        footprints = np.vstack([as_footprints(places), footprints_of(loads)])
        stiffness = np.pad(attached_stiffness(omega, loads), ((0, 0), (count, 0)))
        applied = np.eye(len(footprints), count, dtype=complex)
        to_places, to_points = self._moved(
            omega, footprints, stiffness, applied, points, thickness=np.asarray(thickness)
        )
        return to_places[..., :count, :], to_points

    def _moved(
        self,
        omega: FloatArray,
        footprints: FloatArray,
        stiffness: ComplexArray,
        applied: ComplexArray,
        points: FloatArray,
        *,
        thickness: FloatArray | float = 1.0,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Displacement of attachments (..., f, a, m) and at points (..., f, m, p) by forces there.

        footprints (a, 3) with dynamic stiffnesses (f, a), the forces applied to them ([f,] a, m).
        """
        eta, lossy = loss_factors(self.plate, omega), self._elasticity.stiffness(omega)
        functions = self.receptance(omega, lossy, eta, thickness)
        receptance = combined(functions.values, between(self.modes, footprints, footprints))
        forces = coupled_forces(receptance, stiffness, applied)
        # At points terms of residual vectors suffice, and only few are products of many points.
        modal = functions.modal[..., None] * (self.modes.shapes_at(footprints).T @ forces)
        terms = functions.truncated(RESIDUAL_ORDER)[..., None, None] * forces[..., None, :, :]
        residual = terms.reshape(*terms.shape[:-3], -1, terms.shape[-1])
        basis = self.modes.basis(footprints, points)
        coordinates = np.concatenate([modal, residual], axis=-2).swapaxes(-1, -2)
        return np.asarray(receptance @ forces), combined(coordinates, np.ascontiguousarray(basis.T))

    def receptance(
        self,
        omega: FloatArray,
        stiffness: ComplexArray,
        loss_factor: FloatArray,
        thickness: FloatArray | float = 1.0,
        modulus: float = 1.0,
    ) -> FreeReceptance:
        """Functions of frequency of plates so many times as thick (...), and of another modulus.

        stiffness (f, r): of modes [rad²/s²] at omega (f,) at that modulus, losses included;
        loss_factor (f,): of truncated ones. Raises InputError for a plate that does not scale so.
        """
        check_scales(self.plate, thickness, modulus, remedy="solve that plate")
        square = np.asarray(thickness)[..., None] ** 2
        q = np.asarray((1 + 1j * loss_factor) * modulus * square, dtype=complex)
        return FreeReceptance(
            omega, thickness, q, stiffness, self.shift, self.modes.largest_truncated
        )

    @cached_property
    def _elasticity(self) -> ModalElasticity:
        modes = self.modes
        return ModalElasticity.of(self.plate, modes.eigenvalues, modes.losses, modes.dispersion)

    def _omega(self, frequencies: FloatArray) -> FloatArray:
        """omega [rad/s] of frequencies [Hz]; raises InputError for those out of range."""
        frequencies = np.asarray(frequencies, dtype=float)
        self.mesh.check_frequencies(self.plate, frequencies)
        if len(frequencies) and frequencies.max() > self.frequency_max * (1 + 1e-9):
            raise InputError(
                f"frequency must be at most {self.frequency_max:g} Hz, to which the plate was "
                f"solved, got {frequencies.max():g} Hz; raise limits.frequency of the rig"
            )
        return 2 * np.pi * frequencies


def solve_free_plate(plate: Plate, mesh: PlateMesh, *, frequency_max: float = 500.0) -> FreePlate:
    """Solve the free plate on a mesh, for responses up to a frequency [Hz].

    Raises InputError for finite elements of a plate that they do not model.
    """
    if not (math.isfinite(frequency_max) and frequency_max > 0):
        raise InputError(f"frequency_max must be above zero, got {frequency_max} Hz")
    # Above zero, since K alone is singular, and well below the truncated modes, whose sum converges
    # more slowly for a larger shift.
    shift = (2 * math.pi * min(plate.lowest_bending_frequency, frequency_max / 3)) ** 2
    cutoff_frequency = FREQUENCY_MARGIN * frequency_max
    modes: FreeModes
    if isinstance(mesh, Mesh):
        modes = FiniteElementModes(plate, mesh, shift=shift, cutoff_frequency=cutoff_frequency)
    else:
        modes = SpectralModes(
            plate,
            mesh,
            shift=shift,
            cutoff_frequency=cutoff_frequency,
            frequency_max=frequency_max,
        )
    return FreePlate(plate, mesh, frequency_max, shift, modes)
