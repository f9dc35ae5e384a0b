"""Find the plate and wiring that explain the measured values of channels best.

    d_fsn ~ m_fn exp(i phi_fn) a_fsn(x) + noise,   m_fn near G_n

d are measured values, a the model's values, G_n the gain of a channel. Magnitudes m vary about G_n
with frequency, like in real actuators. Phases phi are free: a measurement can lack them. Both
follow from x and G, so that only x and G are searched (`model.estimate.fit`). Priors hold x near
the rig's values: a large difference is evidence against the rig.

Shapes suggest the ERA that each channel drives (`model.estimate.shape_match`). If the rig's plate
does not fit, one value of the rig is varied (`model.estimate.hypotheses`); if it fits, loads are
searched (`model.estimate.load_search`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of, rms
from model.estimate.fit import Fit, fit
from model.estimate.gains import best_gains, row_rms
from model.estimate.measurement import Measurement
from model.estimate.noise import without_outliers
from model.estimate.sensed_plate import SensedPlate
from model.estimate.shape_match import RIG_START, ShapeMatch, Start, known_median
from model.rig.rig import Rig

FALSE_ALARM = 0.01
"""False-alarm rate of a test of values, form or thickness on correct plates."""

MODEL_ERROR = 0.05
"""Error of values relative to their row's RMS: scales and positions of sensors, and model
errors.
"""

MAX_FIT_ERROR = 0.2
"""Largest RMS error of an acceptable plate, relative to the response: four times `MODEL_ERROR`."""

# With the following values a check finds all planted faults of tests/model/estimate/scenarios.yaml,
# without false alarms.

MIN_COST_REDUCTION = 20.0
"""Cost reduction that proves another wiring or conjugated phases."""

_MIN_CONFIDENCE = 0.99
"""Minimum confidence in the shape of an ERA other than the rig's."""

_GAIN_STD = 0.08
"""Standard deviation of a gain's magnitude over frequency, relative."""

_SOFT = 2.0
"""Number of standard errors above which the magnitude of a residual counts, not the square."""

_MAX_OUTLIERS = 0.05
"""Largest share of outliers among all values.

On a plate 3 % longer than in its rig, a tenth of the values look like outliers.
"""

_MIN_RATIO = 1e-6
"""Minimum ratio of measured to predicted values, so that its logarithm is finite."""


@dataclass(frozen=True, eq=False)
class Match:
    """Best fit of a plate to values of channels."""

    values: ComplexArray
    """Values (f, s, n) of the channels, NaN where unknown."""
    fit: Fit[SensedPlate]
    """Fit of the values relative to the level of each channel."""
    levels: FloatArray
    """Logarithm of each channel's level relative to the gain of the ERA that it drives (n,)."""
    model_error: float
    """Model error used to weight the values, relative to the RMS of their row."""

    @property
    def plate(self) -> SensedPlate:
        """The plate of the rig before the fit."""
        return self.fit.model

    @property
    def drives(self) -> list[int]:
        """Index of the ERA that each channel drives (n,)."""
        return [*self.fit.measurement.drives]

    @cached_property
    def rig(self) -> Rig:
        """The rig with the fitted values."""
        return self.plate.rig_at(self.fit.x)

    @cached_property
    def z(self) -> FloatArray:
        """Relative difference of each fitted value (n,); see `SensedPlate.deviations`."""
        return self.plate.deviations(self.fit.x)

    @cached_property
    def responses(self) -> ComplexArray:
        """Responses (f, s, eras) to the ERAs, without gains."""
        is_gain = self.fit.space.of("gain")
        return self.plate.responses(np.where(is_gain, 0.0, self.fit.x))

    @cached_property
    def gains(self) -> FloatArray:
        """Magnitude of the gain of each channel (n,), NaN if not used."""
        log_gains = self.fit.space.values(self.fit.x, "gain")[self.drives]
        used = np.isfinite(self.values).any(axis=(0, 1))
        return np.where(used, np.exp(self.levels + log_gains), np.nan)

    @cached_property
    def _fitted_responses(self) -> ComplexArray:
        """Responses (f, s, n) of the ERAs that the channels drive, relative to `levels`."""
        return self.fit.measurement.driven(self.fit.fitted_plate.responses)

    @cached_property
    def predicted(self) -> ComplexArray:
        """Responses (f, s, n) of the ERAs that the channels drive, with gains; NaN if not used."""
        predicted = self._fitted_responses * np.exp(self.levels)
        return np.where(np.isfinite(self.gains), predicted, np.nan)

    @cached_property
    def outliers(self) -> NDArray[np.bool_]:
        """Mask of outliers (f, s, n), which a calibration would leave out.

        Empty if there are too many. Most of a sensor's values are not counted as outliers either:
        they show a wrong plate, wiring or sensor position.
        """
        measured = np.isfinite(self.values)
        std, _ = without_outliers(self.values, self._fitted_responses)
        outliers = measured & ~np.isfinite(std)
        is_bad_sensor = outliers.sum(axis=(0, 2)) > measured.sum(axis=(0, 2)) / 2
        outliers[:, is_bad_sensor] = False
        return outliers & bool(outliers.sum() <= _MAX_OUTLIERS * measured.sum())

    def _cleaned(self, values: ComplexArray, gain_std: float) -> Measurement:
        """Return the measurement with other values (f, s, n), without outliers."""
        cleaned = np.where(self.outliers, np.nan, values)
        errors = _row_errors(cleaned, self.model_error)
        measurement = self.fit.measurement
        return replace(measurement, values=cleaned, errors=errors, gain_std=gain_std)

    @cached_property
    def residuals(self) -> FloatArray:
        """Magnitudes of the residuals relative to the RMS of their row (m,)."""
        measurement = self._cleaned(self.fit.measurement.values, self.fit.measurement.gain_std)
        no_slopes = np.zeros((*measurement.values.shape, 0))
        gain_fit = best_gains(self._fitted_responses, no_slopes, measurement)
        return self.model_error * np.abs(gain_fit.residuals)

    @property
    def error(self) -> float:
        """RMS of the residuals relative to the RMS of their row."""
        return rms(self.residuals) if len(self.residuals) else math.inf

    @property
    def median_error(self) -> float:
        """Median of the residuals relative to the RMS of their row."""
        return float(np.median(self.residuals)) if len(self.residuals) else math.inf

    @property
    def worst(self) -> float:
        """The largest of |z|."""
        return float(np.abs(self.z).max())

    @property
    def chance(self) -> float:
        """Upper bound of the fraction of correct plates with a value at least as far off."""
        return float(2 * len(self.z) * ndtr(-self.worst))

    def linearized(self) -> Fit[SensedPlate]:
        """Return the fit, linearized with free gains at every frequency."""
        space = self.plate.space
        return fit(
            self.plate,
            self._cleaned(self.values, math.inf),
            searched=space.uncertain & ~space.of("gain"),
            start=self.fit.x,
            evaluations=1,
        )


def _row_errors(values: ComplexArray, relative: float) -> FloatArray:
    """Return errors of values (f, s, n): a fraction of the RMS of their row."""
    return relative * np.broadcast_to(row_rms(values), values.shape)


def match_plate(
    plate: SensedPlate,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float = MODEL_ERROR,
    starts: Sequence[Start] = (RIG_START,),
) -> Match:
    """Fit a rig's plate at sensors to values (f, s, n) of channels.

    drives (n,): index of the ERA that each channel drives; model_error: relative to a row's RMS.
    """
    matches = []
    for start in starts:
        matches.append(_match_from(plate, plate.start(*start), values, list(drives), model_error))
    return likeliest(matches)


def _match_from(
    plate: SensedPlate,
    start: FloatArray,
    values: ComplexArray,
    drives: list[int],
    model_error: float,
) -> Match:
    """Fit a plate from a start (p,), with gains at the levels of the values; see `match_plate`."""
    space = plate.space
    gains = np.array(space.indices("gain"))[drives]
    is_driven = np.isfinite(values).any(axis=(0, 1))
    driven_gains = gains[is_driven]
    searched = space.uncertain & ~space.of("gain")
    searched[driven_gains] = True
    log_levels = _log_levels(values, plate.responses(start)[..., drives])
    gain_std = space.std[gains]
    x = start.copy()
    x[driven_gains] = (log_levels / gain_std)[is_driven]
    # Two channels can drive one ERA: each has its level relative to the gain of the last one.
    levels = np.where(is_driven, log_levels - gain_std * x[gains], 0.0)
    scaled = values / np.exp(levels)
    measurement = Measurement(
        plate.sensors,
        plate.frequencies,
        scaled,
        _row_errors(scaled, model_error),
        gain_std=_GAIN_STD,
        drives=tuple(drives),
    )
    result = fit(plate, measurement, searched=searched, start=x, soft=_SOFT)
    return Match(values=values, fit=result, levels=levels, model_error=model_error)


def _log_levels(values: ComplexArray, responses: ComplexArray) -> FloatArray:
    """Return the logarithm of the ratio of values (f, s, n) to responses (n,).

    Median over the frequencies, 0 without values.
    """
    measured = np.isfinite(values)
    ratio = row_rms(values) / row_rms(np.where(measured, responses, np.nan))
    log_ratio = np.log(np.maximum(ratio, _MIN_RATIO))[:, 0]
    known = np.where(measured.any(axis=1), log_ratio, np.nan)
    return np.nan_to_num(known_median(known))


def likeliest(matches: Sequence[Match]) -> Match:
    """Return the match with the lowest cost; if several are nearly equal, the first."""
    return best_by(matches, lambda match: -match.fit.cost)


def best_wiring(plate: SensedPlate, values: ComplexArray, shapes: ShapeMatch) -> Match:
    """Match the best plate and wiring: the rig's unless another is clearly better.

    values (f, s, n); shapes: their match with the plate.
    """
    rig_wiring = list(range(values.shape[2]))
    nearest = rig_wiring.copy()
    for channel, era in enumerate(shapes.nearest):
        if era != channel and shapes.confidence(channel, era, channel) >= _MIN_CONFIDENCE:
            nearest[channel] = era
    match = match_plate(plate, values, drives=rig_wiring, starts=shapes.starts)
    if nearest == rig_wiring:
        return match
    rewired = match_plate(plate, values, drives=nearest, starts=shapes.starts)
    scores = [-match.fit.cost, -rewired.fit.cost - MIN_COST_REDUCTION]
    return (match, rewired)[best_of(scores)]
