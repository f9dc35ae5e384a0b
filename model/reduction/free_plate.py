"""The free plate, solved once, answering for everything that is attached to it at points.

Modes of the free plate up to twice the highest frequency, found in each symmetry class by one
factorisation; what the truncated modes add (`model.reduction.truncation`) takes a few more solves
with the same factors for each point that a force acts at, done when a point is first asked for and
kept. ERAs, bolts, point masses and fingers are then a correction of low rank (Woodbury identity): a
solve as small as their number for each frequency, whatever the mesh.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.assembly import element_matrices, era_positions
from model.fem.harmonic import check_frequencies, hold_and_drive
from model.fem.mesh import Mesh
from model.fem.symmetry import CLASSES, symmetry_class
from model.reduction.attachments import TERMS, Attachments, AttachmentSolver
from model.reduction.class_modes import ClassModes, solve_class
from model.reduction.truncation import truncation_error, truncation_weights
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import PointLoad, load_positions

# Modes are kept up to this multiple of the highest frequency asked for.
FREQUENCY_MARGIN = 2.0


@dataclass(frozen=True)
class Response:
    """Acceleration [m/s²] per frequency, driven ERA and point (f, eras, p), and how wrong it is.

    error: (f, eras), an upper estimate of the error relative to the response, both root mean
    square over the plate; against the exact answer of the same mesh, not of a finer one.
    """

    acceleration: ComplexArray
    error: FloatArray


@dataclass(frozen=True, eq=False)
class FreePlate:
    """Modes and factors of one plate on one mesh; see `solve_free_plate`.

    frequency_max [Hz]: up to where it answers; shift [rad²/s²]: of the factors.
    """

    plate: Plate
    mesh: Mesh
    frequency_max: float
    shift: float
    classes: tuple[ClassModes, ...]

    @property
    def squared(self) -> FloatArray:
        """omega² of the modes (r,) [rad²/s²], class by class; the first of a class may be 0."""
        return np.concatenate([part.squared for part in self.classes])

    @cached_property
    def attachments(self) -> AttachmentSolver:
        """What has been solved for the points where forces act."""
        return AttachmentSolver(self.mesh, self.classes, scale=self.largest_truncated)

    @property
    def largest_truncated(self) -> float:
        """1 / (lambda + shift) of the lowest mode left out [s²/rad²]."""
        return 1 / (min(part.next_squared for part in self.classes) + self.shift)

    def acceleration(
        self,
        eras: Sequence[Era],
        frequencies: FloatArray,
        points: FloatArray,
        *,
        loads: Sequence[PointLoad] = (),
    ) -> ComplexArray:
        """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and ERA: (f, eras, p).

        As `direct_acceleration`: each ERA alone at full stroke, the others holding.
        """
        return self.respond(eras, frequencies, points, loads=loads).acceleration

    def respond(
        self,
        eras: Sequence[Era],
        frequencies: FloatArray,
        points: FloatArray,
        *,
        loads: Sequence[PointLoad] = (),
    ) -> Response:
        """The same with its error, per frequency (f,) [Hz], at any points [m] (p, 2) of the plate.

        Raises InputError for a frequency that is none, above frequency_max or above what the mesh
        carries, and for points off the plate.
        """
        omega = self._omega(frequencies)
        hold, drive = hold_and_drive(eras, loads, omega)
        attached = self.attachments.solve(np.vstack([era_positions(eras), load_positions(loads)]))
        count = len(hold[0])
        answers, weights = self._answers(omega, TERMS)

        # Forces on the plate for a unit force put in at each attachment, all of them holding back.
        receptance = self._between(attached, omega)
        unit = np.linalg.inv(np.eye(count) + hold[:, :, None] * receptance)
        modal = np.asarray(answers[:, :, None] * (attached.shapes.T @ unit), dtype=complex)
        residual = np.asarray(weights[:, :, None, None] * unit[:, None], dtype=complex)
        coordinates = np.concatenate([modal, residual.reshape(len(omega), -1, count)], axis=1)
        driven = coordinates[:, :, : len(eras)] * drive[:, None, :]
        displacement = _apply(self.attachments.basis(attached, points), driven)
        acceleration = -(omega**2)[:, None, None] * displacement

        size = _field_size(modal, residual, attached.moments)
        off_receptance, off_field = (self._truncation_error(omega, n) for n in (2 * TERMS, TERMS))
        strength, spread = (np.sqrt(np.diagonal(attached.moments[power])) for power in (0, 1))
        force = np.abs(unit)
        wrong_force = np.abs(hold) * off_receptance[:, None] * strength * size
        error = wrong_force.sum(axis=1)[:, None] * (strength[:, None] * force).sum(axis=1)
        error += off_field[:, None] * (spread[:, None] * force).sum(axis=1)
        return Response(acceleration, (error / size)[:, : len(eras)])

    def receptances(
        self,
        places: FloatArray,
        points: FloatArray,
        frequencies: FloatArray,
        *,
        loads: Sequence[PointLoad] = (),
    ) -> tuple[ComplexArray, ComplexArray]:
        """Receptances [m/N] between places [m] (c, 2), (f, c, c), and to points (p, 2), (f, c, p).

        Of the free plate under its loads: what a study of many layouts of ERAs at these places
        needs, each of them then being a solve as small as its number of ERAs. Raises InputError as
        `respond` does.
        """
        omega = self._omega(frequencies)
        attached = self.attachments.solve(np.vstack([places, load_positions(loads)]))
        count = len(attached.shapes)
        answers, weights = self._answers(omega, TERMS)
        basis = self.attachments.basis(attached, points)
        shapes, residual = np.split(basis, [len(self.squared)], axis=1)
        to_points = _apply(shapes, answers[:, :, None] * attached.shapes.T)
        to_points += np.tensordot(weights, residual.reshape(-1, TERMS, count).T, axes=(1, 1))
        between = self._between(attached, omega)
        if loads:
            hold, _ = hold_and_drive((), loads, omega)
            at_loads = between[:, len(places) :, len(places) :]
            back = np.linalg.inv(np.eye(len(loads)) + hold[:, :, None] * at_loads)
            back = between[:, : len(places), len(places) :] @ (back * hold[:, None, :])
            to_points = to_points[:, : len(places)] - back @ to_points[:, len(places) :]
            between = between[:, : len(places)] - back @ between[:, len(places) :]
            between = between[:, :, : len(places)]
        return between, to_points

    def _answers(self, omega: FloatArray, terms: int) -> tuple[ComplexArray, ComplexArray]:
        """How each mode answers (f, r), and the weights of what the truncated ones add, (f, n)."""
        loss = 1 + 1j * self.plate.loss_factor
        zeta = np.asarray(omega**2 / loss + self.shift, dtype=complex)
        weights = truncation_weights(zeta, self.largest_truncated, terms)
        answers = 1 / (loss * self.squared - (omega**2)[:, None])
        return np.asarray(answers, dtype=complex), np.asarray(weights / loss, dtype=complex)

    def _between(self, attached: Attachments, omega: FloatArray) -> ComplexArray:
        """Receptance between attachments, (f, n, n)."""
        answers, weights = self._answers(omega, 2 * TERMS)
        modal = (answers[:, None, :] * attached.shapes) @ attached.shapes.T
        return np.asarray(modal + np.tensordot(weights, attached.moments, axes=1))

    def _truncation_error(self, omega: FloatArray, terms: int) -> FloatArray:
        """The most by which the answer of any truncated mode can be wrong, (f,) [s²/rad²]."""
        largest = self.largest_truncated
        loss = 1 + 1j * self.plate.loss_factor
        zeta = np.asarray(omega**2 / loss + self.shift, dtype=complex)
        # None of them answers more strongly than the lowest would at full reach.
        most = largest / (1 - np.abs(zeta) * largest)
        return np.asarray(truncation_error(zeta, largest, terms) * most)

    def _omega(self, frequencies: FloatArray) -> FloatArray:
        """omega [rad/s] of frequencies [Hz] that can be answered; InputError for others."""
        frequencies = np.asarray(frequencies, dtype=float)
        check_frequencies(self.plate, self.mesh, frequencies)
        if len(frequencies) and frequencies.max() > self.frequency_max * (1 + 1e-9):
            raise InputError(
                f"the plate was solved up to {self.frequency_max:g} Hz and cannot answer at "
                f"{frequencies.max():g} Hz; solve it with a higher frequency_max"
            )
        return 2 * np.pi * frequencies


def _apply(basis: FloatArray, coordinates: ComplexArray) -> ComplexArray:
    """A real basis (p, r) times complex coordinates (f, r, n): (f, n, p), in one real product."""
    f, r, n = coordinates.shape
    stacked = np.ascontiguousarray(coordinates.transpose(0, 2, 1)).view(float)
    parts = stacked.reshape(f, n, r, 2).transpose(0, 1, 3, 2).reshape(-1, r)
    product = (parts @ basis.T).reshape(f, n, 2, len(basis))
    result = np.empty((f, n, len(basis)), dtype=complex)
    result.real, result.imag = product[:, :, 0], product[:, :, 1]
    return result


def _field_size(modal: ComplexArray, residual: ComplexArray, moments: FloatArray) -> FloatArray:
    """Root of the plate's mass times its mean square deflection, for each column: (f, n)."""
    square = (np.abs(modal) ** 2).sum(axis=1)
    for a in range(residual.shape[1]):
        for b in range(residual.shape[1]):
            share = residual[:, a].conj() * (moments[a + b + 1] @ residual[:, b])
            square += share.sum(axis=1).real
    return np.asarray(np.sqrt(square))


def solve_free_plate(plate: Plate, mesh: Mesh, *, frequency_max: float = 500.0) -> FreePlate:
    """Solve the free plate once on a mesh, for answers up to a frequency [Hz]."""
    if not (math.isfinite(frequency_max) and frequency_max > 0):
        raise InputError(f"frequency_max is {frequency_max} Hz, must be above zero")
    # Above nothing, since rigid motion could not be factored, and well below the modes left out: it
    # takes from how fast their sum converges.
    shift = (2 * math.pi * min(plate.lowest_bending_frequency, frequency_max / 3)) ** 2
    cut = FREQUENCY_MARGIN * frequency_max
    elements = element_matrices(plate, mesh)
    classes = tuple(
        solve_class(
            symmetry_class(mesh, parity),
            elements,
            shift=shift,
            cut=(2 * math.pi * cut) ** 2,
            count=_class_count(plate, cut),
        )
        for parity in CLASSES
    )
    return FreePlate(plate, mesh, frequency_max, shift, classes)


def _class_count(plate: Plate, frequency: float) -> int:
    """About how many modes a symmetry class has up to a frequency [Hz], and a few more.

    Area term of the mode count of a thin plate, pi S / wavelength², and a quarter more for its
    edges; a quarter of that for each class.
    """
    area_term = math.pi * plate.length * plate.width / plate.bending_wavelength(frequency) ** 2
    return math.ceil(1.25 * area_term / 4) + 4
