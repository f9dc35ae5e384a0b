"""Parameters of sensors, and form errors.

Form errors are described by no rig file: inaccurate cutting and positions, and attached cables.
"""

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.parameter_kinds import FormError, SensorParameter
from model.estimate.parameter_space import PlateValues, SearchScope
from model.finger import Grid

MASS_CELLS = Grid(8, 6)
"""Possible positions of foreign mass."""


class SensorGain(SensorParameter):
    """Logarithm of a factor on the gain of each sensor."""

    name = "sensor_gain"
    label = "gain of sensor"
    std = 0.05
    stage = 0

    def value(self, values: PlateValues) -> ComplexArray:
        """Complex factor on each gain, with the phase of `SensorPhase`."""
        return np.exp(values.deviations("sensor_gain") + 1j * values.deviations("sensor_phase"))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.sensor_gains


class SensorPhase(SensorParameter):
    """Phase of each sensor [rad]."""

    name = "sensor_phase"
    label = "phase of sensor"
    std = math.radians(5)
    unit = "°"
    per_unit = math.degrees(1)
    stage = 0

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return 1j * derivatives.sensor_gains


class SensorScale(FormError):
    """Relative error of each sensor's scale."""

    name = "sensor_scale"
    std = 0.01

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return [f"scale of sensor {sensor}" for sensor in scope.sensors]

    def value(self, values: PlateValues) -> FloatArray | float:
        """Factor on each sensor's reading, 1 on a plate without form errors."""
        errors = values.deviations(self.name)
        return 1 + errors if errors.size else 1.0

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        plate = derivatives.plate
        gain = plate.values["sensor_gain"][:, None]
        unscaled = gain * plate.drive[:, None] * plate.sensed_receptance
        return np.asarray(unscaled[..., None] * np.eye(len(plate.model.sensors))[:, None])


class SensorPosition(FormError):
    """x and y of each sensor that is not at an ERA, relative to the rig's [m]."""

    name = "sensor_place"
    std = 0.5e-3
    unit = "mm"
    per_unit = 1e3

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{axis} of sensor {n}" for n in range(scope.form_of or 0) for axis in "xy"]

    def value(self, values: PlateValues) -> FloatArray:
        return values.deviations(self.name).reshape(-1, 2)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        plate = derivatives.plate
        first = len(plate.sources) + plate.model.mass_count
        return derivatives.positions[..., 2 * first :]


class ForeignMass(FormError):
    """Mass in each cell of the plate, as a share of the plate's mass; the sum is zero.

    The prior is 1 % of the plate's mass over all cells.
    """

    name = "foreign_mass"
    std = 0.01 / math.sqrt(MASS_CELLS.cell_count)

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return [f"mass {n}" for n in range(MASS_CELLS.cell_count)]

    def value(self, values: PlateValues) -> FloatArray:
        shares = values.deviations(self.name)
        return np.asarray(shares - shares.mean())

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.foreign_mass


class SideLength(FormError):
    """Error of length and width [m]."""

    name = "side"
    std = 0.5e-3
    unit = "mm"
    per_unit = 1e3

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return ["length", "width"]

    def value(self, values: PlateValues) -> FloatArray:
        """Relative errors of length and width (2,)."""
        plate = values.rig.plate
        return values.deviations(self.name) / [plate.length, plate.width]

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.stretch(0, 1) / derivatives.plate.model.sides


class PoissonRatio(FormError):
    """Error of Poisson's ratio."""

    name = "poisson"
    label = "Poisson's ratio"
    std = 0.015
    unit = ""
    per_unit = 1.0

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.stretch(2)


class LossLaw(FormError):
    """Law of losses, from hysteretic (0) to viscous (1); see `model.estimate.loss_law`."""

    name = "loss_law"
    label = "loss law"
    std = 1.0
    unit = ""
    per_unit = 1.0

    def value(self, values: PlateValues) -> float:
        return float(values.deviations(self.name).sum())

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        change = derivatives.plate.model.viscous_change
        return (derivatives.plate.scale * (0.0 if change is None else change))[..., None]
