"""Detection of sensors without a usable signal and of ERAs that do not move the plate."""

import numpy as np
from numpy.typing import NDArray

from model.calibration.fit import Fit, Problem
from model.calibration.responses import Responses
from model.errors import InputError

_SILENT_ERA = 0.02  # of what the others do
_SILENT_SENSOR = 0.005  # of the loudest sensor, in the median over frequencies and ERAs
_DEAD_SCALE = 0.1  # of the others' scale
LEAST_SENSORS = 3
_DEAD_COHERENCE = 0.5  # with what the fitted plate does at the sensor


def silent_eras(responses: Responses) -> NDArray[np.bool_]:
    """Mask of driven ERAs without a response (eras,).

    Raises InputError if there is no response at all.
    """
    typical = np.array([_median(responses.values[:, e]) for e in range(responses.values.shape[1])])
    if not np.nanmax(typical) > 0:
        raise InputError("measured responses must not all be zero; check that ERAs were driven")
    return np.asarray(typical < _SILENT_ERA * np.nanmedian(typical))


def silent_sensors(responses: Responses) -> NDArray[np.bool_]:
    """Mask of sensors without a response to any ERA (s,)."""
    size = np.abs(responses.values)
    loudest = np.where(np.isfinite(size), size, 0).max(axis=2, keepdims=True)
    share = size / np.where(loudest > 0, loudest, np.nan)
    typical = [_median(share[:, :, s]) for s in range(size.shape[2])]
    return ~(np.array(typical) >= _SILENT_SENSOR)


def check_enough_sensors(alive: NDArray[np.bool_], responses: Responses) -> None:
    """Raise InputError unless enough sensors (s,) have a signal."""
    if alive.sum() < LEAST_SENSORS:
        dead = [n for n, live in zip(responses.sensors, alive, strict=True) if not live]
        without = f" ({', '.join(dead)} without a signal)" if dead else ""
        raise InputError(
            f"at least {LEAST_SENSORS} sensors must have a signal, better eight or more, got "
            f"{alive.sum()}{without}"
        )


def _median(values: NDArray[np.inexact]) -> float:
    """Median magnitude of finite values; NaN without any."""
    finite = np.abs(values)[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


def sensors_off_model(problem: Problem, fit: Fit) -> NDArray[np.bool_]:
    """Mask of sensors whose response is not that of the fitted plate (s,)."""
    weight = fit.used / fit.noise[:, :, None]
    model = weight * np.nan_to_num(fit.predicted)
    values = weight * np.where(fit.used, problem.values, 0)
    inner = np.abs((model.conj() * values).sum(axis=(0, 1)))
    power = (np.abs(model) ** 2).sum(axis=(0, 1)) * (np.abs(values) ** 2).sum(axis=(0, 1))
    coherence = inner / np.sqrt(np.maximum(power, 1e-300))
    scales = problem.scales(fit.z)
    relative = np.abs(scales / np.median(scales))
    return np.asarray((relative < _DEAD_SCALE) | (coherence < _DEAD_COHERENCE))
