"""The free plate, solved once for all ERAs, fingers and masses that may be attached at points.

Modes of the free plate up to twice the highest frequency come from one factorisation for each
symmetry class; the contribution of the truncated modes (`model.reduction.truncation`) takes a few
more solves with the same factors for each point of attachment, cached. Solutions for points are
then a low-rank correction (`model.structure.attachments`): for each frequency a system as small as
their number, independent of the mesh.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.mesh import Mesh, check_frequencies
from model.reduction.finite_element_modes import FiniteElementModes, finite_element_modes
from model.reduction.spectral_modes import SpectralModes, spectral_modes
from model.reduction.truncation import RESIDUAL_ORDER, PointSolutions, truncation_weights
from model.spectral.mesh import PlateMesh
from model.structure.attachments import (
    Era,
    Load,
    attached_stiffness,
    coupled_forces,
    drive_forces,
    footprints_of,
    on_diagonal,
)
from model.structure.footprint import as_footprints
from model.structure.modal_elasticity import ModalElasticity, loss_factors
from model.structure.plate import Plate

FreeModes: TypeAlias = SpectralModes | FiniteElementModes
"""Modes phi of a free plate up to a cut-off, and all truncated ones together by their sums.

A truncated mode of eigenvalue lambda counts with u = 1 / (lambda + shift), in units of
largest_truncated, u_c, that of the lowest [s²/rad²]. eigenvalues omega² (r,) [rad²/s²], and losses
(r,), their imaginary part beside the plate's own loss factor; dispersion: how they change with
frequency, None where they do not.
"""

_Functions: TypeAlias = Callable[[int], tuple[ComplexArray, ComplexArray]]

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
        eras: Sequence[Era],
        frequencies: FloatArray,
        points: FloatArray,
        *,
        loads: Sequence[Load] = (),
    ) -> ComplexArray:
        """Acceleration [m/s²] at points [m] (p, 2) per frequency [Hz] (f,) and ERA: (f, eras, p).

        As `direct_acceleration`: each ERA alone at full stroke, the others at rest. Raises
        InputError for a frequency that is not above zero, above frequency_max or above what the
        mesh carries, and for points off the plate.
        """
        omega = self._omega(frequencies)
        attached = self.modes.solve_at(footprints_of(eras, loads))
        stiffness = attached_stiffness(eras, loads, omega)
        applied = on_diagonal(drive_forces(eras, omega), rows=stiffness.shape[1])
        between = _between(attached, partial(self._modal_receptance, omega))
        forces = coupled_forces(between, stiffness, applied)
        modal_receptance, weights = self._modal_receptance(omega, RESIDUAL_ORDER)
        modal = modal_receptance[:, :, None] * (attached.shapes.T @ forces)
        residual = (weights[:, :, None, None] * forces[:, None]).reshape(len(omega), -1, len(eras))
        coordinates = np.concatenate([modal, residual], axis=1)
        displacement = _apply(self.modes.basis(attached, points), coordinates)
        return np.asarray(-(omega**2)[:, None, None] * displacement)

    def receptances(
        self,
        places: FloatArray,
        points: FloatArray,
        frequencies: FloatArray,
        *,
        loads: Sequence[Load] = (),
        thickness: float = 1.0,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Receptances [m/N] between places [m] (c, 2), (f, c, c), and to points (p, 2), (f, c, p).

        Of the free plate with its loads, so many times as thick: a thin one, whose stiffness goes
        as the cube of it. Layouts of ERAs at these places are then solved by systems as small as
        their number of ERAs. Raises InputError as `acceleration`.
        """
        omega = self._omega(frequencies)
        attached = self.modes.solve_at(np.vstack([as_footprints(places), footprints_of(loads)]))
        functions = partial(self._modal_receptance, omega, thickness=thickness)
        basis = self.modes.basis(attached, points)
        shapes, residual = np.split(basis, [len(self.modes.eigenvalues)], axis=1)
        by_term = residual.reshape(-1, RESIDUAL_ORDER, len(attached.shapes)).T
        modal, weights = functions(RESIDUAL_ORDER)
        to_points = _apply(shapes, modal[:, :, None] * attached.shapes.T)
        to_points += np.tensordot(weights, by_term, axes=(1, 1))
        between = _between(attached, functions)
        return _loaded(between, to_points, attached_stiffness((), loads, omega))

    @cached_property
    def _elasticity(self) -> ModalElasticity:
        modes = self.modes
        return ModalElasticity.of(self.plate, modes.eigenvalues, modes.losses, modes.dispersion)

    def _modal_receptance(
        self, omega: FloatArray, terms: int, *, thickness: float = 1.0
    ) -> tuple[ComplexArray, ComplexArray]:
        """Receptance of each mode (f, r) [s²], and weights of the truncated ones, (f, terms).

        1 / (h (h² ((1 + i eta) lambda + i loss) - omega²)) for an eigenvalue lambda at modal mass 1
        of the plate h times as thick.
        """
        h = thickness
        loss = (1 + 1j * loss_factors(self.plate, omega))[:, None]
        shifted = np.asarray((omega / h) ** 2 / loss[:, 0] + self.shift, dtype=complex)
        weights = truncation_weights(shifted, self.modes.largest_truncated, terms) / (loss * h**3)
        receptance = 1 / (h * (h**2 * self._elasticity.stiffness(omega) - (omega**2)[:, None]))
        return np.asarray(receptance, dtype=complex), np.asarray(weights, dtype=complex)

    def _omega(self, frequencies: FloatArray) -> FloatArray:
        """omega [rad/s] of frequencies [Hz]; raises InputError for those out of range."""
        frequencies = np.asarray(frequencies, dtype=float)
        check_frequencies(self.plate, self.mesh, frequencies)
        if len(frequencies) and frequencies.max() > self.frequency_max * (1 + 1e-9):
            raise InputError(
                f"frequency must be at most {self.frequency_max:g} Hz, to which the plate was "
                f"solved, got {frequencies.max():g} Hz; solve it with a higher frequency_max"
            )
        return 2 * np.pi * frequencies


def _between(attached: PointSolutions, functions: _Functions) -> ComplexArray:
    """Receptance between attachments, or its derivative, of functions of frequency (f, n, n)."""
    modal, weights = functions(2 * RESIDUAL_ORDER)
    by_modes = (modal[:, None, :] * attached.shapes) @ attached.shapes.T
    return np.asarray(by_modes + np.tensordot(weights, attached.truncated_terms, axes=1))


def _loaded(
    between: ComplexArray, to_points: ComplexArray, stiffness: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Receptances with the last attachments loaded by dynamic stiffnesses (f, l), of the others.

    R - R_pl D (I + R_ll D)^-1 R_lp; places p, loads l, all receptances symmetric.
    """
    n = between.shape[1] - stiffness.shape[1]
    if n == between.shape[1]:
        return between, to_points
    reaction = stiffness[:, :, None] * between[:, n:, :n]
    forces = coupled_forces(between[:, n:, n:], stiffness, reaction).swapaxes(1, 2)
    return (
        between[:, :n, :n] - forces @ between[:, n:, :n],
        to_points[:, :n] - forces @ to_points[:, n:],
    )


def _apply(basis: FloatArray, coordinates: ComplexArray) -> ComplexArray:
    """A real basis (p, r) times complex coordinates (f, r, n): (f, n, p), in one real product."""
    f, r, n = coordinates.shape
    stacked = np.ascontiguousarray(coordinates.transpose(0, 2, 1)).view(float)
    parts = stacked.reshape(f, n, r, 2).transpose(0, 1, 3, 2).reshape(-1, r)
    product = (parts @ basis.T).reshape(f, n, 2, len(basis))
    result = np.empty((f, n, len(basis)), dtype=complex)
    result.real, result.imag = product[:, :, 0], product[:, :, 1]
    return result


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
        modes = finite_element_modes(plate, mesh, shift=shift, cutoff_frequency=cutoff_frequency)
    else:
        modes = spectral_modes(
            plate,
            mesh,
            shift=shift,
            cutoff_frequency=cutoff_frequency,
            frequency_max=frequency_max,
        )
    return FreePlate(plate, mesh, frequency_max, shift, modes)
