"""Plate in the time domain: modal equations of motion, solved exactly.

    M q'' + C q' + K q = sum over ERAs of phi (k_b y + c y')

q are the coordinates of the reduced free plate and the displacements of the phalanges of fingers on
it, phi the shapes at an ERA, and y the motion of the ERA's base. `model.reduction.supported_plate`
defines M, C and K. For exciters, y is the voltage, k_b and c are the forces between plate and
magnet due to y and y', and q includes the displacements of their magnets. The first-order system is
diagonalized once for each set of attachments.

There are three kinds of drives, all without a step size, so that no error grows with time: bases
that move in terms with closed-form solutions (`PlateInTime.driven`), samples of band-limited
signals (`model.transients.sampled_response`), and envelopes on a plate under fingers
(`model.transients.enveloped_response`).

Not modeled: large deflections, air, the ERAs' own dynamics beyond spring, damper and bolt mass,
rocking and drag at the bolts, and the impulse c times the jump that the damper would pass on if a
base jumped (ramp 0): displacement and velocity of the plate are continuous through every change.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate
from model.reduction.supported_plate import modal_matrices, stretches
from model.structure.attachments import PointLoad, footprints_of
from model.structure.fingertips import FingertipLoad
from model.structure.sources import Source
from model.transients.base_motion import BaseMotions


@dataclass(frozen=True, slots=True, eq=False)
class ForcedVibration:
    """k particular solutions Im[vectors @ z(t)], in n terms.

    z = sum over the solution's terms of (a0 + a1 tau) exp(i omega tau), with tau = t - time.
    """

    plate: "PlateInTime"
    times: FloatArray
    """Start (k,) of each solution [s]."""
    number: NDArray[np.intp]
    """Solution (n,) of each term."""
    omegas: FloatArray
    """omega (n,) [rad/s], each once in a solution."""
    a0: ComplexArray
    """(n, 2 r), in the eigenvectors of the plate."""
    a1: ComplexArray | None
    """(n, 2 r), None for 0."""

    def rows(self, number: int) -> slice:
        """Return which of the n terms belong to a solution."""
        return slice(*self.number.searchsorted((number, number + 1)).tolist())

    def state(self, number: int, time: float) -> FloatArray:
        """Return displacement and velocity (2 r,) in a solution at a time [s]."""
        return np.asarray((self.plate.vectors @ self.modal([number], [time])[0]).imag)

    def as_free(self, numbers: Sequence[int], times: Sequence[float]) -> ComplexArray:
        """Return z (j, m) of free vibrations in the state of solutions (j,) at times (j,) [s]."""
        z = self.modal(numbers, times)
        half = self.plate.half
        # The conjugate of an eigenvector belongs to the conjugate eigenvalue, which LAPACK stores
        # behind each eigenvalue above the real axis; a real one is its own conjugate.
        partner = half + (self.plate.decay.imag > 0)
        return -0.5j * (z[:, half] - z[:, partner].conj())

    def acceleration(self, number: int, times: FloatArray, shapes: ComplexArray) -> FloatArray:
        """Return the acceleration (n, p) in a solution at times (n,) [s]; shapes (2 r, p): by z."""
        rows = self.rows(number)
        tau = times[:, None] - self.times[number]
        s = 1j * self.omegas[rows]
        s_squared = s[:, None] ** 2
        phase_factor = np.exp(s * tau)
        constant = s_squared * self.a0[rows]
        if self.a1 is None:
            return np.asarray((phase_factor @ (constant @ shapes)).imag)
        growth = self.a1[rows]
        constant += 2 * s[:, None] * growth
        growing = (tau * phase_factor) @ (s_squared * growth @ shapes)
        return np.asarray((phase_factor @ (constant @ shapes) + growing).imag)

    def modal(self, numbers: Sequence[int], times: Sequence[float]) -> ComplexArray:
        """Return z (j, 2 r) in solutions (j,) at times (j,) [s]."""
        tau = np.array(times)[:, None] - self.times[self.number]
        is_of_solution = self.number == np.array(numbers)[:, None]
        phase_factor = is_of_solution * np.exp(1j * self.omegas * tau)
        z: ComplexArray = phase_factor @ self.a0
        if self.a1 is not None:
            z += (tau * phase_factor) @ self.a1
        return z


@dataclass(frozen=True, eq=False)
class PlateInTime:
    """The plate on its ERAs as z' = diag(eigenvalues) z + participation f, f [N] per ERA.

    Its r coordinates are the reduced plate's, and one for each free magnet and each phalanx.
    """

    reduced: ReducedPlate
    eras: tuple[Source, ...]
    eigenvalues: ComplexArray
    """Eigenvalues (2 r,) [1/s], in conjugate pairs."""
    vectors: ComplexArray
    """Eigenvectors (2 r, 2 r): displacement and velocity of the coordinates are vectors @ z."""
    inverse: ComplexArray
    """Inverse of the eigenvectors (2 r, 2 r)."""
    participation: ComplexArray
    """z' (2 r, eras) by the force of each ERA."""
    forced: ComplexArray
    """z' (2 r, r) by a force on each coordinate."""
    stretches: FloatArray
    """Displacement (eras, r) at each ERA minus its free magnet's, per coordinate."""

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Return the shapes (p, r) of all coordinates at points (p, 2) [m]."""
        return self.with_far_ends(self.reduced.at(points))

    def with_far_ends(self, shapes: FloatArray) -> FloatArray:
        """Return the shapes (..., r) of all coordinates, from the shapes of the reduced plate's.

        These come first; magnets and phalanges are not on the plate and have shape 0.
        """
        far_end_count = len(self.vectors) // 2 - shapes.shape[-1]
        if not far_end_count:
            return shapes
        padding = [(0, 0)] * (shapes.ndim - 1)
        return np.pad(shapes, (*padding, (0, far_end_count)))

    @cached_property
    def displacement(self) -> ComplexArray:
        """Displacement of the coordinates in each eigenvector, (r, 2 r)."""
        return self.vectors[: len(self.vectors) // 2]

    def driven(
        self, motions: BaseMotions, numbers: Sequence[int], times: Sequence[float]
    ) -> ForcedVibration:
        """Return particular solutions for sets of motions (k,) that play from times (k,) [s] on.

        Each is for the terms that move the ERAs' bases at its time. Terms with the same frequency
        are added, so that the cost of samples depends only on the number of frequencies.
        """
        start_times = np.array(times, dtype=float)
        solution, term = motions.active(numbers, start_times).nonzero()
        era = motions.era[term]
        omega = motions.omega[term]
        s = 1j * omega
        tau = start_times[solution] - motions.start[term]
        is_first = np.ones(len(term), dtype=bool)
        is_first[1:] = (omega[1:] != omega[:-1]) | (solution[1:] != solution[:-1])
        distinct_omegas = omega[is_first]
        # By frequency and ERA, as forces on the base.
        cell = (is_first.cumsum() - 1) * len(self.eras) + era
        receptance = 1 / (1j * distinct_omegas[:, None] - self.eigenvalues)
        by_rate = self.by_rate[era]
        impedance = self.by_drive[era] + by_rate * s  # force by displacement, or by voltage
        phase_factor = np.exp(s * tau)
        base = phase_factor * motions.c0[term]
        a1 = None
        if motions.c1 is None:
            a0 = self._by_forces(cell, impedance * base, distinct_omegas) * receptance
        else:
            growth = phase_factor * motions.c1[term]
            a1 = self._by_forces(cell, impedance * growth, distinct_omegas) * receptance
            force = impedance * (base + growth * tau) + by_rate * growth
            a0 = (self._by_forces(cell, force, distinct_omegas) - a1) * receptance
        return ForcedVibration(
            plate=self,
            times=start_times,
            number=solution[is_first],
            omegas=distinct_omegas,
            a0=a0,
            a1=a1,
        )

    def _by_forces(
        self, cell: NDArray[np.intp], forces: ComplexArray, omegas: FloatArray
    ) -> ComplexArray:
        """Return z' (n, 2 r) at n omegas by forces [N] in cells, numbered by omega and ERA."""
        shape = len(omegas), len(self.eras)
        cell_count = math.prod(shape)
        summed = np.empty(shape, dtype=complex)
        summed.real = np.bincount(cell, forces.real, cell_count).reshape(shape)
        summed.imag = np.bincount(cell, forces.imag, cell_count).reshape(shape)
        for number, era in enumerate(self.eras):
            if era.gains:
                summed[:, number] *= era.gain(omegas / (2 * np.pi))
        return summed @ self.participation.T

    @cached_property
    def by_drive(self) -> FloatArray:
        """Force by the drive of each ERA: its stiffness [N/m], N/V of exciters."""
        return np.array([era.in_time.by_drive for era in self.eras])

    @cached_property
    def by_rate(self) -> FloatArray:
        """Force by the rate of the drive of each ERA: its damping [N s/m], N s/V of exciters."""
        return np.array([era.in_time.by_rate for era in self.eras])

    def following(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return z (f, eras, 2 r) by each ERA alone at full stroke times exp(s t), s (f,) [1/s].

        Also its derivative by s: a base that rises as t exp(s t) leads to (derivative + t z)
        exp(s t). No s may be an eigenvalue; imaginary ones never are if anything damps. An ERA's
        measured gain is taken at the frequency of s; its change while the base rises is not
        modeled.
        """
        bases = self._bases(s)
        forces = bases * (self.by_drive + s[:, None] * self.by_rate)
        away = s[:, None, None] - self.eigenvalues
        z = forces[..., None] * self.participation.T / away
        by_velocity = (bases * self.by_rate)[..., None] * self.participation.T
        return z, (by_velocity - z) / away

    def following_all(self, s: ComplexArray, weights: ComplexArray) -> ComplexArray:
        """Return z (f, 2 r) by weights (f, eras) of all ERAs in full strokes, s (f,) [1/s]."""
        impedance = self.by_drive + s[:, None] * self.by_rate
        forces = weights * self._bases(s) * impedance
        return forces @ self.participation.T / (s[:, None] - self.eigenvalues)

    def _bases(self, s: ComplexArray) -> ComplexArray:
        """Return the drive of each ERA at full level with its gain, (f, eras)."""
        drives = [era.full_level * era.gain(s.imag / (2 * np.pi)) for era in self.eras]
        return np.stack(drives, axis=1)

    @cached_property
    def acceleration(self) -> ComplexArray:
        """Acceleration of the coordinates in free vibration in each eigenvector, (r, 2 r)."""
        return self.displacement * self.eigenvalues**2

    @property
    def own_acceleration(self) -> ComplexArray:
        """The rows of `acceleration` for the reduced plate's own coordinates."""
        return self.acceleration[: len(self.reduced.omega)]

    @cached_property
    def half(self) -> NDArray[np.intp]:
        """Indices (m,) of one eigenvalue per conjugate pair, and of real eigenvalues.

        Ordered from the slowest to the fastest decay.
        """
        numbers = np.flatnonzero(self.eigenvalues.imag >= 0)
        order = np.argsort(-self.eigenvalues.real[numbers], kind="stable")
        return numbers[order]

    @cached_property
    def decay(self) -> ComplexArray:
        """Eigenvalues (m,) of `half` [1/s]."""
        return self.eigenvalues[self.half]

    @cached_property
    def free_state(self) -> ComplexArray:
        """Matrix (2 r, m): displacement and velocity of a free vibration are Re[free_state @ z]."""
        is_one_of_pair = self.eigenvalues[self.half].imag > 0
        return self.vectors[:, self.half] * np.where(is_one_of_pair, 2.0, 1.0)

    @cached_property
    def free_acceleration(self) -> ComplexArray:
        """Matrix (r, m): acceleration of a free vibration is Re[free_acceleration @ z]."""
        return self.free_state[: len(self.vectors) // 2] * self.decay**2

    @cached_property
    def to_free(self) -> ComplexArray:
        """Matrix (m, 2 r): z of a free vibration is to_free @ its displacement and velocity."""
        return self.inverse[self.half]


_SEPARATED = 1e-6
"""Largest residual of the eigenvectors, relative to the largest coefficient of the equations."""


def plate_in_time(
    reduced: ReducedPlate,
    eras: Sequence[Source],
    *,
    loads: Sequence[PointLoad] = (),
    contacts: Sequence[FingertipLoad] = (),
    attachment_shapes: FloatArray | None = None,
) -> PlateInTime:
    """Diagonalize the equations of motion of a reduced plate on its ERAs, with loads and fingers.

    contacts: fingertips that rest on it; attachment_shapes (n, r): shapes at the ERAs, loads and
    contacts, if known already. Raises InputError for ERAs that do not hold the plate (fewer than
    three, or all in one line), and for a mode that is damped critically.
    """
    if attachment_shapes is None:
        attachment_shapes = reduced.at(footprints_of(eras, loads, contacts))
    M, C, K = modal_matrices(
        reduced, eras, loads=loads, contacts=contacts, attachment_shapes=attachment_shapes
    )
    r = len(K)
    # NumPy's solvers let other threads run meanwhile; SciPy's do not.
    inverse_mass = np.linalg.inv(M)
    velocities = [np.zeros((r, r)), np.eye(r)]
    accelerations = [-inverse_mass @ K, -inverse_mass @ C]
    A = np.block([velocities, accelerations])
    eigenvalues, vectors = np.linalg.eig(A)
    inverse_vectors = _inverse(vectors)
    residual = np.abs((vectors * eigenvalues) @ inverse_vectors - A).max()
    if not residual < _SEPARATED * np.abs(A).max():  # False for NaN
        raise InputError(
            "the plate's equations of motion cannot be separated into modes: a mode is damped "
            "critically; change an ERA's damping by a per mille"
        )
    era_stretches = stretches([era.in_time for era in eras], attachment_shapes[: len(eras)])
    input_shapes = np.pad(era_stretches, ((0, 0), (0, r - era_stretches.shape[1])))
    forced: ComplexArray = inverse_vectors[:, r:] @ inverse_mass
    return PlateInTime(
        reduced=reduced,
        eras=tuple(eras),
        eigenvalues=eigenvalues,
        vectors=vectors,
        inverse=inverse_vectors,
        participation=np.asarray(forced @ input_shapes.T, dtype=complex),
        forced=forced,
        stretches=input_shapes,
    )


def _inverse(vectors: ComplexArray) -> ComplexArray:
    """Return the inverse of the eigenvectors, NaN if they are dependent."""
    try:
        return np.asarray(np.linalg.inv(vectors))
    except np.linalg.LinAlgError:
        return np.full_like(vectors, np.nan)
