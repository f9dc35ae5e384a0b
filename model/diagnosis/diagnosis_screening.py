"""Detection of dead channels and unusable sensors."""

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray
from model.calibration.fit import SensedPlate
from model.calibration.responses import Responses, check_enough_sensors, silent_sensors
from model.diagnosis.assignment import ShapeMatch
from model.diagnosis.plate_match import MAX_FIT_ERROR, Match

_DEAD = 0.03  # of the response that the rig predicts
_FAINT = 0.3  # of it: dead if its shape is not that of an ERA either
_NO_SHAPE = 0.6  # MAC
_SENSOR_SCALE = (0.7, 1.4)
_MUTE = 0.1  # of the others' scale
_UPSIDE_DOWN = -0.5


@dataclass(frozen=True)
class BadSensor:
    """A sensor that is left out, by what it reads of what the others say, 0 for nothing."""

    name: str
    scale: float

    @property
    def is_mute(self) -> bool:
        """Whether it hears next to nothing, so that no scale makes use of it."""
        return abs(self.scale) < _MUTE

    @property
    def why(self) -> str:
        """What is wrong with it."""
        if self.scale < _UPSIDE_DOWN:
            return f"is upside down (reads {self.scale:.2f} of what the others say): turn it over"
        if self.is_mute and self.scale:
            return (
                f"reads {self.scale:.2f} of what the others say: check that it is where its line "
                "says, and its cable"
            )
        return f"reads {self.scale:.2f} of what the others say" if self.scale else "reads nothing"


def dead_channels(
    plate: SensedPlate, observation: Responses, shapes: ShapeMatch | None = None
) -> NDArray[np.bool_]:
    """Mask (e,) of driven channels with a response far below the model's.

    shapes: with these also of weak channels without the shape of an ERA, whose response is noise.
    """
    share = np.abs(observation.values / plate.responses())
    dead = np.zeros(observation.values.shape[1], dtype=bool)
    for channel in np.flatnonzero(observation.measured):
        typical = np.nanmedian(share[:, channel])
        dead[channel] = typical < _DEAD
        if shapes is not None and typical < _FAINT:
            mac = np.nanmedian(shapes.mac[:, channel], axis=0)
            dead[channel] |= np.nanmax(mac) < _NO_SHAPE
    return dead


def usable_sensors(
    observation: Responses, dead: NDArray[np.bool_]
) -> tuple[Responses, tuple[BadSensor, ...]]:
    """Remove sensors without a signal from any live channel; return them, too.

    Raises InputError if too few are left.
    """
    values = observation.values[:, ~dead]
    if not np.isfinite(values).any():
        return observation, ()
    silent = silent_sensors(replace(observation, values=values))
    check_enough_sensors(~silent, observation)
    mute = tuple(BadSensor(name, 0.0) for name in compress(observation.sensors, silent))
    return observation.without(silent), mute


def off_scale(observation: Responses, values: ComplexArray, match: Match) -> list[BadSensor]:
    """Sensors with a scale unlike that of the others, if the plate fits."""
    if match.median_error > MAX_FIT_ERROR:
        return []
    finite = np.isfinite(values) & np.isfinite(match.predicted) & ~match.outliers
    model = np.where(finite, match.predicted, 0)
    measured = np.where(finite, values, 0)
    phase_factor = np.exp(-1j * np.angle((model.conj() * measured).sum(axis=2, keepdims=True)))
    inner = (model.conj() * measured * phase_factor).real.sum(axis=(0, 1))
    scale = inner / np.maximum((np.abs(model) ** 2).sum(axis=(0, 1)), 1e-300)
    scale = scale / np.median(scale)
    low, high = _SENSOR_SCALE
    return [
        BadSensor(name, float(value))
        for name, value in zip(observation.sensors, scale, strict=True)
        if not low <= value <= high
    ]
