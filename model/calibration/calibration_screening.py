"""What of measured responses can be used: sensors with a signal, and enough of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.calibration.responses import Responses
from model.errors import InputError

_SILENT_SENSOR = 0.005  # of the loudest sensor, in the median over frequencies and ERAs
LEAST_SENSORS = 3


@dataclass(frozen=True, eq=False)
class Screened:
    """What a check of responses has found.

    dead_eras (e,), dead_sensors (s,): masks of those that do not move the plate, and that hear next
    to nothing; start (n,): the fitted values of the most likely plate, as `SensedPlate.numbers` are
    in its space.
    """

    dead_eras: NDArray[np.bool_]
    dead_sensors: NDArray[np.bool_]
    start: FloatArray


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
