"""Identify a rig from responses measured in place: its values, their covariance and uncertainty.

`model.estimate.staged_fit` finds the most likely parameters. The measurement must determine the
quantities that answers depend on (`model.estimate.relevant_quantities`).

The fit is validated on held-out paths from an ERA to a sensor, in five folds; the reverse of a
held-out path is held out as well. Held-out paths show the error of fields that are not measured.
Held-out tones would show only whether a resonance was measured, which the covariance shows already.
Only the part of the error that neither noise nor uncertain parameters explain counts against the
model. It also makes fits to different paths disagree in their parameters beyond their covariance (a
jackknife over groups: B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans, SIAM 1982,
ch. 3).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, rms
from model.config.document import KeyPath
from model.errors import InputError
from model.estimate.fit import HELD_OUT_FOLDS, fit
from model.estimate.fitted_values import errors_by_key, parameters_of
from model.estimate.gains import are_impossible
from model.estimate.measurement import Measurement
from model.estimate.parameter_space import PlateValues, Space
from model.estimate.parameters import jacobian
from model.estimate.relevant_quantities import (
    parameter_stds,
    relevant_stds,
    std_of,
    unit_rows,
    unknowns,
)
from model.estimate.rig_parameters import rig_with
from model.estimate.staged_fit import RigFit, fit_board, mode_shift
from model.processes import Progress, unseen
from model.rig.rig import Rig, Uncertainty
from model.structure.modal_elasticity import check_measurable

MAX_CHI2 = 2.0
"""Largest chi² of a model that explains a measurement, so that answers can be promised from it."""

MAX_MODE_SHIFT = 2.0
"""Largest RMS shift of the lowest modes, relative to their prior, for a well-known plate. Beyond
it, fields between the sensors are wrong even if the sensors agree."""

# Day-to-day repeatability of a drive, which a single measurement cannot show.
_DRIVE_GAIN, _DRIVE_PHASE_DEG = 0.01, 1.0

_MIN_VALUES = 16
_GAIN_STDS = 5.0  # standard errors beyond which a gain is wrong
# Limits that apply even if the rig states a larger uncertainty.
_GAIN_ALLOWED, _PHASE_ALLOWED = 0.3, math.radians(20)
# Of the common factor of all responses; g is 9.8 m/s², an inch 25.4 mm.
_LEVEL_ALLOWED = math.log(2.5)

_MAX_PREDICTION_STD = 0.1  # of the RMS at a tone; less certain predictions prove nothing
_MIN_PREDICTED = 16  # values
_REFITTED = 8  # evaluations of a fit to the remaining paths
_IN_COMMON = 2.0  # factor on standard errors, for errors that all fits share and no path shows


@dataclass(frozen=True, eq=False)
class HeldOutPaths:
    """Prediction errors at held-out paths, RMS relative to the responses at a tone."""

    total: float
    """Without the part explained by noise."""
    unexplained: float
    """Without the part explained by noise and uncertain parameters together."""
    disagreement: FloatArray
    """Covariance (p, p) of x, to be added to the fit's covariance."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Rig identified from responses."""

    before: Rig
    """The rig as written."""
    rig: Rig
    """Rig with identified values and, if the model explains the measurement, their uncertainty."""
    fitted: RigFit
    """The most likely parameters."""
    covariance: FloatArray
    """Covariance (p, p) of the parameters, widened by the disagreement of held-out paths, for
    their standard errors."""
    held_out: HeldOutPaths | None
    """Prediction of held-out paths, None if there are too few."""

    @property
    def chi2(self) -> float:
        """Squared residuals per degree of freedom."""
        return self.fitted.chi2

    @property
    def values(self) -> PlateValues:
        """Values of the parameters, including sensor gains."""
        return self.fitted.fitted_plate.values

    @property
    def mode_shift(self) -> float:
        """RMS shift of the lowest modes, relative to their prior, 0 without any."""
        return mode_shift(self.fitted)

    @property
    def is_explained(self) -> bool:
        """Whether the model explains the measurement, so that answers can rely on it."""
        return self.chi2 <= MAX_CHI2 and self.is_known_well

    @property
    def is_known_well(self) -> bool:
        """Whether the modes match the rig's plate, and therefore also the fields between
        sensors."""
        return self.mode_shift <= MAX_MODE_SHIFT

    @property
    def can_promise(self) -> bool:
        """Whether contrasts can be promised: explained, with held-out paths."""
        return self.is_explained and self.held_out is not None

    @cached_property
    def std(self) -> FloatArray:
        """Standard error of each parameter in its unit (p,)."""
        return parameter_stds(self.fitted.space, self.covariance)

    def stds(self) -> dict[str, FloatArray]:
        """Standard errors of the quantities that answers depend on, with model errors, by
        kind."""
        return relevant_stds(self.fitted.space, self.covariance)

    def uncertainty(self, unexplained: float) -> Uncertainty:
        """Return the `uncertainty` of the identified rig.

        unexplained: fraction of the fields that the model does not explain. The disagreement of
        held-out paths is left out, because `unexplained` states the same error. Fingers and
        harmonics keep their uncertainty. common_gain, which no fit narrows, is added to the error
        of the mean gain.
        """
        space = self.fitted.space
        covariance = self.fitted.stated_covariance
        original = self.fitted.model.rig.uncertainty
        mean_gain = unit_rows(space, "gain").mean(axis=0, keepdims=True)
        mean_gain_std = std_of(mean_gain, space, covariance)[0]
        stds = relevant_stds(space, covariance)
        errors = {kind: rms(std) for kind, std in stds.items()}
        return Uncertainty.clipped(
            gain=math.hypot(errors["gain"], _DRIVE_GAIN),
            phase_deg=math.hypot(math.degrees(errors["phase"]), _DRIVE_PHASE_DEG),
            **Uncertainty.of_frequency(errors["frequency"]),
            stiffness=errors["stiffness"],
            damping=math.exp(max(errors["damping"], errors["loss"])),
            fingertip=original.fingertip,
            common_gain=math.hypot(original.common_gain, mean_gain_std),
            level=max(original.level, self.fitted.measurement.gain_by_level),
            field=unexplained,
            place=errors["place"],
            touch_position=original.touch_position,
            harmonic=original.harmonic,
            supports=rms(parameter_stds(space, covariance)[space.groups["supports"]]),
            weather=original.weather,
            foreign_mass=original.foreign_mass,
        )


def identify(rig: Rig, measurement: Measurement, *, progress: Progress = unseen) -> Identification:
    """Identify a rig from a measurement on it.

    progress: called with the number of fits done and the total (one full fit, one per fold). Raises
    InputError for a rig with a part that does not scale, for a plate that was not linear or has
    changed during the measurement, for impossible gains of drives or sensors (another unit, a wrong
    sign), and for undetermined quantities that answers depend on, with the tone and the sensor that
    would determine them.
    """
    _check(rig, measurement)
    fitted = fit_board(rig, measurement)
    board = fitted.model.rig
    identification = Identification(
        before=rig,
        rig=board,
        fitted=fitted,
        covariance=fitted.stated_covariance,
        held_out=None,
    )
    values = identification.values
    _check_level(values)
    if identification.is_explained:
        _check_gains(board, measurement, values, fitted.space)
    unknown = unknowns(fitted)
    if unknown:
        raise InputError("measurement must show more: " + "; ".join(unknown))
    held_out = hold_out(fitted, progress=progress)
    uncertainty = board.uncertainty
    if identification.is_explained:
        uncertainty = identification.uncertainty(held_out.unexplained if held_out else 0.0)
    covariance = fitted.stated_covariance
    if held_out:
        covariance = covariance + held_out.disagreement
    progress(1 + HELD_OUT_FOLDS, 1 + HELD_OUT_FOLDS)
    return replace(
        identification,
        rig=rig_with(board, values, uncertainty),
        covariance=covariance,
        held_out=held_out,
    )


def _check(rig: Rig, measurement: Measurement) -> None:
    check_measurable(rig.plate)  # remaining uncertainty of modes is written as thickness
    names = [era.name for era in rig.eras]
    for sensor in measurement.sensors:
        if sensor.era and sensor.era not in names:
            raise InputError(
                f"sensor {sensor.name} must be at one of {', '.join(names)}, got {sensor.era}"
            )
        if not sensor.era and not rig.plate.contains(sensor.x, sensor.y):
            raise InputError(
                f"sensor {sensor.name} must be on the plate, got ({sensor.x:g}, {sensor.y:g}) m"
            )
    if measurement.count < _MIN_VALUES:
        raise InputError(
            f"a measurement must have at least {_MIN_VALUES} values, got {measurement.count}; "
            "play more tones"
        )
    limits = rig.limits
    lowest, highest = measurement.frequencies[[0, -1]].tolist()
    if lowest < limits.frequency_min or highest > limits.frequency_max:
        raise InputError(
            "tones must be within the rig's limits.frequency of "
            f"{limits.frequency_min:g} to {limits.frequency_max:g} Hz, got {lowest:g} to "
            f"{highest:g} Hz"
        )
    measurement.check()


def _check_level(values: PlateValues) -> None:
    """Raise InputError if all responses are far too large or small because of a wrong unit.

    Also applied to poor fits, since a wrong unit can be the reason.
    """
    drive_level = np.log(np.abs(values["gain"])).mean()
    sensor_level = np.log(np.abs(values["sensor_gain"])).mean()
    level = float(drive_level + sensor_level)
    if abs(level) > _LEVEL_ALLOWED:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got responses "
            f"of about {math.exp(level):.2g} times the rig's; check the units of sensors and drives"
        )


def _check_gains(rig: Rig, measurement: Measurement, values: PlateValues, space: Space) -> None:
    """Raise InputError for impossible gains of drives or sensors: a wrong unit, sign or plug.

    A response determines only the product of a drive's and a sensor's gain. The fit therefore
    splits an error between both, and its residuals do not show a wrong unit or sign.
    """
    drives = [f"drive {era.name}" for era in rig.eras]
    sensors = [f"sensor {sensor.name}" for sensor in measurement.sensors]
    wrong = _wrong_gains(drives, "gain", "phase", values, space)
    wrong += _wrong_gains(sensors, "sensor_gain", "sensor_phase", values, space)
    if wrong:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got gains of "
            f"{'; '.join(wrong)}; check unit, sign and plug of each sensor and drive"
        )


def _wrong_gains(
    names: Sequence[str], gain_kind: str, phase_kind: str, values: PlateValues, space: Space
) -> list[str]:
    """List impossible gains of the given kinds, by name."""
    gains = values[gain_kind]
    max_size = max(_GAIN_ALLOWED, _GAIN_STDS * space.std[space.groups[gain_kind]].max())
    max_phase = max(_PHASE_ALLOWED, _GAIN_STDS * space.std[space.groups[phase_kind]].max())
    wrong = []
    for n in np.flatnonzero(are_impossible(gains, max_size, max_phase)).tolist():
        phase = np.degrees(np.angle(gains[n]))
        wrong.append(f"{names[n]} {abs(gains[n]):.2f} at {phase:.0f}°")
    return wrong


def hold_out(result: RigFit, *, progress: Progress = unseen) -> HeldOutPaths | None:
    """Predict paths from fits to the others; None if the fits determine too few paths."""
    measurement = result.measurement
    model = result.model
    folds = (model.observed[:, None] + np.arange(len(model.rig.eras))) % HELD_OUT_FOLDS
    squares = np.full(measurement.values.shape, np.nan)
    variance = squares.copy()
    noise = min(result.chi2, 1.0)  # readings can be better than stated
    fitted_x = []
    for fold in range(HELD_OUT_FOLDS):
        progress(1 + fold, 1 + HELD_OUT_FOLDS)
        hidden = measurement.known & (folds == fold)
        if not hidden.any():
            continue
        if (hidden == measurement.known).all():
            return None
        partial = fit(
            model,
            measurement.part(~hidden),
            searched=result.searched,
            start=result.x,
            evaluations=_REFITTED,
        )
        variance[hidden] = _prediction_variance(partial, hidden)
        errors = np.abs(partial.fitted_plate.responses - measurement.values)[hidden]
        squares[hidden] = errors**2 - 2 * noise * measurement.std[hidden] ** 2
        fitted_x.append(partial.x)
    mean_square = np.broadcast_to(measurement.tone_rms**2, variance.shape)
    is_determined = variance < _MAX_PREDICTION_STD**2 * mean_square
    if is_determined.sum() < _MIN_PREDICTED:
        return None
    mean_square = mean_square[is_determined]
    total = _positive_root(squares[is_determined] / mean_square)
    unexplained = _positive_root((squares - variance)[is_determined] / mean_square)
    share = (unexplained / total) ** 2 if unexplained else 0.0
    disagreement = share * _IN_COMMON**2 * _jackknife_covariance(np.array(fitted_x))
    return HeldOutPaths(total, unexplained, disagreement)


def _jackknife_covariance(estimates: FloatArray) -> FloatArray:
    """Return the covariance (p, p) of an estimate, from estimates (g, p) without one of g groups.

    (g - 1) / g times the sum over groups of the outer product of differences from the mean.
    """
    difference = estimates - np.mean(estimates, axis=0)
    return np.asarray((1 - 1 / len(estimates)) * difference.T @ difference)


def _prediction_variance(partial: RigFit, hidden: NDArray[np.bool_]) -> FloatArray:
    """Return the variance of predicted responses at a mask, due to uncertain parameters."""
    numbers = np.flatnonzero(partial.searched)
    J = jacobian(partial.fitted_plate, partial.searched)[..., numbers][hidden]
    covariance = partial.stated_covariance[np.ix_(numbers, numbers)]
    return np.asarray(((J @ covariance) * J.conj()).sum(axis=1).real)


def _positive_root(squares: FloatArray) -> float:
    """Return the root of a mean square, 0 if noise that was subtracted exceeds the errors."""
    return math.sqrt(max(squares.mean(), 0.0))


def identification_errors(identification: Identification) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    rig = identification.rig
    groups = identification.fitted.space.groups
    std = {kind: identification.std[part] for kind, part in groups.items()}
    of_eras = np.transpose([std["stiffness"], std["damping_each"]]).ravel()
    relative = np.concatenate([std["thickness"], std["loss"], of_eras, std["supports"]])
    parameters = parameters_of(
        rig, ("thickness", "loss_factor"), ("stiffness", "damping"), rig.foot_names
    )
    values = np.array([parameter.before for parameter in parameters])
    return errors_by_key(rig, zip(parameters, values * relative, strict=True))
