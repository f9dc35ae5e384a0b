"""Measured responses: value by value, as an array over a rig's ERAs, and what a fit can use."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.identification.forward import Sensor
from model.identification.measurement import Measurement
from model.rig.rig import Rig
from model.structure.actuators import Actuator

# Tolerances of a ruler [m]: of an ERA's position, and of a sensor beyond the plate's edge.
_ERA_TOLERANCE = 5e-3
_EDGE_TOLERANCE = 1e-3
_logger = logging.getLogger(__name__)
_SILENT_SENSOR = 0.005  # of the loudest sensor, in the median over frequencies and ERAs
LEAST_SENSORS = 3


@dataclass(frozen=True)
class MeasuredValue:
    """Acceleration at one sensor per base displacement of one ERA [1/s²] at a frequency [Hz].

    Per volt at an exciter [m/s²/V], is_per_volt.

    Phases as exp(+i omega t), upwards positive for both. era: name, or "" if only its position is
    known; point, era_point: x, y [m], the latter None if unknown; place: file and line, for errors;
    sensor_mass [kg]: as `Responses.masses`; setting: with what it was measured, in words, "" for
    not known.
    """

    era: str
    sensor: str
    point: tuple[float, float]
    era_point: tuple[float, float] | None
    frequency: float
    value: complex
    place: str
    sensor_mass: float = 0.0
    setting: str = ""
    is_per_volt: bool = False


@dataclass(frozen=True, eq=False)
class Responses:
    """Measured responses of a rig's plate, NaN where not measured.

    sensors (s,) names; points (s, 2) [m]; frequencies (f,) [Hz]; values (f, eras, s) [1/s²];
    has_phases: whether phases are relative to the drive; otherwise only phases between sensors are
    known, and no polarity; skipped: number of values beyond the rig's limits of frequency. masses
    (s,) [kg]: of a sensor that is moved, as `Sensor.mass`; None for none.
    """

    sensors: tuple[str, ...]
    points: FloatArray
    frequencies: FloatArray
    values: ComplexArray
    has_phases: bool = True
    skipped: int = 0
    masses: FloatArray | None = None

    def __post_init__(self) -> None:
        """Keep masses only where one is above 0."""
        if self.masses is not None and not self.masses.any():
            object.__setattr__(self, "masses", None)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(np.isfinite(self.values).sum())

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask of the ERAs that were driven (e,)."""
        return np.asarray(np.isfinite(self.values).any(axis=(0, 2)))

    @property
    def sensor_masses(self) -> FloatArray:
        """Mass of the sensor at each place while it measures there, (s,) [kg]."""
        return np.zeros(len(self.sensors)) if self.masses is None else self.masses

    def as_measurement(self) -> Measurement:
        """The same for an identification, of drives that lag as actuators behind a card do."""
        places = zip(self.sensors, self.points.tolist(), self.sensor_masses.tolist(), strict=True)
        sensors = [Sensor(name, x=x, y=y, mass=mass) for name, (x, y), mass in places]
        values = self.values.swapaxes(1, 2)
        return replace(Measurement.of(sensors, self.frequencies, values), drives_lag=True)

    def without(self, sensors: NDArray[np.bool_]) -> "Responses":
        """Remove some of the sensors (s,)."""
        kept = ~sensors
        return replace(
            self,
            sensors=tuple(compress(self.sensors, kept)),
            points=self.points[kept],
            values=self.values[:, :, kept],
            masses=None if self.masses is None else self.masses[kept],
        )


def responses_of(measured: Sequence[MeasuredValue], rig: Rig) -> Responses:
    """Join values into responses of a rig's plate.

    What is beyond the rig's limits of frequency, as a spectrum's line of 0 Hz, is left out. Raises
    InputError, with file and line, for points off the plate, unknown ERAs or positions, a response
    given twice, a sensor at two positions, and where nothing is left.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    within = [each for each in measured if low <= each.frequency <= high]
    skipped = len(measured) - len(within)
    limits = f"the rig's limits.frequency of {low:g} to {high:g} Hz"
    if measured and not within:
        raise InputError(
            f"{measured[0].place}: a frequency must be within {limits}, got "
            f"{measured[0].frequency:g} Hz; measure others or widen the limits"
        )
    if skipped:
        _logger.warning("%d of %d values beyond %s are left out", skipped, len(measured), limits)
    sensors: dict[str, tuple[float, float]] = {}
    masses: dict[str, float] = {}
    first: dict[str, str] = {}
    eras: dict[tuple[str, tuple[float, float] | None], int] = {}
    found: dict[tuple[float, int, str], complex] = {}
    for each in within:
        if each.sensor not in sensors:
            _check_point(each, rig)
        known = sensors.setdefault(each.sensor, each.point)
        place = first.setdefault(each.sensor, each.place)
        if math.dist(known, each.point) > _EDGE_TOLERANCE:
            raise InputError(
                f"{each.place}: sensor {each.sensor} must have one position, got {_shown(known)} "
                f"({place}) and {_shown(each.point)} m; name sensors differently"
            )
        if masses.setdefault(each.sensor, each.sensor_mass) != each.sensor_mass:
            raise InputError(
                f"{each.place}: sensor {each.sensor} must have one mass, got "
                f"{1e3 * masses[each.sensor]:g} ({place}) and {1e3 * each.sensor_mass:g} g"
            )
        if (each.era, each.era_point) not in eras:
            eras[each.era, each.era_point] = _era_of(each, rig)
        number = eras[each.era, each.era_point]
        _check_unit(each, rig.eras[number])
        if (each.frequency, number, each.sensor) in found:
            raise InputError(
                f"{each.place}: response of sensor {each.sensor} to ERA {rig.eras[number].name} "
                f"at {each.frequency:g} Hz must be given once, got two"
            )
        found[each.frequency, number, each.sensor] = each.value
    frequencies = np.unique([each.frequency for each in within])
    values = np.full((len(frequencies), len(rig.eras), len(sensors)), np.nan, dtype=complex)
    column = {name: number for number, name in enumerate(sensors)}
    for (frequency, number, sensor), value in found.items():
        values[np.searchsorted(frequencies, frequency), number, column[sensor]] = value
    # A point at the edge may have been rounded off the plate.
    points = np.clip(list(sensors.values()), 0, [rig.plate.length, rig.plate.width])
    return Responses(
        tuple(sensors),
        points,
        frequencies,
        values,
        skipped=skipped,
        masses=np.array([*masses.values()]),
    )


def _check_point(measured: MeasuredValue, rig: Rig) -> None:
    plate, (x, y) = rig.plate, measured.point
    within = _EDGE_TOLERANCE
    if not (-within <= x <= plate.length + within and -within <= y <= plate.width + within):
        raise InputError(
            f"{measured.place}: sensor {measured.sensor} must be on the rig's plate, from "
            f"(0, 0) to ({plate.length:g}, {plate.width:g}) m, got {_shown(measured.point)} m; "
            "check the plate and the unit"
        )


def _check_unit(measured: MeasuredValue, actuator: Actuator) -> None:
    if measured.is_per_volt != (actuator.UNIT == "V"):
        right, wrong = ("volt at the exciter", "displacement of the base of an ERA")
        if measured.is_per_volt:
            right, wrong = wrong, right
        raise InputError(
            f"{measured.place}: response to {actuator.name} must be acceleration per {right}, got "
            f"per {wrong}; check the rig, or its unit"
        )


def _era_of(measured: MeasuredValue, rig: Rig) -> int:
    """Find the number of the ERA that was driven, by its name or else by its position."""
    at, names = measured.era_point, [era.name for era in rig.eras]
    for number, era in enumerate(rig.eras):
        near = at is not None and math.dist(at, (era.x, era.y)) <= _ERA_TOLERANCE
        if era.name == measured.era:
            if at is not None and not near:
                raise InputError(
                    f"{measured.place}: ERA {era.name} must be at {_shown((era.x, era.y))} m "
                    f"as in the rig, got {_shown(at)} m; check the plate"
                )
            return number
        if near and measured.era not in names:
            return number
    known = ", ".join(f"{era.name} {_shown((era.x, era.y))}" for era in rig.eras)
    raise InputError(
        f"{measured.place}: ERA must be one of {known}, got {measured.era or _shown(at or (0, 0))}"
    )


def _shown(point: tuple[float, float]) -> str:
    return f"({point[0]:g}, {point[1]:g})"


@dataclass(frozen=True, eq=False)
class Screening:
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
    heard = [typical(share[:, :, s]) for s in range(size.shape[2])]
    return ~(np.array(heard) >= _SILENT_SENSOR)


def check_enough_sensors(alive: NDArray[np.bool_], responses: Responses) -> None:
    """Raise InputError unless enough sensors (s,) have a signal."""
    if alive.sum() < LEAST_SENSORS:
        dead = ", ".join(compress(responses.sensors, ~alive))
        without = f" ({dead} without a signal)" if dead else ""
        raise InputError(
            f"at least {LEAST_SENSORS} sensors must have a signal, better eight or more, got "
            f"{alive.sum()}{without}"
        )


def typical(values: NDArray[np.inexact]) -> float:
    """Median magnitude of finite values; NaN without any."""
    finite = np.abs(values)[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")
