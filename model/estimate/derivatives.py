"""Derivatives of the responses of a forward model with respect to its physical quantities.

With L = 1 - T Z, a change dA of the free receptance and dZ of the attachments change T by

    dT = L dA L^T - T dZ T.

A mode, a position or an attachment changes T by a matrix of rank one or two, u v^T. A sensor of
mass m that loads the plate during its own measurement adds l² w² m T_sj dT_ss to l dT_sj.

Each property or method of `ResponseDerivatives` is the derivative with respect to the quantity in
its name, (f, s, n, m) for m quantities. `model.estimate.parameters` combines them to the
derivatives with respect to parameters.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.forward import PlateAt
from model.reduction.free_plate import TERMS, combined

AnyArray: TypeAlias = NDArray[np.floating[Any]] | NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, eq=False)
class ResponseDerivatives:
    """Derivatives of the responses (f, s, n) of a plate with `a` attachments and r modes."""

    plate: PlateAt

    # The free plate.

    @cached_property
    def rigidity(self) -> ComplexArray:
        """By the logarithm of the stiffness of the whole plate."""
        return self._log_stiffness(1.0, 1.0)

    @cached_property
    def loss_factor(self) -> ComplexArray:
        """By the logarithm of the plate's loss factor."""
        free = self.plate.free
        modes = _quotient(1j * free.plate_losses, free.eigenvalues)
        remainder = 1j * free.loss_factor / (1 + 1j * free.loss_factor)
        return self._log_stiffness(modes, remainder)

    @property
    def free_receptance(self) -> ComplexArray:
        """By the logarithm of a common factor on the free plate's receptance A."""
        return self._response_change(self._receptance_change(self.plate.free_receptance))[..., None]

    def _log_stiffness(
        self, modes: ComplexArray | float, remainder: ComplexArray | float
    ) -> ComplexArray:
        """By a change of the log stiffness of the modes (f, r) and of the remainder (f,).

        The remainder are form errors and truncated modes.
        """
        plate = self.plate
        receptance = plate.free.receptance
        observed, driven = self._modal_motions
        change = (observed * (modes * receptance.elastic)[:, None]) @ driven
        if plate.free.form is not None:
            form_change = plate.free.form.stiffness * np.reshape(remainder, (-1, 1, 1))
            change += observed @ form_change @ driven
        truncated = np.asarray(remainder)[..., None] * receptance.truncated_by_log_q
        truncated_change = combined(truncated, plate.attachments.truncated)
        receptance_change = self._receptance_change(truncated_change)
        receptance_change = receptance_change - receptance.thickness**3 * change
        return self._response_change(receptance_change)[..., None]

    @property
    def mode_stiffness(self) -> ComplexArray:
        """By the logarithm of the eigenvalue of each mode that can shift."""
        return self._mode_eigenvalues(1.0)

    @property
    def mode_losses(self) -> ComplexArray:
        """By the logarithm of the losses of each mode that can shift."""
        free = self.plate.free
        return self._mode_eigenvalues(_quotient(1j * free.losses, free.eigenvalues))

    def _mode_eigenvalues(self, factor: ComplexArray | float) -> ComplexArray:
        """By the log eigenvalue of each mode that can shift, times a factor (f, r)."""
        modes = self.plate.model.shifted_modes
        receptance = self.plate.free.receptance
        motion = self._modal_motion[:, :, modes]
        log_slope = -(receptance.thickness**3) * receptance.elastic
        return self._rank_one(motion, motion, (factor * log_slope)[:, modes])

    @property
    def foreign_mass(self) -> ComplexArray:
        """By the mass of each cell as a fraction of the plate's, taken from the whole plate."""
        model = self.plate.model
        assert model.form is not None  # noqa: S101  there is foreign mass
        motion = self._modal_motion @ model.form.cells.T
        plate_mass = model.rig.plate.mass * self.plate.free.receptance.thickness
        by_mass = self._rank_one(motion, motion, plate_mass * model.omega[:, None] ** 2)
        return np.asarray(by_mass - by_mass.mean(axis=-1, keepdims=True))

    def stretch(self, *numbers: int) -> ComplexArray:
        """By relative length (0), width (1) and Poisson's ratio (2), through mode coupling."""
        plate = self.plate
        assert plate.model.form is not None  # noqa: S101  sides differ
        receptance = plate.free.receptance
        factor = -(receptance.q * receptance.thickness)[:, None, None]
        observed, driven = self._modal_motions
        slopes = []
        for stiffening in plate.model.form.stiffening[list(numbers)]:
            slopes.append(self._response_change(factor * (observed @ stiffening @ driven)))
        return np.stack(slopes, axis=-1)

    # Attachments.

    @cached_property
    def positions(self) -> ComplexArray:
        """By x and y of each of the v movable attachments in turn (f, s, n, 2 v).

        A position changes the receptance in its row and its column.
        """
        plate = self.plate
        located = plate.attachments
        truncated = plate.free.receptance.truncated(TERMS)
        rows = located.shape_slopes @ plate.coordinates
        rows = rows + combined(truncated, located.truncated_slopes)
        motion = plate.coupling @ rows.swapaxes(1, 2)
        column = plate.coupling[:, :, np.repeat(plate.model.movable, 2)]
        ones = np.ones((len(plate.model.omega), 1))
        return self._rank_one(column, motion, ones) + self._rank_one(motion, column, ones)

    def era_values(self, kind: str) -> ComplexArray:
        """By a value of each ERA, which changes its stiffness and its force (f, s, n, n)."""
        plate = self.plate
        omega = plate.model.omega
        missing = np.zeros((2, len(omega)), dtype=complex)
        slopes = [source.slopes(omega).get(kind, missing) for source in plate.sources]
        stiffness_slopes, force_slopes = np.array(slopes).transpose(1, 2, 0)
        eras = np.arange(len(slopes))
        by_value = self.attachment_stiffness(eras, stiffness_slopes)
        log_force_slopes = force_slopes / plate.full_levels / plate.force
        by_value[:, :, eras, eras] += plate.responses * log_force_slopes[:, None]
        return by_value

    @property
    def added_masses(self) -> ComplexArray:
        """By each of the m additional masses, its x and its y in turn (f, s, n, 3 m)."""
        model = self.plate.model
        first = len(self.plate.sources)
        last = first + model.mass_count
        masses = model.movable[first:last]
        by_mass = self.attachment_stiffness(masses, -(model.omega[:, None] ** 2))[..., None]
        by_place = self.positions[..., 2 * first : 2 * last].reshape(*by_mass.shape[:-1], 2)
        return np.concatenate([by_mass, by_place], axis=-1).reshape(*by_mass.shape[:3], -1)

    def mass_at(self, points: FloatArray) -> ComplexArray:
        """By a mass [kg] at each of p points (p, 2) [m], (f, s, n, p)."""
        plate = self.plate
        modes = plate.model.modes
        sums = modes.truncated_terms(plate.attachments.footprints, points)
        truncated = combined(plate.free.receptance.truncated(TERMS), sums)
        motion = self._modal_motion @ modes.shapes_at(points).T + plate.coupling @ truncated
        return self._rank_one(motion, motion, plate.model.omega[:, None] ** 2)

    def attachment_stiffness(self, attachments: IntArray, changes: AnyArray) -> ComplexArray:
        """By changes (f, m) of the dynamic stiffness of attachments with indices (m,)."""
        columns = self.plate.receptance[:, :, attachments]
        return self._rank_one(columns, columns, -changes)

    # Drives and sensors.

    def drive_gains(self, factor: ComplexArray | complex = 1.0) -> ComplexArray:
        """By the logarithm of the gain of each drive, times a factor (f, s, n, n)."""
        return self.plate.responses[..., None] * np.eye(len(self.plate.sources)) * factor

    @property
    def sensor_gains(self) -> ComplexArray:
        """By the logarithm of the gain of each sensor (f, s, n, s)."""
        sensors = np.eye(len(self.plate.model.sensors))
        return self.plate.responses[..., None] * sensors[:, None]

    # Changes of the receptance.

    @cached_property
    def _modal_motion(self) -> ComplexArray:
        """Motion of the attachments for a force on each free mode (f, a, r) [s²/kg]."""
        return self.plate.coupling @ self.plate.coordinates.swapaxes(1, 2)

    @property
    def _modal_motions(self) -> tuple[ComplexArray, ComplexArray]:
        """`_modal_motion` of the sensors (f, s, r), and of the driven points transposed (f, r,
        c)."""
        motion = self._modal_motion
        return motion[:, self.plate.model.observed], motion[:, self._driven].swapaxes(1, 2)

    @property
    def _driven(self) -> slice | IntArray:
        """Columns c of T whose changes count: ERAs, then sensors that load the plate."""
        n = len(self.plate.sources)
        if self.plate.load_factors is None:
            return slice(n)
        return np.concatenate([np.arange(n), self.plate.model.observed])

    def _receptance_change(self, free_change: ComplexArray) -> ComplexArray:
        """Return L dA L^T (f, s, c) for a change dA of the free receptance (f, a, a)."""
        left = self.plate.coupling
        observed = left[:, self.plate.model.observed]
        return observed @ free_change @ left[:, self._driven].swapaxes(1, 2)

    def _rank_one(self, u: AnyArray, v: AnyArray, factor: AnyArray) -> ComplexArray:
        """Return changes of the responses for dT = factor u v^T (f, s, n, m).

        u and v (f, a, m): columns over the attachments; factor (f, m).
        """
        rows = u[:, self.plate.model.observed] * factor[:, None]
        return self._response_change(rows[:, :, None] * v[:, None, self._driven])

    def _response_change(self, change: AnyArray) -> ComplexArray:
        """Return changes of the responses (f, s, n, ...) for a change of T (f, s, c, ...)."""
        plate = self.plate
        other_axes = (1,) * (change.ndim - 3)
        n = len(plate.sources)
        motion = change[:, :, :n]
        if plate.load_factors is not None:
            assert plate.model.sensor_inertia is not None  # noqa: S101  there is a mass
            sensors = np.arange(change.shape[1])
            at_sensor = change[:, sensors, n + sensors][:, :, None]
            loaded = plate.model.sensor_inertia[:, :, None] * plate.loaded_receptance
            motion = motion + loaded.reshape(*loaded.shape, *other_axes) * at_sensor
            motion = motion * plate.load_factors.reshape(*plate.load_factors.shape, 1, *other_axes)
        return motion * plate.scale.reshape(*plate.scale.shape, *other_axes)


def _quotient(numerator: AnyArray, denominator: ComplexArray) -> ComplexArray:
    """Return a quotient, 0 for a denominator of 0."""
    zeros = np.zeros(denominator.shape, dtype=complex)
    return np.divide(numerator, denominator, out=zeros, where=denominator != 0)
