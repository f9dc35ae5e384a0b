"""Calibrate a rig: fit it to measured responses, validate it at held-out sensors, and report it.

    d_fsn = g_fn a_fsn(x) + noise

d are measured values at frequency f, sensor s and ERA n; a are the model's, multiplied by the
sensors' scales; g is a complex gain per frequency and ERA. x contains the rig's values and the
plate's form errors, in standard deviations of data sheets and tolerances.

`check_consistency` comes first: it rejects responses that contradict their metadata. Dead channels
and outliers are left out. The fitted rig contains only values that a rig file can express, with the
remaining uncertainty.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, Point, best_of, rms
from model.config.document import KeyPath
from model.errors import InputError
from model.estimate.findings import Verdict, cycles
from model.estimate.fit import (
    HELD_OUT_FOLDS,
    Fit,
    Parameter,
    SensedPlate,
    are_impossible,
    errors_by_key,
    fit,
    fit_to_noise,
    gains_of,
    plate_of,
    row_rms,
    without_outliers,
)
from model.estimate.forward import MASS_CELLS, jacobian, viscous_difference
from model.estimate.measurement import (
    LEAST_SENSORS,
    Measurement,
    check_enough_sensors,
)
from model.estimate.parameters import FORM_ERRORS, PARAMETER_KINDS
from model.estimate.plate_match import MAX_FIT_ERROR
from model.estimate.rig_check import diagnose
from model.files.csv_file import as_frame
from model.processes import Progress, unseen
from model.quantities import in_display_unit
from model.rig.rig import Rig, Uncertainty

MAX_PREDICTION_ERROR = 0.25
"""Largest relative error at held-out sensors of an acceptable fit."""

MAX_OUTLIERS = 0.1
"""Largest fraction of values left out of an acceptable fit."""

_MAX_FREQUENCIES = 16  # enough for every check before a calibration
_LEAST = 1e-4  # of an uncertainty; no fit is exact

# Relative model errors: of all values except the loss factor, and of the loss factor. Unmodelled
# form errors widen resonances by 0.4 % (RMS over plates without noise).
_MODEL_ERROR, _LOSS_ERROR = 2e-3, 4e-3
_FOREIGN_MASS = PARAMETER_KINDS["foreign_mass"].std * math.sqrt(
    MASS_CELLS.cell_count
)  # of the plate's

_UNKNOWN = 100.0  # standard deviations, for parameters without a prior
_AT_BOUND = 1e-6  # standard deviations from the bound
_WRONG_SCALE = 0.02  # common tolerance of sensors
_SIGNIFICANCE = 4.0  # standard errors
_CLEAR = 3.0  # standard errors of a significant difference
_MAX_GAIN = 5.0  # of a drive at one frequency relative to its median, up or down
_MAX_SIDE = 4.0  # tolerances by which a side of the plate can be off


@dataclass(frozen=True, eq=False)
class Screening:
    """Result of checking responses before a fit."""

    dead_eras: NDArray[np.bool_]
    """Mask (e,) of the ERAs that do not move the plate."""
    dead_sensors: NDArray[np.bool_]
    """Mask (s,) of the sensors with almost no signal."""
    start: FloatArray
    """Fitted values (n,) of the most likely plate, in the order of `SensedPlate.numbers`."""

    def live(self, measured: Measurement) -> Measurement:
        """Return the responses of the sensors and ERAs that are not dead."""
        live = measured.without(self.dead_sensors)
        return replace(live, values=np.where(self.dead_eras, np.nan, live.values))


def check_consistency(rig: Rig, responses: Measurement) -> Screening:
    """Check that responses agree with their metadata, and find dead channels.

    A fit can absorb almost any measurement error: gains absorb wrong units, springs a swapped plug,
    outlier rejection whole sensors. Raises InputError with the cause: too few sensors or
    frequencies, wrong quantity or unit, grain along the other side, free and mounted resonance
    confused, conjugated phases, sensors at swapped positions, swapped or inverted channels.
    """
    rows = np.unique(
        np.linspace(0, len(responses.frequencies) - 1, _MAX_FREQUENCIES).round().astype(int)
    )
    some, values = responses.frequencies[rows], responses.values[rows]
    observation = replace(responses, frequencies=some, values=values, errors=None)
    if observation.count and not (np.abs(values) > 0).any():
        raise InputError("measured responses must not all be zero; check that ERAs were driven")
    # A calibration corrects wrong plate values, so these are no reason to reject.
    verdict = diagnose(rig, observation, false_alarm=0.0, refuses=True)
    _check_wiring(verdict)
    best = verdict.hypotheses[0] if verdict.hypotheses else None
    if best and best.key in ("plate.length", "plate.width") and best.match.error <= MAX_FIT_ERROR:
        raise _wrong_size(best.key, best.expected, best.value)
    assert verdict.match is not None  # noqa: S101  some channels have the rig's gain
    return Screening(
        np.array(["dead" in channel.states for channel in verdict.channels]),
        np.isin(responses.names, [each.of for each in verdict.of_kinds("silent", "mute")]),
        verdict.match.fit.x[verdict.match.plate.numbers],
    )


def _check_wiring(verdict: Verdict) -> None:
    """Raise InputError for channels that drive another ERA or have inverted polarity."""
    for cycle in cycles(verdict.channels):
        raise InputError(
            "channels must drive the ERAs of the rig; the channels of "
            f"{_joined([each.era for each in cycle])} appear to be swapped. Correct the plugs, the "
            "names in the file, or the channels in the rig (or the sensors' positions if they are "
            "mirrored), and measure again"
        )
    for channel in verdict.channels:
        if "other ERA" in channel.states:
            raise InputError(
                f"channels must drive the ERAs of the rig; the channel of {channel.era} appears to "
                f"drive ERA {channel.drives}. Correct the plug or the names in the file"
            )
    inverted = [channel.era for channel in verdict.channels if "inverted" in channel.states]
    if inverted:
        raise InputError(
            f"signs must be positive upwards for sensors and ERAs, got inverted signs for "
            f"{_joined(inverted)}; swap their two wires, or turn the sensors over if all "
            "are inverted"
        )


def _joined(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


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

    plate: SensedPlate
    """Plate of the original rig, with the sensors of the fit."""
    fit: Fit
    """Fit to the sensors with a signal, including form errors.

    Form errors are deviations that no rig file describes, such as inaccurate cutting.
    """
    prior: tuple[FloatArray, FloatArray]
    """Prior of the parameters: mean (p,) and covariance (p, p)."""
    dead_sensors: tuple[str, ...]
    """Sensors without a signal, left out of the fit."""
    dead_eras: tuple[str, ...]
    """ERAs that do not move the plate, left out of the fit."""

    def to_frame(self) -> Any:
        """Return parameters before and after, units and errors as a pandas DataFrame.

        One row per parameter; requires pandas.
        """
        return as_frame(
            {
                "parameter": [each.name for each in self.parameters],
                "unit": [each.unit for each in self.parameters],
                "before": [each.before for each in self.parameters],
                "after": [each.value for each in self.parameters],
                "standard_error": [each.standard_error for each in self.parameters],
            }
        )

    @property
    def is_good(self) -> bool:
        """Whether the fit predicts held-out sensors; False without held-out sensors."""
        return self.held_out is not None and self.held_out.after <= MAX_PREDICTION_ERROR

    @cached_property
    def rig(self) -> Rig:
        """Calibrated rig with its gains and uncertainty, without form errors."""
        eras = []
        for era, gains in zip(self._fitted.eras, self._gains.T.tolist(), strict=True):
            rows = zip(self.measurement.frequencies.tolist(), gains, strict=True)
            stated = tuple((f, abs(g), float(np.angle(g))) for f, g in rows if abs(g) > 0)
            eras.append(replace(era, gains=stated or era.gains))
        return replace(self._fitted, eras=tuple(eras), uncertainty=self._uncertainty)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Fitted values, with errors from the fit, the model and the total mass.

        All fitted values except losses scale with the total mass, which responses cannot determine.
        """
        plate, x, space = self.plate, self.fit.x, self.plate.model.space
        sides = PARAMETER_KINDS["side"].std / np.array(
            [plate.rig.plate.length, plate.rig.plate.width]
        )
        of_mass = math.hypot(_FOREIGN_MASS, *sides)
        distance = np.abs(np.array([space.lower, space.upper]) - x).min(axis=0)
        found = []
        for number, row, value, error in zip(
            plate.numbers,
            plate.rows,
            plate.values(x),
            plate.errors(x, self.fit.errors),
            strict=True,
        ):
            share = (
                self._loss_error if row.kind == "loss_factor" else math.hypot(_MODEL_ERROR, of_mass)
            )
            whole = math.hypot(float(error), share * float(value))
            is_free = bool(self.fit.searched[number])
            found.append(
                replace(
                    row,
                    value=float(value),
                    standard_error=whole if is_free else None,
                    at_bound=is_free and bool(distance[number] < _AT_BOUND),
                )
            )
        return tuple(found)

    @property
    def moved(self) -> dict[str, tuple[Point, Point]]:
        """Positions x, y [m] of ERAs that differ significantly from the rig's, and standard
        errors."""
        errors = self.plate.model.space.values(self.fit.errors, "place").reshape(-1, 2)
        return {
            era.name: ((era.x, era.y), (float(error[0]), float(error[1])))
            for era, before, error in zip(
                self._fitted.eras, self.plate.rig.eras, errors, strict=True
            )
            if (era.x, era.y) != (before.x, before.y)
        }

    @cached_property
    def gains_error(self) -> FloatArray:
        """Standard errors of the rig's gains (f, eras), NaN where not measured."""
        slopes, of_noise = self._gain_changes
        variance = _variances(slopes.real, self.fit.covariance, self.fit.searched)
        size = np.abs(self.gains_of_fit)
        own = size * np.sqrt(of_noise + variance)
        return np.asarray(np.hypot(own, np.abs(self._gains) - size))

    @property
    def scales(self) -> dict[str, tuple[float, float]]:
        """Scale and standard error of sensors whose scale is wrong, or of all sensors on request.

        Scales are relative to the median of the other sensors.
        """
        errors = self.plate.model.space.values(self.fit.errors, "sensor_scale").tolist()
        rows = zip(
            self.measurement.names,
            self.sensor_scales.tolist(),
            errors,
            self.is_rescaled,
            strict=True,
        )
        return {name: (scale, error) for name, scale, error, is_free in rows if is_free}

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
        return np.asarray(self.measurement.values / self.sensor_scales[:, None])

    @property
    def before(self) -> ComplexArray:
        """Responses of the original rig (f, s, eras) [1/s²]."""
        gains = np.array([era.gain(self.measurement.frequencies) for era in self.plate.rig.eras]).T
        return np.asarray(gains[:, None] * self.plate.responses())

    @property
    def after(self) -> ComplexArray:
        """Responses of the calibrated rig (f, s, eras) [1/s²]."""
        return np.asarray(self._gains[:, None] * self._fields)

    @cached_property
    def held_out(self) -> HeldOutSensors | None:
        """Prediction of the responses of some sensors by a fit without them.

        These sensors have a known scale. The prediction uses the rig as written to its file,
        without other form errors. None if too few sensors remain for a fit.
        """
        count, space = len(self.measurement.names), self.plate.model.space
        candidates = np.flatnonzero(~self.is_rescaled | self.is_rescaled.all())
        wanted = max(round(count / HELD_OUT_FOLDS), 1)
        if count - wanted < LEAST_SENSORS or len(candidates) <= wanted:
            return None
        evenly_spaced = np.linspace(0, len(candidates) - 1, wanted + 2)[1:-1].round().astype(int)
        unseen = np.isin(np.arange(count), candidates[evenly_spaced])
        searched = self.fit.searched.copy()
        searched[space.groups["sensor_scale"]] &= ~unseen
        searched[space.groups["sensor_place"]] &= np.repeat(~unseen, 2)
        seen = self.measurement.part(~unseen[:, None])
        part = replace(self, fit=replace(self.fit, measurement=seen)).fitted_again(
            searched, self.fit.x
        )
        scales, which = self.sensor_scales[:, None], self.measurement.known & unseen[:, None]
        measured, predicted = self.measurement.values, part.after * scales
        size = row_rms(measured)
        error = np.abs(predicted - measured) / size
        own = space.of("sensor_scale", "sensor_place")
        read = jacobian(self.plate.model.at(self.fit.x), own)[..., own]
        variance = (np.abs(part._gains[:, None, :, None] * read) ** 2).sum(axis=-1)
        variance = variance + 2 * self.measurement.std**2
        left = np.median(error[which] ** 2) - np.median((variance / size**2)[which])
        return HeldOutSensors(
            tuple(compress(self.measurement.names, unseen)),
            self._relative_error(self.before * scales, np.isfinite(measured) & unseen[:, None]),
            self._relative_error(predicted, which),
            float(np.median(error[which])),
            math.sqrt(max(left, 0.0) / math.log(2)),  # the median of |z|² is log 2 of its mean
        )

    @property
    def sensor_scales(self) -> FloatArray:
        """Scales of all sensors (s,); unknown scales are relative to their median."""
        scales = 1 + self.plate.model.space.values(self.fit.x, "sensor_scale")
        return scales / self._common_scale

    @property
    def is_rescaled(self) -> NDArray[np.bool_]:
        """Mask of the sensors whose scale exceeds any tolerance (s,)."""
        own = self.plate.model.space.groups["sensor_scale"]
        return np.asarray(self.prior[1].diagonal()[own] > 1)

    @property
    def gains_of_fit(self) -> ComplexArray:
        """Gains of the fit with form errors (f, eras), NaN where not measured."""
        return self.fit.gains * self._common_scale

    def fitted_again(self, searched: NDArray[np.bool_], start: FloatArray) -> "Calibration":
        """Fit the parameters of a mask (p,), starting from values of all parameters (p,)."""
        found = fit_to_noise(
            self.plate.model,
            self.measurement,
            searched=searched,
            start=start,
            prior=self.prior,
        )
        return replace(self, fit=found)

    @property
    def _common_scale(self) -> float:
        """Median scale if all scales are unknown, because responses cannot separate it from the
        gains."""
        scales = 1 + self.plate.model.space.values(self.fit.x, "sensor_scale")
        return float(np.median(scales)) if self.is_rescaled.all() else 1.0

    def _relative_error(self, predicted: ComplexArray, which: NDArray[np.bool_]) -> float:
        """RMS error at the values of a mask, relative to the RMS of rows; infinite for an empty
        mask."""
        values = self.measurement.values
        error = np.abs(predicted - values) / row_rms(values)
        return rms(error[which]) if which.any() else math.inf

    @cached_property
    def is_clear(self) -> NDArray[np.bool_]:
        """Mask of the parameters that differ from the rig by several standard errors (p,)."""
        return np.asarray(np.abs(self.fit.x) > _CLEAR * self.fit.errors)

    @cached_property
    def _plain(self) -> Fit:
        """Fit of the plate without form errors, which a rig file cannot express.

        Form errors count as noise. A form error that resembles another modulus or loss factor, such
        as a longer side, is absorbed by these. ERAs stay at their significant positions.
        """
        space, x = self.plate.model.space, self.fit.x.copy()
        mine = space.of("modulus", "loss_added", "sensor_scale", "sensor_place")
        form = space.of(*FORM_ERRORS, "mode_shifts") & ~mine
        x[form | (space.of("place") & ~self.is_clear)] = 0.0
        searched, measurement = self.fit.searched & mine, self.measurement
        return fit(self.plate.model, measurement, searched=searched, start=x, prior=self.prior)

    @cached_property
    def _fitted(self) -> Rig:
        """Rig without form errors, with ERAs at their significant positions and the original
        gains."""
        return self.plate.rig_at(self._plain.x, "place")

    @cached_property
    def _fields(self) -> ComplexArray:
        """Responses of the rig without form errors and gains (f, s, eras) [1/s²]."""
        before = self.plate.model
        model = replace(before, form=None, law=None, last_places={})
        return replace(self.plate, model=model).of(self._fitted).responses()

    @cached_property
    def _gains(self) -> ComplexArray:
        """Best-fitting gains for these responses (f, eras), NaN if not measured."""
        return self._gains_for(self._fields * self.sensor_scales[:, None])

    def _gains_for(self, model: ComplexArray) -> ComplexArray:
        """Best-fitting gains (f, eras) for responses (f, s, eras), NaN if not measured."""
        return gains_of(model, self.measurement.values, self.measurement.weight)

    @cached_property
    def _gain_changes(self) -> tuple[ComplexArray, FloatArray]:
        """Relative change of the gains per searched parameter (f, eras, q); variances due to
        noise."""
        fit, space = self.fit, self.plate.model.space
        power = (np.abs(self.measurement.weight * fit.predicted) ** 2).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = fit.gain_slopes / fit.gains[..., None]
            of_noise = np.where(power > 0, max(fit.chi2, 1.0) / power, np.nan)
        # A force factor and the gain are fitted together: only their product moves the plate.
        numbers = np.flatnonzero(fit.searched)
        for era, factor in enumerate(space.indices("force_factor")):
            slopes[:, era, numbers == factor] += space.std[factor]
        return slopes, of_noise

    @cached_property
    def _loss_error(self) -> float:
        """Relative model error of the loss factor, including the effect of all dampers."""
        plate, kinds = self.plate, np.array([row.kind for row in self.plate.rows])
        values = plate.values(self.fit.x) / plate.model.space.scale[plate.numbers]
        size = np.where(values > 0, values, np.inf)
        covariance = self.fit.covariance[np.ix_(plate.numbers, plate.numbers)]
        relative = covariance / np.outer(size, size)
        dampers = (kinds == "damping") & self.fit.searched[plate.numbers]
        by_dampers = relative[dampers][:, kinds == "loss_factor"].sum(axis=1)
        slopes = np.linalg.lstsq(relative[np.ix_(dampers, dampers)], by_dampers)[0]
        return math.hypot(_LOSS_ERROR, _MODEL_ERROR * float(slopes.sum()))

    @cached_property
    def _uncertainty(self) -> Uncertainty:
        """Uncertainty of the calibrated rig, for its file.

        Excludes the error of the total mass, which scales all values and changes no pattern.
        Thickness represents the plate's rigidity: 1 % of modulus shifts modes like 0.5 % of
        thickness. Values that are not identified keep the original uncertainty.
        """
        before, x = self.plate.rig.uncertainty, self.fit.x
        # An exciter's coil both damps and drives; the contribution of its suspension hardly shows
        # alone.
        coils = [row.name for row in self.plate.of_exciters if row.kind == "damping"]
        errors = self.plate.errors(x, self.fit.errors).tolist()

        def relative(
            kind: str, theory: float = _MODEL_ERROR, unidentified: float = math.inf
        ) -> float:
            """RMS error of all values of a kind."""
            shares = [
                math.hypot(error / one.value, theory) if one.is_identified else unidentified
                for one, error in zip(self.parameters, errors, strict=True)
                if one.kind == kind and one.name not in coils
                if one.value > 0 or not one.is_identified
            ]
            return rms(shares)

        losses = relative("loss_factor", self._loss_error), relative("damping")
        fitted = self._field_errors | {
            "place": self._place_error,
            "stiffness": relative("stiffness"),
            "damping": math.expm1(max(losses)),
            "supports": relative(
                "supports", unidentified=math.hypot(before.supports, _MODEL_ERROR)
            ),
        }
        if not any(one.foot for one in self.parameters):
            del fitted["supports"]
        # An error is rarely known to more than two digits.
        fitted = {key: float(f"{each:.2g}") for key, each in fitted.items() if each < math.inf}
        if "damping" in fitted:
            fitted["damping"] += 1
        if self.parameters[0].is_identified:
            # The fitted modulus reproduces the frequencies, including the effect of form errors.
            plain, value = self._plain, self.plate.values(self._plain.x)[0]
            of_plain = self.plate.errors(plain.x, plain.errors)[0]
            of_modulus = math.hypot(of_plain / value, _MODEL_ERROR)
            fitted |= Uncertainty.of_frequency(float(f"{of_modulus / 2:.2g}"))
        return Uncertainty.clipped(**asdict(before) | fitted)

    @property
    def _field_errors(self) -> dict[str, float]:
        """Errors of gains and fields by key of `uncertainty`; missing if an ERA has no gain.

        `field` is the part of the fitted fields that the rig cannot express (form errors), and at
        least the unexplained error at held-out sensors. `gain` and `phase` are the errors of the
        best gains for such fields, as measured by the sensors; other errors change gains and fields
        in opposite directions.
        """
        slopes, of_noise = self._gain_changes
        lacking, covariance = self._lacking, self.fit.covariance
        # Other fitted parameters change gain and field in opposite directions: sensors measure the
        # product.
        reads = self.plate.model.space.of("sensor_scale", "sensor_place") & self.fit.searched
        slopes = slopes[..., reads[self.fit.searched]]
        common = np.nanmean(slopes, axis=(0, 1))
        beside = slopes - common
        magnitude, phase = (
            np.sqrt(of_noise + _variances(part, covariance, reads))
            for part in (beside.real, beside.imag)
        )
        known = np.isfinite(magnitude) & np.isfinite(lacking)
        if not known.any(axis=0).all():
            return {}
        left = self.held_out.unexplained if self.held_out else 0.0
        field = max(rms(lacking[known]), left)
        # Error of the best gain if the field at n sensors has this error. Except at resonances,
        # wrong masses and stiffness change a field in phase with it.
        off = field / np.sqrt(self.measurement.known.sum(axis=1)[known])
        turned = rms(np.hypot(math.sqrt(0.5) * off, phase[known]))
        return {
            "gain": max(rms(np.hypot(off, magnitude[known])), _LEAST),
            "phase_deg": math.degrees(max(turned, _LEAST)),
            "field": field,
            "common_gain": math.sqrt(_variances(common.real, covariance, reads)),
        }

    @property
    def _lacking(self) -> FloatArray:
        """Part of the fitted responses that the rig cannot express, relative (f, eras).

        ERAs stay at their fitted positions, since a rig states position errors separately.
        """
        at_places = np.where(self.plate.model.space.of("place"), self.fit.x, self._plain.x)
        model, known = self.plate.responses(at_places), self.measurement.known
        lacks = self._gains_for(model)[:, None] * model - self.fit.predicted
        squares, all_squares = (
            np.where(known, np.abs(each) ** 2, 0.0).sum(axis=1)
            for each in (lacks, self.fit.predicted)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.sqrt(squares / all_squares))

    @property
    def _place_error(self) -> float:
        """RMS error of the ERA positions in the rig, per coordinate [m].

        If the fitted position is not significant, the error of the original position counts. If the
        data determine a position less well than its prior, the original uncertainty counts.
        """
        space, kind = self.plate.model.space, PARAMETER_KINDS["place"]
        kept, error = (
            space.values(each, "place")
            for each in (np.where(self.is_clear, 0.0, self.fit.x), self.fit.errors)
        )
        whole = np.hypot(np.hypot(kept, error), kind.theory)
        by_data = error < math.sqrt(0.5) * kind.std
        return rms(np.where(by_data, whole, self.plate.rig.uncertainty.place))


def calibrate(
    rig: Rig,
    measured: Measurement,
    *,
    all_scales: bool = False,
    progress: Progress = unseen,
) -> Calibration:
    """Fit a rig to responses measured on it, after checking them with `check_consistency`.

    all_scales: estimate the scale of every sensor, not only of sensors with a wrong scale;
    progress: called with the number of fits done and the total. Raises InputError if fewer than
    three sensors have a signal, for a plate of another size, for impossible gains, and for
    suspensions or feet at a bound.
    """
    # All scales are free at first, so that a wrong one does not bias the fit.
    found = _fitted_with_scales(rig, measured, check_consistency(rig, measured))
    progress(1, 3)  # all scales free; identified parameters; without held-out sensors
    scales, space = found.sensor_scales, found.plate.model.space
    error = space.values(found.fit.errors, "sensor_scale")
    is_wrong = np.abs(scales - 1) > np.maximum(_WRONG_SCALE, _SIGNIFICANCE * error)
    is_unknown = is_wrong | all_scales
    start, own = found.fit.x.copy(), space.groups["sensor_scale"]
    start[own] = (np.where(is_unknown, scales, 1.0) - 1) / space.std[own]
    found = replace(found, prior=_prior(found.plate, start, is_unknown))
    found = _identified(found.fitted_again(found.fit.searched, start))
    progress(2, 3)
    _check_sides(found)
    _check_gains(found)
    _check_suspensions(found)
    if found.outlier_count > MAX_OUTLIERS * found.value_count:
        out, count = found.outlier_count, found.value_count
        raise InputError(
            f"outliers must be at most {100 * MAX_OUTLIERS:g} % of the values, got {out} of "
            f"{count} ({100 * out / count:.0f} %); check that it is this plate, names and "
            "positions of sensors and ERAs, and loose contacts"
        )
    for stated in ("held_out", "rig"):
        getattr(found, stated)  # more fits, counted by progress
    progress(3, 3)
    return found


def _fitted_with_scales(rig: Rig, measured: Measurement, screened: Screening) -> Calibration:
    """Fit with free scales of all sensors; leave out sensors with mostly outliers."""
    while True:
        dead = screened.dead_sensors.copy()
        check_enough_sensors(~dead, measured)
        measurement = replace(screened.live(measured), gain_std=math.inf)
        plate = plate_of(rig, measurement, has_form=True)
        space = plate.model.space
        start = np.zeros(space.size)
        start[plate.numbers] = screened.start
        std, scales = without_outliers(measurement.values, plate.responses(start))
        count = np.isfinite(measurement.values).sum(axis=(0, 2))
        heard = np.isfinite(std).sum(axis=(0, 2)) > count / 2
        if heard.all():
            break
        dead[~dead] = ~heard  # elsewhere, or loose
        screened = replace(screened, dead_sensors=dead)
    measurement = replace(measurement, errors=std)
    start[space.groups["sensor_scale"]] = (scales - 1) / PARAMETER_KINDS["sensor_scale"].std
    prior = _prior(plate, start, np.ones(len(scales), dtype=bool))
    searched = space.uncertain & ~space.of("gain")
    for _ in range(2):  # the effect of viscous losses changes little with the parameters
        law = viscous_difference(replace(plate.model, law=None), start)
        plate = replace(plate, model=replace(plate.model, law=law))
        found = fit_to_noise(plate.model, measurement, searched=searched, start=start, prior=prior)
        measurement, start = found.measurement, found.x
    return Calibration(
        plate,
        found,
        prior,
        tuple(compress(measured.names, dead)),
        tuple(compress((era.name for era in rig.eras), screened.dead_eras)),
    )


def _prior(
    plate: SensedPlate, start: FloatArray, is_unknown: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return the prior mean (p,) and covariance (p, p) of the parameters.

    Only data sheets and feet constrain the rig's values. Scales of sensors in a mask (s,) are free;
    the others are constrained around a start (p,). If all scales are free, responses cannot
    separate their common factor from the gains, so the median of good sensors is constrained.
    """
    space = plate.model.space
    own = np.arange(space.size)[space.groups["sensor_scale"]]
    mean, deviations = np.zeros(space.size), np.ones(space.size)
    deviations[plate.numbers[plate.largest_errors == 1]] = _UNKNOWN
    deviations[own[is_unknown]] = _UNKNOWN
    mean[own[is_unknown]] = start[own[is_unknown]]
    covariance = np.diag(deviations**2)
    if is_unknown.all():
        count = len(own)
        covariance[np.ix_(own, own)] += (math.pi / 2 - _UNKNOWN**2) / count
    return mean, covariance


def _identified(found: Calibration) -> Calibration:
    """Fix parameters that the data determine less well than their prior, and fit again."""
    while True:
        plate, searched = found.plate, found.fit.searched.copy()
        errors = found.fit.errors[plate.numbers] / plate.largest_errors
        excess = np.where(searched[plate.numbers], errors, 0)
        # Values of a poorly fitting plate are meaningless.
        if not excess.max() > 1 or found.error > MAX_PREDICTION_ERROR:
            return found
        least, x = plate.numbers[best_of(excess)], found.fit.x.copy()
        searched[least], x[least] = False, 0.0
        found = found.fitted_again(searched, x)


def _check_sides(found: Calibration) -> None:
    """Raise InputError if a plate of another size fits the responses better."""
    if found.error > MAX_PREDICTION_ERROR:
        return
    plate, space = found.plate.rig.plate, found.plate.model.space
    offs = space.values(found.fit.x, "side").tolist()
    for key, side, off in zip(("length", "width"), (plate.length, plate.width), offs, strict=True):
        if abs(off) > _MAX_SIDE * PARAMETER_KINDS["side"].std:
            raise _wrong_size(f"plate.{key}", side, side + off)


def _wrong_size(key: str, in_rig: float, measured: float) -> InputError:
    """Return the error for a side [m] of the plate, by key, if another size fits better."""
    rig_has, fits = (in_display_unit(side, "m", digits=4) for side in (in_rig, measured))
    return InputError(
        f"{key} must match the measured plate, got {rig_has} in the rig; the responses fit {fits}. "
        "Measure the plate and correct the rig, or use the measurement of this plate"
    )


def _check_gains(found: Calibration) -> None:
    """Raise InputError for gains that no drive can have: they would hide another plate."""
    sizes, errors = np.abs(found.gains_of_fit), found.gains_error
    for number, era in enumerate(found.plate.rig.eras):
        measured = np.isfinite(errors[:, number])
        if not measured.any():
            continue
        size = sizes[measured, number]
        relative = size / np.median(size)
        least_sure = _SIGNIFICANCE * errors[measured, number] / size
        if are_impossible(relative, math.log(_MAX_GAIN) + least_sure).any():
            raise InputError(
                f"gains of ERA {era.name} must be within a factor of {_MAX_GAIN:g} of their median "
                f"over frequency, got {relative.min():.2g} to {relative.max():.2g} times the "
                "median; check that the measurement is of this plate, its material and the "
                "positions of sensors, and measure at more positions"
            )


def _check_suspensions(found: Calibration) -> None:
    """Raise InputError for exciters and feet with a fitted stiffness at its bound."""
    names = {row.era for row in found.plate.of_exciters}
    bound = [one for one in found.parameters if one.at_bound]
    exciters = [one for one in bound if one.kind == "stiffness" and one.era in names]
    feet = [one for one in bound if one.foot]

    def factors(rows: list[Parameter]) -> str:
        return ", ".join(f"{one.value / one.before:.2g}" for one in rows)

    if exciters:
        raise InputError(
            f"stiffness of {', '.join(one.era for one in exciters)} must be close to the rig's "
            f"value, got {factors(exciters)} times it, the bound of the fit; check "
            "their resonance and resonance_is (free or mounted; era plate show prints "
            "where the glued magnets resonate), and check with era rig check that they are glued"
        )
    if feet:
        raise InputError(
            f"stiffness of feet {', '.join(one.foot for one in feet)} must be close to the rig's "
            f"value, got {factors(feet)} times it, the bound of the fit; check their "
            "kind, their positions and whether all touch the plate"
        )


def _variances(
    slopes: FloatArray, covariance: FloatArray, searched: NDArray[np.bool_]
) -> FloatArray:
    """Return variances (...) of functions of masked parameters (p,), from slopes (..., q)."""
    own = covariance[np.ix_(searched, searched)]
    return np.asarray(((slopes @ own) * slopes).sum(axis=-1))


def calibration_errors(calibration: Calibration) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    found = calibration.parameters
    return errors_by_key(calibration.rig, ((each, each.standard_error) for each in found))
