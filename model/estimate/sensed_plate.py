"""A rig's plate with sensors, and the data-sheet values that calibration and rig check fit."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.fitted_values import Parameter, parameters_of
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.measurement import Measurement
from model.estimate.parameter_space import PlateValues
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.rig_parameters import rig_with, space_from_datasheets
from model.estimate.sensor_parameters import MASS_CELLS
from model.reduction.form_modes import reduced_modes
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.modal_elasticity import check_is_plate

MAX_GUESSED = math.sqrt(0.5)
"""Standard error of a parameter relative to its prior, above which the prior determines it more
than the data do."""

# Limits for modes that can shift: of the lowest bending frequency, of the highest tone.
_LOWEST, _HIGHEST = 0.1, 1.2
_MIN_FREQUENCY = 200.0  # Hz, up to which a free plate is solved

_PLATE_KINDS = ("modulus", "loss_factor")
_ERA_KINDS = ("stiffness", "damping", "bolt_mass", "magnet_mass")
_ADDED_KINDS = {"loss_factor": "loss_added", "damping": "damping_added"}


@dataclass(frozen=True, eq=False)
class SensedPlate(ForwardModel):
    """A rig's plate with sensors, as a function of values that data sheets state.

    Its space has the n fitted values and, if enabled, form errors. Responses are without the gains
    of the rig's ERAs, since a fit finds gains.
    """

    @cached_property
    def drive_gains(self) -> ComplexArray:
        """Gains of 1 (f, eras)."""
        return np.ones((len(self.rig.eras), len(self.frequencies)), dtype=complex).T

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Fitted values (n,): modulus and loss factor, then the values of every ERA and every
        foot."""
        feet = self.rig.foot_names if self.rig.uncertainty.supports else ()
        return parameters_of(self.rig, _PLATE_KINDS, _ERA_KINDS, feet)

    @cached_property
    def exciter_parameters(self) -> tuple[Parameter, ...]:
        """The fitted values of exciters."""
        exciters = {era.name for era in self.rig.eras if "force_factor" in era.fields}
        return tuple(parameter for parameter in self.parameters if parameter.era in exciters)

    @cached_property
    def largest_errors(self) -> FloatArray:
        """Standard errors of x (n,) above which a fitted value is not identified.

        Infinite for an exciter's coil and magnet, whose values are from a data sheet. Feet have a
        prior, too.
        """
        limits = []
        for parameter in self.parameters:
            limit = MAX_GUESSED if parameter.foot else 1.0
            is_of_exciter = parameter in self.exciter_parameters
            if is_of_exciter and parameter.kind in ("bolt_mass", "magnet_mass"):
                limit = math.inf
            limits.append(limit)
        return np.array(limits)

    @cached_property
    def numbers(self) -> IntArray:
        """Index of each fitted value in the space (n,)."""
        eras = {era.name: number for number, era in enumerate(self.rig.eras)}
        feet = {name: number for number, name in enumerate(self.rig.foot_names)}
        numbers = []
        for parameter in self.parameters:
            kind = _ADDED_KINDS.get(parameter.kind, parameter.kind)
            offset = eras.get(parameter.era, 0) + feet.get(parameter.foot, 0)
            numbers.append(self.space.groups[kind].start + offset)
        return np.array(numbers)

    def with_rig(self, rig: Rig) -> "SensedPlate":
        """Return the plate of a rig with another modulus, thickness, loss factor, ERAs and masses.

        Reuses the solution of the free plate.
        """
        mode_count = None
        if self.form is not None:
            natural = np.sqrt(np.maximum(self.modes.eigenvalues, 0)) / (2 * np.pi)
            highest = _HIGHEST * self.frequencies.max()
            lowest = _LOWEST * rig.plate.lowest_bending_frequency
            mode_count = int(((natural > lowest) & (natural < highest)).sum())
        names = [sensor.name for sensor in self.sensors]
        return replace(self, rig=rig, space=space_from_datasheets(rig, names, mode_count))

    def responses(self, x: FloatArray | None = None) -> ComplexArray:
        """Acceleration per base displacement of each ERA at x (p,), default the rig's values.

        Shape (f, s, eras) [1/s²].
        """
        if x is None:
            x = np.zeros(self.space.size)
        return self.at(x).responses

    def rig_at(self, x: FloatArray, *further: str) -> Rig:
        """Return the rig with the fitted values of x, and with the values of further kinds."""
        # A force factor is fitted together with the damping.
        kept = self.space.of("force_factor", *further)
        kept[self.numbers] = True
        values = PlateValues(self.rig, self.space, np.where(kept, x, 0.0))
        return rig_with(self.rig, values, self.rig.uncertainty)

    def values(self, x: FloatArray) -> FloatArray:
        """The fitted values at x in their units (n,)."""
        rig = self.rig_at(x)
        return np.array([parameter.of(rig) for parameter in self.parameters])

    def deviations(self, x: FloatArray) -> FloatArray:
        """Differences of the fitted values from the rig (n,), relative to their prior.

        The prior is the wider of the data sheets' and the rig's. Losses vary by factors: above the
        rig's loss, the logarithm counts.
        """
        value = np.array([parameter.before for parameter in self.parameters])
        is_loss = np.array([parameter.kind in _ADDED_KINDS for parameter in self.parameters])
        is_lossy = (value > 0) & is_loss
        std = self.space.std[self.numbers] / np.where(is_lossy, value, 1.0)
        size = std * x[self.numbers]
        is_greater = is_lossy & (size > 0)
        size = np.where(is_greater, np.log1p(np.abs(size)), size)
        std = np.where(is_greater, np.log1p(np.abs(std)), std)
        return np.asarray(size / np.maximum(std, (value > 0) * self._rig_stds))

    @property
    def _rig_stds(self) -> FloatArray:
        """Relative prior of each fitted value according to the rig (n,), 0 if not stated."""
        uncertainty = self.rig.uncertainty
        log_factor = math.log(uncertainty.damping)
        stiffness = math.hypot(uncertainty.stiffness, uncertainty.thickness)
        stds = {
            "modulus": math.hypot(2 * uncertainty.thickness, uncertainty.modulus),
            "loss_factor": log_factor,
            "stiffness": stiffness,
            "magnet_mass": stiffness,
            "damping": math.hypot(log_factor, PARAMETER_KINDS["damping_each"].std),
            "supports": uncertainty.supports,
        }
        return np.array([stds.get(parameter.kind, 0.0) for parameter in self.parameters])

    def errors(self, x: FloatArray, error: FloatArray) -> FloatArray:
        """Convert standard errors of x (p,) to standard errors of the fitted values at x in their
        units (n,)."""
        is_factor = np.array([parameter.is_factor for parameter in self.parameters])
        slopes = self.space.std[self.numbers] * np.where(is_factor, self.values(x), 1.0)
        return slopes * error[self.numbers]

    def start(self, modulus: float, stiffness: float) -> FloatArray:
        """Return parameters x (p,) for logarithms of factors on modulus and stiffnesses."""
        x = np.zeros(self.space.size)
        for kind, logarithm in (("modulus", modulus), ("stiffness", stiffness)):
            part = self.space.groups[kind]
            x[part] = logarithm / self.space.std[part]
        return x


def sensed_plate(
    rig: Rig, sensors: Sequence[Sensor], frequencies: FloatArray, *, has_form: bool = False
) -> SensedPlate:
    """Solve a rig's free plate once, for sensors at points on it and frequencies (f,) [Hz].

    has_form: whether to include form errors. Raises InputError for frequencies too high for its
    mesh.
    """
    check_is_plate(rig.plate, "a fit or check with measurements")
    rig.mesh.check_frequencies(rig.plate, frequencies)
    frequency_max = float(max(frequencies.max(), _MIN_FREQUENCY))
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=frequency_max)
    form = None
    if has_form:
        supports = footprints_of(rig.eras, rig.masses)
        form = reduced_modes(free, supports, MASS_CELLS.centers(rig.plate))
    space = space_from_datasheets(rig, (), None)
    return SensedPlate(rig, sensors, frequencies, space, free, form=form).with_rig(rig)


def plate_of(rig: Rig, observation: Measurement, *, has_form: bool = False) -> SensedPlate:
    """Return the plate of a rig at the sensors and frequencies of a measurement; see
    `sensed_plate`."""
    return sensed_plate(rig, observation.sensors, observation.frequencies, has_form=has_form)
