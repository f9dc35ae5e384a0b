"""Measured frequency responses, as a file gives them and as a fit takes them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Era

# How far [m] a bolt may be from where the rig has it, and a sensor beyond the plate's edge: what a
# ruler gives.
_RULER = 5e-3
_EDGE = 1e-3


@dataclass(frozen=True, eq=False)
class MeasuredFunction:
    """Acceleration at one sensor per base displacement of one ERA [1/s²], complex (n,).

    Of exp(+i omega t), upwards positive for both. era: its name, or "" where only its place is
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
    """Measured responses of a rig's plate, NaN where there is none.

    sensors (s,) names; points (s, 2) [m]; frequencies (f,) [Hz]; values (f, eras, s) [1/s²].
    """

    sensors: tuple[str, ...]
    points: FloatArray
    frequencies: FloatArray
    values: ComplexArray

    @property
    def count(self) -> int:
        """How many values there are."""
        return int(np.isfinite(self.values).sum())


def responses_of(functions: Sequence[MeasuredFunction], rig: Rig) -> Responses:
    """The functions as responses of a rig's plate.

    Raises InputError, with file and line, for what cannot have been measured on it: points off the
    plate, ERAs that it does not have or elsewhere, frequencies beyond its limits, a response given
    twice, a sensor at two places.
    """
    names = [era.name for era in rig.eras]
    sensors: dict[str, tuple[float, float]] = {}
    for function in functions:
        _check_point(function, rig)
        _check_frequencies(function, rig)
        known = sensors.setdefault(function.sensor, function.point)
        if math.dist(known, function.point) > _EDGE:
            raise InputError(
                f"{function.places[0]}: sensor {function.sensor} is at {_shown(function.point)} m "
                f"here and at {_shown(known)} m before; give each place its own name"
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
                f"{function.places[first]}: the response of sensor {function.sensor} to ERA "
                f"{era.name} at {function.frequencies[first]:g} Hz stands twice; keep one"
            )
        values[rows, names.index(era.name), column[function.sensor]] = function.values
    # A point at the very edge may have been rounded off the plate.
    points = np.clip(list(sensors.values()), 0, [rig.plate.length, rig.plate.width])
    return Responses(tuple(sensors), points, frequencies, values)


def _check_point(function: MeasuredFunction, rig: Rig) -> None:
    x, y = function.point
    plate = rig.plate
    if not (-_EDGE <= x <= plate.length + _EDGE and -_EDGE <= y <= plate.width + _EDGE):
        raise InputError(
            f"{function.places[0]}: sensor {function.sensor} at {_shown(function.point)} m is off "
            f"the rig's plate, which reaches from (0, 0) to ({plate.length:g}, {plate.width:g}) m; "
            "was another plate measured, or is the place not in metres?"
        )


def _check_frequencies(function: MeasuredFunction, rig: Rig) -> None:
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    beyond = np.flatnonzero((function.frequencies < low) | (function.frequencies > high))
    if len(beyond):
        raise InputError(
            f"{function.places[beyond[0]]}: {function.frequencies[beyond[0]]:g} Hz is beyond the "
            f"rig's limits.frequency, {low:g} to {high:g} Hz; leave it out, or widen the limits"
        )


def _era_of(function: MeasuredFunction, rig: Rig) -> Era:
    """Which of the rig's ERAs was driven, by its name or else by its place."""
    known = ", ".join(f"{era.name} {_shown((era.x, era.y))}" for era in rig.eras)
    at = function.era_point
    for era in rig.eras:
        near = at is not None and math.dist(at, (era.x, era.y)) <= _RULER
        if era.name == function.era:
            if at is not None and not near:
                raise InputError(
                    f"{function.places[0]}: ERA {era.name} was measured at {_shown(at)} m, the rig "
                    f"has it at {_shown((era.x, era.y))} m; was another plate measured?"
                )
            return era
        if near and function.era not in {other.name for other in rig.eras}:
            return era
    raise InputError(
        f"{function.places[0]}: the rig has no ERA {function.era or _shown(at or (0, 0))}; it has "
        f"{known}"
    )


def _shown(point: tuple[float, float]) -> str:
    return f"({point[0]:g}, {point[1]:g})"
