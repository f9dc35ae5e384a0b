"""Parameters of the plate: thickness, elasticity, losses, and its lowest modes."""

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.forward import MIN_LOSS_FACTOR
from model.estimate.parameter_kinds import (
    AS_BUILT,
    DAMPING_STD,
    MIN_LOSS_STD,
    DifferentiableKind,
    PlateParameter,
    StatedByRig,
    added_prior,
)
from model.estimate.parameter_space import (
    PlateValues,
    Prior,
    SearchScope,
)
from model.structure.plate import LOSS_FREQUENCY, MAX_LOSS_EXPONENT, MAX_LOSS_FACTOR


class ModeParameter(DifferentiableKind):
    """Kind with one parameter for each of the lowest elastic modes."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{self.label} {n}" for n in range(1, scope.mode_count + 1)]


class ThicknessFactor(StatedByRig, PlateParameter):
    """Logarithm of a factor on the thickness; the bending stiffness has its third power."""

    name = label = "thickness"
    std = AS_BUILT.thickness
    stage = 0
    is_listed = True

    def value(self, values: PlateValues) -> float:
        return values.factor(self.name)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return 2 * derivatives.rigidity - derivatives.free_receptance


class ModulusFactor(PlateParameter):
    """Logarithm of a factor on Young's modulus; known exactly if the thickness is."""

    name = label = "modulus"
    std = AS_BUILT.modulus
    is_listed = True

    def prior(self, scope: SearchScope) -> Prior:
        std = self.std if scope.uncertainty.thickness > 0 else 0.0
        return Prior(max(std, scope.uncertainty.elasticity))

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return Prior(0.07, -math.log(3.0), math.log(3.0))

    def value(self, values: PlateValues) -> float:
        return values.factor(self.name)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.rigidity


class LossFactor(PlateParameter):
    """Logarithm of a factor on the plate's loss factor."""

    name = "loss"
    label = "loss factor"
    std = DAMPING_STD
    stage = 0
    is_listed = True

    def prior(self, scope: SearchScope) -> Prior:
        return _loss_prior(scope, math.log(scope.uncertainty.damping))

    def value(self, values: PlateValues) -> float:
        """Loss factor of the plate, including `LossAdded`."""
        scaled = values.rig.plate.loss_factor * values.factor("loss")
        added = values.deviations("loss_added")[0]
        return float(np.clip(scaled + added, 0.0, MAX_LOSS_FACTOR))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.loss_factor


class LossAdded(PlateParameter):
    """Loss factor added to the rig's, which may be zero."""

    name = "loss_added"
    label = "further loss factor"
    std = 0.0
    unit = ""
    per_unit = 1.0

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        loss_factor = scope.rig.plate.loss_factor
        return added_prior(loss_factor, std=max(MIN_LOSS_STD * loss_factor, 0.003), largest=0.5)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        loss_factor = derivatives.plate.values["loss"]
        return np.asarray(derivatives.loss_factor / max(loss_factor, MIN_LOSS_FACTOR))


class LossExponent(PlateParameter):
    """Change of the power of frequency that the loss factor follows."""

    name = "loss_exponent"
    label = "loss exponent"
    std = 0.3
    unit = ""
    per_unit = 1.0

    def prior(self, scope: SearchScope) -> Prior:
        exponent = scope.rig.plate.loss_exponent
        lower, upper = -MAX_LOSS_EXPONENT - exponent, MAX_LOSS_EXPONENT - exponent
        return Prior(_loss_prior(scope, self.std).std, lower, upper)

    def value(self, values: PlateValues) -> float:
        return float(values.rig.plate.loss_exponent + values.deviations(self.name)[0])

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        log_frequency = np.log(derivatives.plate.model.frequencies / LOSS_FREQUENCY)
        return log_frequency[:, None, None, None] * derivatives.loss_factor


class ModeStiffness(ModeParameter):
    """Logarithm of a factor on the eigenvalue of each of the lowest modes."""

    name = "mode_shifts"
    label = "stiffness of mode"
    std = 0.01
    theory = 3e-3

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return Prior(0.003)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.mode_stiffness


class ModeLoss(ModeParameter):
    """Logarithm of a factor on the loss factor of each of the lowest modes."""

    name = "mode_losses"
    label = "loss of mode"
    std = 0.5

    def prior(self, scope: SearchScope) -> Prior:
        return _loss_prior(scope, self.std)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.mode_losses


def _loss_prior(scope: SearchScope, std: float) -> Prior:
    """Return the prior of a loss of the plate, exactly known on a plate without it."""
    is_uncertain = scope.uncertainty.damping > 1 and scope.rig.plate.loss_factor > 0
    return Prior(std if is_uncertain else 0.0)
