"""Base classes of the kinds of parameters, and priors that several kinds share."""

import math
from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.parameter_space import (
    ParameterKind,
    ParameterValues,
    PlateValues,
    Prior,
    SearchScope,
    values_of_eras,
)
from model.rig.rig import Uncertainty

AS_BUILT = Uncertainty()
"""Uncertainty of a rig that was not measured."""

DAMPING_STD = math.log(AS_BUILT.damping)
"""Standard deviation of the logarithm of a damping or loss factor that was not measured."""

MIN_LOSS_STD = 0.7
"""Minimum standard deviation of a loss from a data sheet, relative."""


class DifferentiableKind(ParameterKind):
    """A kind of parameters with derivatives of the responses."""

    @abstractmethod
    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        """Derivatives of the responses by all m parameters (f, s, n, m)."""


class StatedByRig(DifferentiableKind):
    """A kind whose name is also the key of its standard deviation in the rig's `uncertainty`."""

    def prior(self, scope: SearchScope) -> Prior:
        std: float = getattr(scope.uncertainty, self.name)
        return Prior(std)


class PlateParameter(DifferentiableKind):
    """Kind with a single parameter."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [self.label]


class EraParameter(DifferentiableKind):
    """Kind with one parameter per ERA."""

    per_era = 1

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{self.label} {era}" for era in scope.eras]


class SensorParameter(DifferentiableKind):
    """Kind with one parameter per sensor."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{self.label} {sensor}" for sensor in scope.sensors]


class FormError(DifferentiableKind):
    """Kind that exists only on plates with form errors, exactly known for an installed rig."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return self.form_names(scope) if scope.has_form_errors else ()

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        """Names of the parameters of a plate with form errors."""
        return [self.label]

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return form_error_prior(scope, self.std)


class EraFactor(EraParameter):
    """Logarithm of a factor on a value of each ERA, whose rig-file key is the kind's name."""

    largest_factor = 10.0
    """Largest factor that a fit to data sheets can find."""

    def value(self, values: PlateValues) -> FloatArray:
        factors = np.exp(values.deviations(self.name))
        return values_of_eras(values.rig, self.name) * factors

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.era_values(self.name)

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        std = max(self.std, scope.rig.uncertainty.stiffness)
        bound = math.log(self.largest_factor)
        return Prior(std, -bound, bound)


class ExciterFactor(EraFactor):
    """Logarithm of a factor on a value that exciters have and other ERAs do not."""

    std = AS_BUILT.stiffness

    def names(self, scope: SearchScope) -> Sequence[str]:
        return super().names(scope) if scope.excites.any() else ()

    def prior(self, scope: SearchScope) -> Prior:
        return Prior(scope.uncertainty.stiffness * scope.excites)

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        prior = super().datasheet_prior(scope)
        return prior._replace(std=prior.std * scope.excites)


def added_prior(value: ParameterValues, *, std: ParameterValues, largest: ParameterValues) -> Prior:
    """Return the prior of an addition to a value that cannot become negative."""
    return Prior(std, -value, np.maximum(largest - value, value))


def form_error_prior(scope: SearchScope, std: float) -> Prior:
    """Return the prior of a form error, exactly known on a plate without form errors."""
    return Prior(std if scope.has_form_errors else 0.0)
