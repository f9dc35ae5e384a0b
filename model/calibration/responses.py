"""Measured frequency responses, one by one and as an array over a rig's ERAs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.attachments import Era

# Tolerances of a ruler [m]: of an ERA's position, and of a sensor beyond the plate's edge.
_ERA_TOLERANCE = 5e-3
_EDGE_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class MeasuredFunction:
    """Acceleration at one sensor per base displacement of one ERA [1/s²], complex (n,).

    Phases as exp(+i omega t), upwards positive for both. era: name, or "" if only its position is
    known; point, era_point: x, y [m], the latter None if unknown; frequencies (n,) [Hz]; places:
    file and line of each value, for errors.
    """

    era: str
    sensor: str
    point: tuple[float, float]
    era_point: tuple[float, float] | None
    frequencies: FloatArray
    values: ComplexArray
    places: Sequence[str]


@dataclass(frozen=True, eq=False)
class Responses:
    """Measured responses of a rig's plate, NaN where not measured.

    sensors (s,) names; points (s, 2) [m]; frequencies (f,) [Hz]; values (f, eras, s) [1/s²];
    has_phases: whether phases are relative to the drive; otherwise only phases between sensors are
    known, and no polarity.
    """

    sensors: tuple[str, ...]
    points: FloatArray
    frequencies: FloatArray
    values: ComplexArray
    has_phases: bool = True

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(np.isfinite(self.values).sum())

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask of the ERAs that were driven (e,)."""
        return np.asarray(np.isfinite(self.values).any(axis=(0, 2)))

    def without(self, sensors: NDArray[np.bool_]) -> "Responses":
        """Remove some of the sensors (s,)."""
        kept = ~sensors
        return replace(
            self,
            sensors=tuple(name for name, keep in zip(self.sensors, kept, strict=True) if keep),
            points=self.points[kept],
            values=self.values[:, :, kept],
        )


def responses_of(functions: Sequence[MeasuredFunction], rig: Rig) -> Responses:
    """Join functions into responses of a rig's plate.

    Raises InputError, with file and line, for points off the plate, unknown ERAs or positions,
    frequencies beyond the rig's limits, a response given twice and a sensor at two positions.
    """
    names = [era.name for era in rig.eras]
    sensors: dict[str, tuple[float, float]] = {}
    for function in functions:
        _check_point(function, rig)
        _check_frequencies(function, rig)
        known = sensors.setdefault(function.sensor, function.point)
        if math.dist(known, function.point) > _EDGE_TOLERANCE:
            raise InputError(
                f"{function.places[0]}: sensor {function.sensor} must have one position, got "
                f"{_shown(known)} and {_shown(function.point)} m; name sensors differently"
            )
    frequencies = np.unique(np.concatenate([function.frequencies for function in functions]))
    values = np.full((len(frequencies), len(names), len(sensors)), np.nan, dtype=complex)
    column = {name: number for number, name in enumerate(sensors)}
    for function in functions:
        era = _era_of(function, rig)
        rows = np.searchsorted(frequencies, function.frequencies)
        cells = values[rows, names.index(era.name), column[function.sensor]]
        repeated = np.flatnonzero(np.isfinite(cells))
        if len(repeated) or len(np.unique(rows)) < len(rows):
            first = repeated[0] if len(repeated) else 0
            raise InputError(
                f"{function.places[first]}: response of sensor {function.sensor} to ERA {era.name} "
                f"at {function.frequencies[first]:g} Hz must be given once, got two"
            )
        values[rows, names.index(era.name), column[function.sensor]] = function.values
    # A point at the edge may have been rounded off the plate.
    points = np.clip(list(sensors.values()), 0, [rig.plate.length, rig.plate.width])
    return Responses(tuple(sensors), points, frequencies, values)


def _check_point(function: MeasuredFunction, rig: Rig) -> None:
    plate = rig.plate
    low, high = -_EDGE_TOLERANCE, np.add((plate.length, plate.width), _EDGE_TOLERANCE)
    if not (np.greater_equal(function.point, low) & np.less_equal(function.point, high)).all():
        raise InputError(
            f"{function.places[0]}: sensor {function.sensor} must be on the rig's plate, from "
            f"(0, 0) to ({plate.length:g}, {plate.width:g}) m, got {_shown(function.point)} m; "
            "check the plate and the unit"
        )


def _check_frequencies(function: MeasuredFunction, rig: Rig) -> None:
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    beyond = np.flatnonzero((function.frequencies < low) | (function.frequencies > high))
    if len(beyond):
        raise InputError(
            f"{function.places[beyond[0]]}: frequency must be within the rig's limits.frequency of "
            f"{low:g} to {high:g} Hz, got {function.frequencies[beyond[0]]:g} Hz; leave it out or "
            "widen the limits"
        )


def _era_of(function: MeasuredFunction, rig: Rig) -> Era:
    """Find the ERA that was driven, by its name or else by its position."""
    known = ", ".join(f"{era.name} {_shown((era.x, era.y))}" for era in rig.eras)
    at = function.era_point
    for era in rig.eras:
        near = at is not None and math.dist(at, (era.x, era.y)) <= _ERA_TOLERANCE
        if era.name == function.era:
            if at is not None and not near:
                raise InputError(
                    f"{function.places[0]}: ERA {era.name} must be at {_shown((era.x, era.y))} m "
                    f"as in the rig, got {_shown(at)} m; check the plate"
                )
            return era
        if near and function.era not in {other.name for other in rig.eras}:
            return era
    raise InputError(
        f"{function.places[0]}: ERA must be one of {known}, got "
        f"{function.era or _shown(at or (0, 0))}"
    )


def _shown(point: tuple[float, float]) -> str:
    return f"({point[0]:g}, {point[1]:g})"
