"""Uncertainty of a calibrated rig: errors of its values, gains, positions and fields.

Errors have three sources: the fit to noisy values, plate theory, and form errors, which the fit
determines but a rig file cannot express. The rig is therefore fitted a second time without form
errors. The difference of the fields of both fits is the `field` of its uncertainty.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, rms
from model.estimate.fit import Fit
from model.estimate.fitted_values import Parameter
from model.estimate.gains import gains_of
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.sensed_plate import SensedPlate
from model.estimate.sensor_parameters import MASS_CELLS
from model.rig.rig import Uncertainty

_MIN_UNCERTAINTY = 1e-4  # no fit is exact
_MAX_LOSS_ERROR = 100.0  # of a logarithm; a loss that is fitted as nearly zero has a larger one

_MODEL_ERROR = 2e-3
"""Relative model error of all values except the loss factor."""
_LOSS_ERROR = 4e-3
"""The same of the loss factor: form errors that are not modeled widen resonances by 0.4 % (RMS over
plates without noise)."""

_FOREIGN_MASS = PARAMETER_KINDS["foreign_mass"].std * math.sqrt(MASS_CELLS.cell_count)
"""Prior of the foreign mass of all cells together, relative to the plate's mass."""

_AT_BOUND = 1e-6  # largest distance of x from its bound
_CLEAR = 3.0  # standard errors of a significant difference


class GainChanges(NamedTuple):
    """How the relative gains of a fit change with its parameters and with noise."""

    slopes: ComplexArray
    """Relative change of each gain per searched parameter (f, n, q)."""
    noise_variance: FloatArray
    """Variance of each relative gain due to noise (f, n)."""


def is_clear(fit: Fit[SensedPlate]) -> NDArray[np.bool_]:
    """Return a mask of the parameters that differ from the rig by several standard errors (p,)."""
    return np.abs(fit.x) > _CLEAR * fit.errors


@dataclass(frozen=True, eq=False)
class CalibrationUncertainty:
    """Errors of a rig fitted to a measurement at f frequencies, of n ERAs."""

    fit: Fit[SensedPlate]
    """Fit with form errors."""
    plain: Fit[SensedPlate]
    """Fit without form errors, for the rig file."""

    @property
    def plate(self) -> SensedPlate:
        """Plate of the original rig, with the sensors of the fit."""
        return self.fit.model

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Fitted values, with errors from the fit, the model and the total mass.

        All fitted values except losses scale with the total mass, which responses cannot determine.
        """
        plate = self.plate
        x = self.fit.x
        mass_error = math.hypot(_FOREIGN_MASS, *(PARAMETER_KINDS["side"].std / plate.sides))
        bounds = np.array([plate.space.lower, plate.space.upper])
        is_at_bound = np.abs(bounds - x).min(axis=0) < _AT_BOUND
        values = plate.values(x).tolist()
        errors = plate.errors(x, self.fit.errors).tolist()
        fitted = []
        for number, original in enumerate(plate.parameters):
            index = plate.numbers[number]
            model_error = math.hypot(_MODEL_ERROR, mass_error)
            if original.kind == "loss_factor":
                model_error = self._loss_error
            parameter = replace(original, value=values[number])
            if self.fit.searched[index]:
                error = math.hypot(errors[number], model_error * values[number])
                at_bound = bool(is_at_bound[index])
                parameter = replace(parameter, standard_error=error, at_bound=at_bound)
            fitted.append(parameter)
        return tuple(fitted)

    @cached_property
    def relative_gain_errors(self) -> FloatArray:
        """Relative standard errors of the gains of the fit (f, n)."""
        slopes, noise_variance = self._gain_changes
        variance = _variances(slopes.real, self.fit.covariance, self.fit.searched)
        return np.asarray(np.sqrt(noise_variance + variance))

    def of_rig(self, unexplained: float) -> Uncertainty:
        """Return the uncertainty of the calibrated rig, for its file.

        Excludes the error of the total mass, which scales all values and changes no pattern.
        Thickness represents the plate's rigidity: 1 % of modulus shifts modes like 0.5 % of
        thickness. Values that are not identified keep the original uncertainty. unexplained: error
        at held-out sensors that neither noise nor sensor tolerances explain, 0 if unknown.
        """
        original = self.plate.rig.uncertainty
        loss = self._kind_error("loss_factor", model_error=self._loss_error)
        loss = max(loss, self._kind_error("damping"))
        if loss < math.inf:
            loss = min(loss, _MAX_LOSS_ERROR)
        errors = {
            **self._field_errors(unexplained),
            "place": self._place_error,
            "stiffness": self._kind_error("stiffness"),
            "damping": math.expm1(loss),
        }
        if any(parameter.foot for parameter in self.parameters):
            unidentified = math.hypot(original.supports, _MODEL_ERROR)
            errors["supports"] = self._kind_error("supports", unidentified=unidentified)
        # An error is rarely known to more than two digits.
        rounded = {key: float(f"{error:.2g}") for key, error in errors.items() if error < math.inf}
        if "damping" in rounded:
            rounded["damping"] += 1
        if self.parameters[0].is_identified:
            rounded |= Uncertainty.of_frequency(float(f"{self._modulus_error / 2:.2g}"))
        return Uncertainty.clipped(**asdict(original) | rounded)

    @cached_property
    def _gain_changes(self) -> GainChanges:
        """Relative changes of the gains of the fit."""
        fit = self.fit
        power = (np.abs(fit.measurement.weight * fit.predicted) ** 2).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = fit.gain_slopes / fit.gains[..., None]
            noise_variance = np.where(power > 0, max(fit.chi2, 1.0) / power, np.nan)
        # A force factor and the gain are fitted together: only their product moves the plate.
        space = self.plate.space
        numbers = np.flatnonzero(fit.searched)
        for era, number in enumerate(space.indices("force_factor")):
            slopes[:, era, numbers == number] += space.std[number]
        return GainChanges(slopes, noise_variance)

    @cached_property
    def _loss_error(self) -> float:
        """Relative model error of the loss factor, including the effect of all dampers."""
        plate = self.plate
        kinds = np.array([parameter.kind for parameter in plate.parameters])
        std = plate.space.std[plate.numbers]
        values = plate.values(self.fit.x) / np.where(std > 0, std, 1.0)
        size = np.where(values > 0, values, np.inf)
        covariance = self.fit.covariance[np.ix_(plate.numbers, plate.numbers)]
        relative = covariance / np.outer(size, size)
        dampers = (kinds == "damping") & self.fit.searched[plate.numbers]
        with_loss = relative[dampers][:, kinds == "loss_factor"].sum(axis=1)
        slopes, *_ = np.linalg.lstsq(relative[np.ix_(dampers, dampers)], with_loss)
        return math.hypot(_LOSS_ERROR, _MODEL_ERROR * float(slopes.sum()))

    def _kind_error(
        self, kind: str, *, model_error: float = _MODEL_ERROR, unidentified: float = math.inf
    ) -> float:
        """Relative RMS error of all values of a kind; unidentified: of a value not identified."""
        # An exciter's coil both damps and drives; the contribution of its suspension hardly shows
        # alone.
        exciters = {parameter.era for parameter in self.plate.exciter_parameters}
        errors = self.plate.errors(self.fit.x, self.fit.errors).tolist()
        relative = []
        for parameter, error in zip(self.parameters, errors, strict=True):
            is_coil = parameter.kind == "damping" and parameter.era in exciters
            if parameter.kind != kind or is_coil:
                continue
            if not parameter.is_identified:
                relative.append(unidentified)
            elif parameter.value > 0:
                relative.append(math.hypot(error / parameter.value, model_error))
        return rms(relative)

    @property
    def _modulus_error(self) -> float:
        """Relative error of the fitted modulus as a value that reproduces the natural frequencies.

        It includes the effect of form errors on these.
        """
        x = self.plain.x
        error = self.plate.errors(x, self.plain.errors)[0]
        return math.hypot(error / self.plate.values(x)[0], _MODEL_ERROR)

    def _field_errors(self, unexplained: float) -> Mapping[str, float]:
        """Errors of gains and fields by key of `uncertainty`; missing if an ERA has no gain.

        `field` is the part of the fitted fields that the rig cannot express (form errors), and at
        least the unexplained error at held-out sensors. `gain` and `phase` are the errors of the
        best gains for such fields, as measured by the sensors; other errors change gains and fields
        in opposite directions.
        """
        slopes, noise_variance = self._gain_changes
        covariance = self.fit.covariance
        # Other fitted parameters change gain and field in opposite directions: sensors measure the
        # product.
        of_sensors = self.plate.space.of("sensor_scale", "sensor_place") & self.fit.searched
        slopes = slopes[..., of_sensors[self.fit.searched]]
        common = np.nanmean(slopes, axis=(0, 1))
        single = slopes - common
        magnitude = np.sqrt(noise_variance + _variances(single.real, covariance, of_sensors))
        phase = np.sqrt(noise_variance + _variances(single.imag, covariance, of_sensors))
        missing = self._missing_fields
        valid = np.isfinite(magnitude) & np.isfinite(missing)
        if not valid.any(axis=0).all():
            return {}
        field = max(rms(missing[valid]), unexplained)
        # Error of the best gain if the field at n sensors has this error. Except at resonances,
        # wrong masses and stiffness change a field in phase with it.
        gain = field / np.sqrt(self.fit.measurement.known.sum(axis=1)[valid])
        gain_error = rms(np.hypot(gain, magnitude[valid]))
        phase_error = rms(np.hypot(math.sqrt(0.5) * gain, phase[valid]))
        return {
            "gain": max(gain_error, _MIN_UNCERTAINTY),
            "phase_deg": math.degrees(max(phase_error, _MIN_UNCERTAINTY)),
            "field": field,
            "common_gain": math.sqrt(_variances(common.real, covariance, of_sensors)),
        }

    @property
    def _missing_fields(self) -> FloatArray:
        """Part of the fitted responses that the rig cannot express, relative (f, n).

        ERAs stay at their fitted positions, since a rig states position errors separately.
        """
        x = np.where(self.plate.space.of("place"), self.fit.x, self.plain.x)
        responses = self.plate.responses(x)
        predicted = self.fit.predicted
        measurement = self.fit.measurement
        gains = gains_of(responses, measurement.values, measurement.weight)
        missing = gains[:, None] * responses - predicted
        missing_power = np.where(measurement.known, np.abs(missing) ** 2, 0.0).sum(axis=1)
        power = np.where(measurement.known, np.abs(predicted) ** 2, 0.0).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.sqrt(missing_power / power))

    @property
    def _place_error(self) -> float:
        """RMS error of the ERA positions in the rig, per coordinate [m].

        If the fitted position is not significant, the error of the original position counts. If the
        data determine a position less well than its prior, the original uncertainty counts.
        """
        space = self.plate.space
        kind = PARAMETER_KINDS["place"]
        ignored = space.values(np.where(is_clear(self.fit), 0.0, self.fit.x), "place")
        error = space.values(self.fit.errors, "place")
        total = np.hypot(np.hypot(ignored, error), kind.theory)
        is_measured = error < math.sqrt(0.5) * kind.std
        return rms(np.where(is_measured, total, self.plate.rig.uncertainty.place))


def _variances(
    slopes: FloatArray, covariance: FloatArray, searched: NDArray[np.bool_]
) -> FloatArray:
    """Return variances (...) of functions of masked parameters (p,), from slopes (..., q)."""
    selected = covariance[np.ix_(searched, searched)]
    return np.asarray(((slopes @ selected) * slopes).sum(axis=-1))
