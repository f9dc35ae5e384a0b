"""Free plate, solved once for all ERAs, fingers and masses that can be attached at points.

Modes of the free plate up to twice the highest frequency come from one factorization for each
symmetry class; the contribution of the truncated modes takes a few more solves with the same
factors for each point of attachment, cached. On a mesh of elements these are solved for on demand;
with polynomials all modes of the deflection are known, and the truncated ones are summed directly.
Solutions for points are then a low-rank correction (`model.structure.attachments`): per frequency,
a system with as many unknowns as points, independent of the mesh.

Receptance. Modes and truncated modes of a solution are valid for any modulus, thickness and loss
factor: with q = (1 + i eta) E h² / (E h²)_solved, z = w² / q and modal masses that grow as h,

    h A = sum phi phi' g + sum T_j c_j,   g = 1 / (q lambda - w²),   c = weights(z + shift) / q,

where T_j are the sums over the truncated modes. By q it changes as

    h dA / d ln q = sum phi phi' (-q lambda g²) + sum T_j (-(c + z dc / dz) / q).

All stiffness of a plate is assumed to scale with E h³ and all its mass with h (see the fields of
`model.structure.plate.Plate`); a plate with other parts is rejected (`check_scales`). This is exact
for a thin plate. Shear, rotary inertia and the edge layers change the response of the paper's plate
by 0.1 % for 2 % of thickness, and by 0.3 % for 5 %.

Truncated modes. A mode with eigenvalue lambda has the receptance 1 / (q (lambda - z)). A static
solve with the shift sigma gives u = 1 / (lambda + sigma) instead, two solves u², and so on. All
truncated modes have u within (0, u_c], where u_c belongs to the lowest. So u / (1 - s u), s = z +
sigma, is approximated on that interval by a polynomial in u without constant term. The optimum
follows from Chebyshev's; its relative error for each mode is

    T_k(t(u)) / T_k(t(1 / s)),    t(u) = 2 u / u_c - 1,

exactly. A Taylor series, the usual residual flexibility with its higher terms, gains a factor of 1
/ |s u_c| with each term; this polynomial about four times as much."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
from numpy.polynomial import chebyshev

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem import Mesh
from model.reduction.element_modes import FiniteElementModes
from model.reduction.spectral_modes import SpectralModes
from model.reduction.surface_modes import RESIDUAL_ORDER, SurfaceModes
from model.spectral.plate_mesh import KnownModes, PlateMesh, SpectralMesh
from model.structure.attachments import (
    Attachment,
    attached_stiffness,
    coupled_forces,
    footprints_of,
)
from model.structure.footprints import as_footprints
from model.structure.modal_elasticity import (
    ModalElasticity,
    check_scales,
    loss_factors,
    modal_receptance,
)
from model.structure.plate import Plate
from model.structure.sources import Source, unit_accelerations


def truncation_weights(
    shifted_eigenvalue: ComplexArray, largest: float, terms: int
) -> ComplexArray:
    """Coefficients c with sum_j c_j (u / u_c)^j near u / (1 - s u) on (0, u_c], (..., terms).

    shifted_eigenvalue: s (...) [rad²/s²], |s u_c| below 1; largest: u_c. Weights have its unit.
    """
    v, inverse = _interpolation(terms)
    exact = 1 / (1 - largest * shifted_eigenvalue[..., None] * v)
    return largest * exact @ inverse.T


def truncation_slopes(shifted_eigenvalue: ComplexArray, largest: float, terms: int) -> ComplexArray:
    """Derivatives of `truncation_weights` by s, (..., terms)."""
    v, inverse = _interpolation(terms)
    exact = 1 / (1 - largest * shifted_eigenvalue[..., None] * v)
    return largest**2 * (v * exact**2) @ inverse.T


@lru_cache(maxsize=16)
def _interpolation(terms: int) -> tuple[FloatArray, FloatArray]:
    """Zeros of T_k, where the approximation is exact, and the inverse of their Vandermonde matrix.

    u / (1 - s u) / u is interpolated there.
    """
    v = (chebyshev.chebpts1(terms) + 1) / 2
    return v, np.asarray(np.linalg.inv(np.vander(v, terms, increasing=True)))


FreeModes: TypeAlias = SpectralModes | FiniteElementModes | SurfaceModes
"""Modes phi of a free plate up to a cut-off, and the sums over all truncated modes.

A truncated mode with eigenvalue lambda is represented by u = 1 / (lambda + shift), in units of
largest_truncated, u_c, the value of the lowest one [s²/rad²]. eigenvalues omega² (r,) [rad²/s²],
and losses (r,), their imaginary part in addition to the plate's loss factor; dispersion: their
change with frequency, None without any. Between points of forces (n, 2) and receivers (m, 2), or
footprints (n, 3):

- shapes_at(points): of the modes, (n, r);
- truncated_terms(points, receivers): sums of phi phi' (u / u_c)^j over the truncated modes, j = 1,
  2, ..., (TERMS, n, m);
- alternatives(), not of elements: modes of equally likely plates, which show the uncertainty of
  fields;
- basis(points, receivers): deflection at receivers of modes and of the RESIDUAL_ORDER residual
  vectors of forces at the points, term by term, (m, r + RESIDUAL_ORDER n); unknowns(points): its
  columns in the unknowns of the plate, by symmetry class.
"""

TERMS = 2 * RESIDUAL_ORDER
"""Truncated sums of a receptance between points."""


def _between(modes: FreeModes, points: FloatArray, receivers: FloatArray) -> FloatArray:
    """Products of shapes at points and receivers [m], then truncated sums, (r + TERMS, n, m).

    Points (n, 2) or footprints (n, 3).
    """
    shapes, receiver_shapes = modes.shapes_at(points), modes.shapes_at(receivers)
    kept = shapes.T[:, :, None] * receiver_shapes.T[:, None]
    return np.concatenate([kept, modes.truncated_terms(points, receivers)])


def combined(functions: ComplexArray, products: FloatArray) -> ComplexArray:
    """Sum over r of complex functions (..., r) times real products (r, ...), (..., ...)."""
    flat = functions.reshape(-1, len(products))
    rows = products.reshape(len(products), -1)
    sums = np.empty((len(flat), rows.shape[1]), dtype=complex)
    sums.real, sums.imag = np.split(np.concatenate([flat.real, flat.imag]) @ rows, 2)
    return sums.reshape(*functions.shape[:-1], *products.shape[1:])


@dataclass(frozen=True, eq=False)
class FreeReceptance:
    """Factors of shapes and sums at frequencies (f,), for plates of a given stiffness and mass.

    omega (f,) [rad/s]. For any number of cases (leading axes): thickness (...), relative to the
    solved thickness, q (..., f): see above, elastic (..., f, r): E lambda of each mode [rad²/s²]
    relative to the solved modulus, losses included; shift, largest: of the truncated sums.
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
        return weights / self._scale

    @cached_property
    def truncated_by_log_q(self) -> ComplexArray:
        """Derivative of the truncated sums by ln q, (..., f, TERMS)."""
        weights = truncation_weights(self._shifted, self.largest, TERMS)
        slopes = truncation_slopes(self._shifted, self.largest, TERMS)
        z = (self.omega**2 / self.q)[..., None]
        return -(weights + z * slopes) / self._scale

    @property
    def _shifted(self) -> ComplexArray:
        return self.omega**2 / self.q + self.shift

    @property
    def _scale(self) -> ComplexArray:
        return np.asarray(self.q[..., None] * np.asarray(self.thickness)[..., None, None])


FREQUENCY_MARGIN = 2.0
"""Modes are kept up to this multiple of frequency_max."""


@dataclass(frozen=True, eq=False)
class FreePlate:
    """Modes and factors of a plate on a mesh; see `solve_free_plate`.

    frequency_max [Hz]: upper limit of the response; shift [rad²/s²]: of the factorizations.
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
        loads: Sequence[Attachment] = (),
    ) -> ComplexArray:
        """Acceleration [m/s²] at points [m] (p, 2) per frequency [Hz] (f,) and source: (f, n, p).

        Each alone at full level and phase zero, the others at rest. Raises InputError for a
        frequency that is not positive, or above frequency_max or the mesh's limit, and for points
        off the plate.
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
        loads: Sequence[Attachment] = (),
        thickness: FloatArray | float = 1.0,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Receptances [m/N] between places (..., f, c, c), and from them to points (..., f, c, p).

        places (c, 2) or footprints (c, 3), points (p, 2) [m]; of the free plate with its loads, and
        of plates so many times as thick (...). Layouts of ERAs at these places are then solved by
        systems as small as their number of ERAs. Raises InputError as `acceleration`, and for a
        plate so thin that its truncated modes begin below a frequency.
        """
        omega, count = self._omega(frequencies), len(places)
        self._check_truncated_modes(omega, thickness)
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
        receptance = combined(functions.values, _between(self.modes, footprints, footprints))
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

    def _check_truncated_modes(self, omega: FloatArray, thickness: FloatArray | float) -> None:
        """Raise InputError if truncated modes of a plate so many times as thick begin below omega.

        The frequencies of modes are proportional to the thickness.
        """
        lowest_truncated = 1 / self.modes.largest_truncated - self.shift
        thinnest = np.min(thickness)
        limit = omega.max(initial=0.0) / math.sqrt(lowest_truncated)
        if not thinnest > limit:
            raise InputError(
                f"thickness must be above {limit:.3g} times the solved thickness at "
                f"{omega.max() / (2 * math.pi):g} Hz, got {thinnest:g}; solve that plate"
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
    if plate.surface is not None:
        KnownModes.of(plate, plate.surface).check_frequencies(plate, np.array([frequency_max]))
        modes = SurfaceModes(
            plate,
            plate.surface,
            shift=shift,
            cutoff_frequency=cutoff_frequency,
            frequency_max=frequency_max,
        )
    elif isinstance(mesh, Mesh):
        modes = FiniteElementModes(plate, mesh, shift=shift, cutoff_frequency=cutoff_frequency)
    else:
        assert isinstance(mesh, SpectralMesh)  # noqa: S101  other meshes are of surfaces
        modes = SpectralModes(
            plate,
            mesh,
            shift=shift,
            cutoff_frequency=cutoff_frequency,
            frequency_max=frequency_max,
        )
    return FreePlate(plate, mesh, frequency_max, shift, modes)
