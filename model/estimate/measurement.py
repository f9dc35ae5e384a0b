"""Measured responses of a plate: values at sensors, their errors, and checks of a measurement."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Self

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.forward import Sensor
from model.rig.rig import LEVEL_PHASE

LEAST_SENSORS = 3
"""Minimum number of sensors with a signal for fitting a plate."""

NONLINEAR = 0.05
"""Relative difference of responses at full and half level beyond which a plate is not linear."""

CHANGES_WITH_LEVEL = 0.01
"""Relative difference of these responses beyond which gains depend on the level."""

DRIFTED = 0.01
"""Relative difference of the first tone, played last again, beyond which a plate has changed."""

_SILENT_SENSOR = 0.005  # of the loudest sensor, in the median over frequencies and ERAs
_NOISE = 0.01  # usual error of a reading, relative
_FLOOR = 0.1  # of a sensor's RMS; below it the error no longer decreases with the response


@dataclass(frozen=True, eq=False)
class Repeat:
    """One tone measured twice."""

    era: str
    """Name of the ERA that played it, or of several that did together."""
    frequency: float
    """Frequency [Hz]."""
    values: ComplexArray
    """Responses at all sensors (s,) [1/s²]."""
    repeated: ComplexArray
    """The same, measured again (s,) [1/s²]."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Responses of a plate at s sensors to n ERAs, at some of their paths and frequencies."""

    sensors: Sequence[Sensor]
    frequencies: FloatArray
    """Ascending (f,) [Hz]."""
    values: ComplexArray
    """Acceleration per base displacement at full gain (f, s, n) [1/s²], of an exciter per volt
    [m/s²/V], phases as exp(+i omega t), NaN where not measured."""
    errors: FloatArray | None = None
    """Standard error of the real and of the imaginary part (f, s, n), infinite of outliers; None
    for the usual one of readings, as `std`."""
    half_level: tuple[Repeat, ...] = ()
    """Loud tones repeated at half the level, per base displacement as well."""
    at_end: tuple[Repeat, ...] = ()
    """The first tones, as far as they are loud, played last again."""
    has_phases: bool = True
    """Whether phases are relative to the drive; otherwise only phases between sensors are known,
    and no polarity."""
    drives_lag: bool = False
    """Whether bases follow their drive with an unknown lag, for example behind voltage
    amplifiers."""
    skipped: int = 0
    """Number of values outside the rig's frequency limits, which were skipped."""
    gain_std: float = 0.0
    """Relative standard deviation of each drive's gain from 1, at every frequency: 0 for gains of
    1, infinite for unknown gains. The phase is free if the magnitude is."""
    drives: tuple[int, ...] = ()
    """Index of the ERA that each of the n channels drives; empty if each drives its own."""

    def __post_init__(self) -> None:
        """Raise InputError for unordered frequencies."""
        if not (np.diff(self.frequencies) > 0).all():
            raise InputError("measurement: frequencies must ascend, each once")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors (s,)."""
        return tuple(sensor.name for sensor in self.sensors)

    @property
    def points(self) -> FloatArray:
        """Positions of the sensors (s, 2) [m]."""
        return np.array([(sensor.x, sensor.y) for sensor in self.sensors]).reshape(-1, 2)

    @cached_property
    def std(self) -> FloatArray:
        """Standard error of the real and of the imaginary part (f, s, n), infinite for outliers.

        The default is 1 % of a response plus 1 % of a tenth of its sensor's RMS, since a response
        can be zero. Raises InputError for a standard error of zero.
        """
        std = self.errors
        if std is None:
            std = self._default_errors()
        smallest = np.where(np.isfinite(self.values), std, np.inf).min(initial=np.inf)
        if not smallest > 0:
            raise InputError(f"measurement: std must be above zero, got {smallest:g}")
        return std

    def _default_errors(self) -> FloatArray:
        """Return the default standard errors (f, s, n); see `std`."""
        measured = np.isfinite(self.values)
        squares = np.where(measured, np.abs(self.values), 0.0) ** 2
        count = measured.sum(axis=(0, 2))[:, None]
        mean_square = squares.sum(axis=(0, 2))[:, None] / np.maximum(count, 1)
        return np.asarray(_NOISE * np.sqrt(squares + _FLOOR**2 * mean_square))

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Mask (f, s, n) of the responses that were measured and are no outliers."""
        return np.isfinite(self.values) & (self.errors is None or np.isfinite(self.std))

    @cached_property
    def weight(self) -> FloatArray:
        """1 / std, 0 for unknown values (f, s, n)."""
        return np.where(self.known, 1 / self.std, 0.0)

    @cached_property
    def filled(self) -> ComplexArray:
        """Values, 0 for unknown ones (f, s, n)."""
        return np.where(self.known, self.values, 0.0)

    def driven(self, responses: ComplexArray) -> ComplexArray:
        """Convert responses (f, s, eras, ...) to the ERAs, or their slopes, to those to the n
        channels."""
        return responses[:, :, list(self.drives)] if self.drives else responses

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.known.sum())

    @cached_property
    def tone_rms(self) -> FloatArray:
        """RMS of the values at each tone, (f, 1, 1) [1/s²]."""
        squares = np.where(self.known, np.abs(self.values) ** 2, 0.0).sum(axis=(1, 2))
        count = np.maximum(self.known.sum(axis=(1, 2)), 1)
        return np.asarray(np.sqrt(squares / count))[:, None, None]

    def part(self, kept: NDArray[np.bool_]) -> Self:
        """Keep the values of a mask (f, s, n), with their errors."""
        return replace(self, values=np.where(kept, self.values, np.nan), errors=self.std)

    def without(self, sensors: NDArray[np.bool_]) -> Self:
        """Remove some of the sensors (s,)."""
        return replace(
            self,
            sensors=tuple(compress(self.sensors, ~sensors)),
            values=self.values[:, ~sensors],
            errors=None if self.errors is None else self.errors[:, ~sensors],
        )

    def moved(self, points: FloatArray) -> Self:
        """Return a copy with the sensors at other positions (s, 2) [m]."""
        moves = zip(self.sensors, points.tolist(), strict=True)
        return replace(self, sensors=tuple(replace(sensor, x=x, y=y) for sensor, (x, y) in moves))

    @property
    def gain_by_level(self) -> float:
        """Relative change of gains over a factor of ten in level; 0 within errors of readings."""
        difference = max(map(_difference, self.half_level), default=0.0)
        if difference <= CHANGES_WITH_LEVEL:
            return 0.0
        return difference / (math.log10(2) * math.hypot(1, LEVEL_PHASE))

    def check(self) -> None:
        """Raise InputError for a plate that was not linear or has changed during the
        measurement."""
        _check_repeats(self.half_level, NONLINEAR, "at half the level; measure at a lower level")
        _check_repeats(
            self.at_end, DRIFTED, "at the end; wait until the plate has settled, measure again"
        )


def _difference(repeat: Repeat) -> float:
    """Return the relative difference of the responses to a tone measured twice."""
    size = np.linalg.norm(repeat.values)
    return float(np.linalg.norm(repeat.repeated - repeat.values) / size)


def _check_repeats(repeats: Sequence[Repeat], limit: float, cause: str) -> None:
    """Raise InputError if responses to a tone that was measured twice differ too much."""
    for repeat in repeats:
        difference = _difference(repeat)
        if not difference <= limit:
            raise InputError(
                f"response to ERA {repeat.era} at {repeat.frequency:g} Hz must stay within "
                f"{100 * limit:g} %, got {100 * difference:.1f} % {cause}"
            )


@dataclass(frozen=True, eq=False)
class MeasuredPlate:
    """A measurement and the circumstances in which it was made."""

    measurement: Measurement
    level: float | None
    """Largest sample of each output, 0..1 of full scale; None for a file."""
    duration: float | None
    """Duration [s]; None for a file."""
    sensors: tuple[Mapping[str, object], ...]
    """The sensors used, for programs."""
    notes: tuple[str, ...]
    """Lines for people."""
    details: Mapping[str, object]
    """Further keys and values for programs."""


def sensors_at(points: FloatArray, names: Sequence[str] = ()) -> tuple[Sensor, ...]:
    """Sensors without mass at points (s, 2) [m] of the plate, by default numbered."""
    if not names:
        names = [f"sensor {number}" for number in range(len(points))]
    named_points = zip(names, np.asarray(points).tolist(), strict=True)
    return tuple(Sensor(name, x=x, y=y) for name, (x, y) in named_points)


def silent_sensors(measurement: Measurement) -> NDArray[np.bool_]:
    """Return a mask of sensors without a response to any ERA (s,)."""
    size = np.abs(measurement.values)
    loudest = np.where(np.isfinite(size), size, 0).max(axis=1, keepdims=True)
    share = size / np.where(loudest > 0, loudest, np.nan)
    level = np.array([typical(share[:, s]) for s in range(size.shape[1])])
    return ~(level >= _SILENT_SENSOR)


def check_enough_sensors(alive: NDArray[np.bool_], measurement: Measurement) -> None:
    """Raise InputError unless enough sensors (s,) have a signal."""
    if alive.sum() < LEAST_SENSORS:
        message = (
            f"at least {LEAST_SENSORS} sensors must have a signal (eight or more are better), got "
            f"{alive.sum()}"
        )
        dead = ", ".join(compress(measurement.names, ~alive))
        if dead:
            message += f" ({dead} without a signal)"
        raise InputError(message)


def typical(values: NDArray[np.inexact]) -> float:
    """Median magnitude of finite values; NaN without any."""
    finite = np.abs(values)[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")
