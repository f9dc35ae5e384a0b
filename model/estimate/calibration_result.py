"""Result of a calibration: the fitted rig with its gains, its uncertainty, and diagnostics.

The rig contains only values that a rig file can express. Its uncertainty covers the rest
(`model.estimate.calibration_uncertainty`). The fit is validated at sensors that are held out.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, Point, rms
from model.config.document import KeyPath
from model.estimate.calibration_uncertainty import CalibrationUncertainty, is_clear
from model.estimate.fit import HELD_OUT_FOLDS, Fit, JointPrior, fit
from model.estimate.fitted_values import Parameter, errors_by_key
from model.estimate.gains import gains_of, row_rms
from model.estimate.measurement import LEAST_SENSORS, Measurement
from model.estimate.noise import fit_to_noise
from model.estimate.parameters import FORM_ERRORS, jacobian
from model.estimate.sensed_plate import SensedPlate
from model.files.csv_file import as_frame
from model.rig.rig import Rig

MAX_PREDICTION_ERROR = 0.25
"""Largest relative error at held-out sensors of an acceptable fit."""


@dataclass(frozen=True)
class HeldOutSensors:
    """Prediction at sensors held out of the fit.

    Errors are RMS values over responses, relative to the RMS of all sensors at the same frequency
    and ERA.
    """

    sensors: tuple[str, ...]
    before: float
    """Error of the rig before the fit."""
    after: float
    """Error of the fitted rig."""
    median: float
    """Median error of the fitted rig."""
    unexplained: float
    """Error of the fitted rig that is explained neither by noise nor by sensor tolerances."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rig fitted to a measurement, with diagnostics of the fit and the measurement."""

    fit: Fit[SensedPlate]
    """Fit to the sensors with a signal, including form errors.

    Form errors are differences that no rig file describes, such as inaccurate cutting.
    """
    prior: JointPrior
    """Prior of the parameters: mean (p,) and covariance (p, p)."""
    dead_sensors: tuple[str, ...]
    """Sensors without a signal, left out of the fit."""
    dead_eras: tuple[str, ...]
    """ERAs that do not move the plate, left out of the fit."""

    def to_frame(self) -> Any:
        """Return parameters before and after, units and errors as a pandas DataFrame.

        One row per parameter; requires pandas.
        """
        parameters = self.parameters
        return as_frame(
            {
                "parameter": [parameter.name for parameter in parameters],
                "unit": [parameter.unit for parameter in parameters],
                "before": [parameter.before for parameter in parameters],
                "after": [parameter.value for parameter in parameters],
                "standard_error": [parameter.standard_error for parameter in parameters],
            }
        )

    @property
    def plate(self) -> SensedPlate:
        """Plate of the original rig, with the sensors of the fit."""
        return self.fit.model

    @property
    def is_good(self) -> bool:
        """Whether the fit predicts held-out sensors; False without held-out sensors."""
        return self.held_out is not None and self.held_out.after <= MAX_PREDICTION_ERROR

    @cached_property
    def rig(self) -> Rig:
        """Calibrated rig with its gains and uncertainty, without form errors."""
        eras = []
        frequencies = self.measurement.frequencies.tolist()
        for era, gains in zip(self._fitted.eras, self._gains.T.tolist(), strict=True):
            measured = []
            for frequency, gain in zip(frequencies, gains, strict=True):
                if abs(gain) > 0:
                    measured.append((frequency, abs(gain), float(np.angle(gain))))
            eras.append(replace(era, gains=tuple(measured) or era.gains))
        unexplained = self.held_out.unexplained if self.held_out else 0.0
        uncertainty = self._uncertainty.of_rig(unexplained)
        return replace(self._fitted, eras=tuple(eras), uncertainty=uncertainty)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Fitted values, with errors from the fit, the model and the total mass.

        All fitted values except losses scale with the total mass, which responses cannot determine.
        """
        return self._uncertainty.parameters

    @property
    def moved(self) -> dict[str, tuple[Point, Point]]:
        """Positions x, y [m] of ERAs that differ significantly from the rig's, and standard
        errors."""
        errors = self.plate.space.values(self.fit.errors, "place").reshape(-1, 2).tolist()
        moved = {}
        for number, original in enumerate(self.plate.rig.eras):
            era = self._fitted.eras[number]
            if (era.x, era.y) != (original.x, original.y):
                x_error, y_error = errors[number]
                moved[era.name] = ((era.x, era.y), (x_error, y_error))
        return moved

    @cached_property
    def gains_error(self) -> FloatArray:
        """Standard errors of the rig's gains (f, eras), NaN where not measured."""
        size = np.abs(self.gains_of_fit)
        fit_error = size * self._uncertainty.relative_gain_errors
        return np.asarray(np.hypot(fit_error, np.abs(self._gains) - size))

    @property
    def scales(self) -> dict[str, tuple[float, float]]:
        """Scale and standard error of sensors whose scale is wrong, or of all sensors on request.

        Scales are relative to the median of the other sensors.
        """
        errors = self.plate.space.values(self.fit.errors, "sensor_scale").tolist()
        pairs = zip(self.sensor_scales.tolist(), errors, strict=True)
        by_name = zip(self.measurement.names, pairs, strict=True)
        return dict(compress(by_name, self.is_rescaled))

    @property
    def outlier_count(self) -> int:
        """Number of measured values left out of the fit."""
        return self.value_count - int(self.measurement.known.sum())

    @property
    def value_count(self) -> int:
        """Number of measured values."""
        return int(np.isfinite(self.measurement.values).sum())

    @property
    def error(self) -> float:
        """Relative error of the fit with form errors; see `HeldOutSensors`."""
        return self._relative_error(self.fit.predicted, self.measurement.known)

    @property
    def chi2(self) -> float:
        """chi² per degree of freedom; about 1 for a good fit."""
        return self.fit.chi2

    @property
    def measurement(self) -> Measurement:
        """Responses of the sensors with a signal, with the errors of the fit."""
        return self.fit.measurement

    @property
    def measured(self) -> ComplexArray:
        """Measured responses (f, s, eras) [1/s²], divided by the scales of the sensors."""
        return self.measurement.values / self.sensor_scales[:, None]

    @property
    def before(self) -> ComplexArray:
        """Responses of the original rig (f, s, eras) [1/s²]."""
        gains = np.array([era.gain(self.measurement.frequencies) for era in self.plate.rig.eras]).T
        return gains[:, None] * self.plate.responses()

    @property
    def after(self) -> ComplexArray:
        """Responses of the calibrated rig (f, s, eras) [1/s²]."""
        return self._gains[:, None] * self._fields

    @cached_property
    def held_out(self) -> HeldOutSensors | None:
        """Prediction of the responses of some sensors by a fit without them.

        These sensors have a known scale. The prediction uses the rig as written to its file,
        without other form errors. None if too few sensors remain for a fit.
        """
        hidden = self._hidden_sensors()
        if hidden is None:
            return None
        partial = self._fitted_without(hidden)
        values = self.measurement.values
        scales = self.sensor_scales[:, None]
        predicted = partial.after * scales
        valid = self.measurement.known & hidden[:, None]
        size = row_rms(values)
        errors = (np.abs(predicted - values) / size)[valid]
        explained = (self._reading_variance(partial._gains) / size**2)[valid]
        unexplained = np.median(errors**2) - np.median(explained)
        return HeldOutSensors(
            sensors=tuple(compress(self.measurement.names, hidden)),
            before=self._relative_error(
                self.before * scales, np.isfinite(values) & hidden[:, None]
            ),
            after=self._relative_error(predicted, valid),
            median=float(np.median(errors)),
            # The median of |z|² is log 2 of its mean.
            unexplained=math.sqrt(max(unexplained, 0.0) / math.log(2)),
        )

    def _hidden_sensors(self) -> NDArray[np.bool_] | None:
        """Return a mask (s,) of evenly spaced sensors to hold out, whose scale is known.

        None if too few sensors remain for a fit.
        """
        count = len(self.measurement.names)
        candidates = np.flatnonzero(~self.is_rescaled | self.is_rescaled.all())
        hidden_count = max(round(count / HELD_OUT_FOLDS), 1)
        if count - hidden_count < LEAST_SENSORS or len(candidates) <= hidden_count:
            return None
        spaced = np.linspace(0, len(candidates) - 1, hidden_count + 2)[1:-1].round().astype(int)
        return np.isin(np.arange(count), candidates[spaced])

    def _fitted_without(self, hidden: NDArray[np.bool_]) -> "Calibration":
        """Fit again without sensors (s,)."""
        space = self.plate.space
        searched = self.fit.searched.copy()
        searched[space.groups["sensor_scale"]] &= ~hidden
        searched[space.groups["sensor_place"]] &= np.repeat(~hidden, 2)
        measurement = self.measurement.part(~hidden[:, None])
        partial = replace(self, fit=replace(self.fit, measurement=measurement))
        return partial.fitted_again(searched, self.fit.x)

    def _reading_variance(self, gains: ComplexArray) -> FloatArray:
        """Variance of readings (f, s, eras) due to noise and the tolerances of sensors.

        gains (f, eras): of the prediction.
        """
        of_sensors = self.plate.space.of("sensor_scale", "sensor_place")
        slopes = jacobian(self.fit.fitted_plate, of_sensors)[..., of_sensors]
        variance = (np.abs(gains[:, None, :, None] * slopes) ** 2).sum(axis=-1)
        return np.asarray(variance + 2 * self.measurement.std**2)

    @property
    def sensor_scales(self) -> FloatArray:
        """Scales of all sensors (s,); unknown scales are relative to their median."""
        scales = 1 + self.plate.space.values(self.fit.x, "sensor_scale")
        return scales / self._common_scale

    @property
    def is_rescaled(self) -> NDArray[np.bool_]:
        """Mask of the sensors whose scale exceeds any tolerance (s,)."""
        part = self.plate.space.groups["sensor_scale"]
        return self.prior.covariance.diagonal()[part] > 1

    @property
    def gains_of_fit(self) -> ComplexArray:
        """Gains of the fit with form errors (f, eras), NaN where not measured."""
        return self.fit.gains * self._common_scale

    def fitted_again(self, searched: NDArray[np.bool_], start: FloatArray) -> "Calibration":
        """Fit the parameters of a mask (p,), starting from values of all parameters (p,)."""
        result = fit_to_noise(
            self.plate, self.measurement, searched=searched, start=start, prior=self.prior
        )
        return replace(self, fit=result)

    @property
    def _common_scale(self) -> float:
        """Median scale if all scales are unknown, because responses cannot separate it from the
        gains."""
        if not self.is_rescaled.all():
            return 1.0
        return float(np.median(1 + self.plate.space.values(self.fit.x, "sensor_scale")))

    def _relative_error(self, predicted: ComplexArray, valid: NDArray[np.bool_]) -> float:
        """RMS error at the values of a mask, relative to the RMS of rows; infinite for an empty
        mask."""
        if not valid.any():
            return math.inf
        values = self.measurement.values
        errors = np.abs(predicted - values) / row_rms(values)
        return rms(errors[valid])

    @cached_property
    def _plain(self) -> Fit[SensedPlate]:
        """Fit of the plate without form errors, which a rig file cannot express.

        Form errors count as noise. A form error that resembles another modulus or loss factor, such
        as a longer side, is absorbed by these. ERAs stay at their significant positions.
        """
        space = self.plate.space
        refitted = space.of("modulus", "loss_added", "sensor_scale", "sensor_place")
        form_errors = space.of(*FORM_ERRORS, "mode_shifts") & ~refitted
        x = self.fit.x.copy()
        x[form_errors | (space.of("place") & ~is_clear(self.fit))] = 0.0
        searched = self.fit.searched & refitted
        return fit(self.plate, self.measurement, searched=searched, start=x, prior=self.prior)

    @cached_property
    def _uncertainty(self) -> CalibrationUncertainty:
        """Errors of the fitted values, gains and fields."""
        return CalibrationUncertainty(self.fit, self._plain)

    @cached_property
    def _fitted(self) -> Rig:
        """Rig without form errors, with ERAs at their significant positions and the original
        gains."""
        return self.plate.rig_at(self._plain.x, "place")

    @cached_property
    def _fields(self) -> ComplexArray:
        """Responses of the rig without form errors and gains (f, s, eras) [1/s²]."""
        plain = replace(self.plate, form=None, viscous_change=None)
        return plain.with_rig(self._fitted).responses()

    @cached_property
    def _gains(self) -> ComplexArray:
        """Best-fitting gains for these responses (f, eras), NaN if not measured."""
        responses = self._fields * self.sensor_scales[:, None]
        return gains_of(responses, self.measurement.values, self.measurement.weight)


def calibration_errors(calibration: Calibration) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    parameters = calibration.parameters
    errors = [parameter.standard_error for parameter in parameters]
    return errors_by_key(calibration.rig, zip(parameters, errors, strict=True))
