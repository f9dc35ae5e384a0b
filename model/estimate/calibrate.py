"""Calibrate a rig: fit it to measured responses, and validate it at held-out sensors.

    d_fsn = g_fn a_fsn(x) + noise

d are measured values at frequency f, sensor s and ERA n; a are the model's, multiplied by the
sensors' scales; g is a complex gain per frequency and ERA. x contains the rig's values and the
plate's form errors.

`check_consistency` comes first: it rejects responses that contradict their metadata. Dead channels
and outliers are left out.
"""

import math
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, best_of
from model.errors import InputError
from model.estimate.calibration_result import MAX_PREDICTION_ERROR, Calibration
from model.estimate.fit import Fit, JointPrior
from model.estimate.fitted_values import Parameter
from model.estimate.gains import are_impossible
from model.estimate.loss_law import viscous_difference
from model.estimate.measurement import Measurement, check_enough_sensors
from model.estimate.noise import fit_to_noise, without_outliers
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.screening import Screening, check_consistency, wrong_size
from model.estimate.sensed_plate import SensedPlate, plate_of
from model.processes import Progress, unseen
from model.rig.rig import Rig

MAX_OUTLIERS = 0.1
"""Largest fraction of values left out of an acceptable fit."""

_UNKNOWN = 100.0  # prior standard error of x, for parameters without a prior
_WRONG_SCALE = 0.02  # common tolerance of sensors
_SIGNIFICANCE = 4.0  # standard errors
_MAX_GAIN = 5.0  # of a drive at one frequency relative to its median, up or down
_MAX_SIDE_ERROR = 4.0  # of the tolerance of a side of the plate
_LAW_ROUNDS = 2  # fits; the effect of viscous losses changes little with the parameters


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
    calibration = _fitted_with_scales(rig, measured, check_consistency(rig, measured))
    progress(1, 3)  # all scales free; identified parameters; without held-out sensors
    calibration = _identified(_with_known_scales(calibration, all_scales=all_scales))
    progress(2, 3)
    _check_sides(calibration)
    _check_gains(calibration)
    _check_suspensions(calibration)
    _check_outliers(calibration)
    # Properties that need more fits, which belong to the progress.
    _ = calibration.held_out
    _ = calibration.rig
    progress(3, 3)
    return calibration


def _fitted_with_scales(rig: Rig, measured: Measurement, screened: Screening) -> Calibration:
    """Fit with free scales of all sensors; leave out sensors with mostly outliers."""
    dead = screened.dead_sensors
    check_enough_sensors(~dead, measured)
    measurement = replace(screened.live(measured), gain_std=math.inf)
    plate = plate_of(rig, measurement, has_form=True)
    space = plate.space
    start = np.zeros(space.size)
    start[plate.numbers] = screened.start
    std, scales = without_outliers(measurement.values, plate.responses(start))
    count = np.isfinite(measurement.values).sum(axis=(0, 2))
    is_good = np.isfinite(std).sum(axis=(0, 2)) > count / 2
    if not is_good.all():
        # The others are at another position, or loose.
        dead = dead.copy()
        dead[~dead] = ~is_good
        return _fitted_with_scales(rig, measured, replace(screened, dead_sensors=dead))
    measurement = replace(measurement, errors=std)
    start[space.groups["sensor_scale"]] = (scales - 1) / PARAMETER_KINDS["sensor_scale"].std
    prior = _prior(plate, start, np.ones(len(scales), dtype=bool))
    return Calibration(
        fit=_fitted_with_loss_law(plate, measurement, prior, start),
        prior=prior,
        dead_sensors=tuple(compress(measured.names, dead)),
        dead_eras=tuple(compress((era.name for era in rig.eras), screened.dead_eras)),
    )


def _fitted_with_loss_law(
    plate: SensedPlate, measurement: Measurement, prior: JointPrior, start: FloatArray
) -> Fit[SensedPlate]:
    """Fit with the effect of viscous losses at the start (p,), then again at the fitted values."""
    searched = plate.space.uncertain & ~plate.space.of("gain")
    for _ in range(_LAW_ROUNDS):
        plate = replace(plate, viscous_change=viscous_difference(plate, start))
        result = fit_to_noise(plate, measurement, searched=searched, start=start, prior=prior)
        measurement = result.measurement
        start = result.x
    return result


def _with_known_scales(calibration: Calibration, *, all_scales: bool) -> Calibration:
    """Fit again, with free scales of wrong sensors only, or of all sensors if requested."""
    space = calibration.plate.space
    scales = calibration.sensor_scales
    error = space.values(calibration.fit.errors, "sensor_scale")
    is_wrong = np.abs(scales - 1) > np.maximum(_WRONG_SCALE, _SIGNIFICANCE * error)
    is_unknown = is_wrong | all_scales
    start = calibration.fit.x.copy()
    part = space.groups["sensor_scale"]
    start[part] = (np.where(is_unknown, scales, 1.0) - 1) / space.std[part]
    calibration = replace(calibration, prior=_prior(calibration.plate, start, is_unknown))
    return calibration.fitted_again(calibration.fit.searched, start)


def _prior(plate: SensedPlate, start: FloatArray, is_unknown: NDArray[np.bool_]) -> JointPrior:
    """Return the prior of the parameters.

    Only data sheets and feet constrain the rig's values. Scales of sensors in a mask (s,) are free;
    the others are constrained around a start (p,). If all scales are free, responses cannot
    separate their common factor from the gains, so the median of good sensors is constrained.
    """
    space = plate.space
    scales = np.array(space.indices("sensor_scale"))
    free_scales = scales[is_unknown]
    mean = np.zeros(space.size)
    mean[free_scales] = start[free_scales]
    std = np.ones(space.size)
    std[plate.numbers[plate.largest_errors == 1]] = _UNKNOWN
    std[free_scales] = _UNKNOWN
    covariance = np.diag(std**2)
    if is_unknown.all():
        covariance[np.ix_(scales, scales)] += (math.pi / 2 - _UNKNOWN**2) / len(scales)
    return JointPrior(mean, covariance)


def _identified(calibration: Calibration) -> Calibration:
    """Fix parameters that the data determine less well than their prior, and fit again."""
    plate = calibration.plate
    while True:
        searched = calibration.fit.searched.copy()
        errors = calibration.fit.errors[plate.numbers] / plate.largest_errors
        excess = np.where(searched[plate.numbers], errors, 0)
        # Values of a poorly fitting plate are meaningless.
        if not excess.max() > 1 or calibration.error > MAX_PREDICTION_ERROR:
            return calibration
        fixed = plate.numbers[best_of(excess)]
        searched[fixed] = False
        x = calibration.fit.x.copy()
        x[fixed] = 0.0
        calibration = calibration.fitted_again(searched, x)


def _check_sides(calibration: Calibration) -> None:
    """Raise InputError if a plate of another size fits the responses better."""
    if calibration.error > MAX_PREDICTION_ERROR:
        return
    plate = calibration.plate
    errors = plate.space.values(calibration.fit.x, "side").tolist()
    sides = (plate.rig.plate.length, plate.rig.plate.width)
    for key, side, error in zip(("length", "width"), sides, errors, strict=True):
        if abs(error) > _MAX_SIDE_ERROR * PARAMETER_KINDS["side"].std:
            raise wrong_size(f"plate.{key}", side, side + error)


def _check_gains(calibration: Calibration) -> None:
    """Raise InputError for gains that no drive can have: they would hide another plate."""
    sizes = np.abs(calibration.gains_of_fit)
    errors = calibration.gains_error
    for number, era in enumerate(calibration.plate.rig.eras):
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


def _check_suspensions(calibration: Calibration) -> None:
    """Raise InputError for exciters and feet with a fitted stiffness at its bound."""
    names = {parameter.era for parameter in calibration.plate.exciter_parameters}
    exciters = []
    feet = []
    for parameter in calibration.parameters:
        if parameter.at_bound and parameter.kind == "stiffness" and parameter.era in names:
            exciters.append(parameter)
        elif parameter.at_bound and parameter.foot:
            feet.append(parameter)
    if exciters:
        eras = ", ".join(parameter.era for parameter in exciters)
        raise InputError(
            f"stiffness of {eras} must be close to the rig's "
            f"value, got {_factors(exciters)} times it, the bound of the fit; check "
            "their resonance and resonance_is (free or mounted; era plate show prints "
            "where the glued magnets resonate), and check with era rig check that they are glued"
        )
    if feet:
        raise InputError(
            f"stiffness of feet {', '.join(parameter.foot for parameter in feet)} must be close to "
            f"the rig's value, got {_factors(feet)} times it, the bound of the fit; check their "
            "kind, their positions and whether all touch the plate"
        )


def _factors(parameters: list[Parameter]) -> str:
    """List fitted values relative to the rig's."""
    return ", ".join(f"{parameter.value / parameter.before:.2g}" for parameter in parameters)


def _check_outliers(calibration: Calibration) -> None:
    """Raise InputError if too many values are outliers."""
    count = calibration.value_count
    outliers = calibration.outlier_count
    if outliers > MAX_OUTLIERS * count:
        raise InputError(
            f"outliers must be at most {100 * MAX_OUTLIERS:g} % of the values, got {outliers} of "
            f"{count} ({100 * outliers / count:.0f} %); check that it is this plate, names and "
            "positions of sensors and ERAs, and loose contacts"
        )
