"""Measured responses of a rig, their files, and the accelerometer file.

A CSV file has the columns `COLUMNS`, one value per row, in any order. A UFF file has a function of
type 4 for every sensor and ERA, acceleration over displacement, with the nodes' positions in
dataset 15 or 2411. The reference node is the ERA, identified by name or position. Responses to
exciters are per volt: in columns `real_m_s2_v` and `imag_m_s2_v`, or in functions whose reference
has the general data type (1) and the unit V. The mass of a moved sensor and the setting of a
measurement have their own columns, or are in the second line of free text of a function:
`sensor_mass_g=2 setting=level 0.1`.

Sensor positions are read from the accelerometer file, whose other columns describe their inputs
(`era_haptics.lab.measuring.measure`).
"""

import logging
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from model.answer.stimulus import check_on_plate
from model.arrays import ComplexArray, FloatArray, Point
from model.errors import InputError
from model.estimate.forward import Sensor
from model.files.csv_file import Column, CsvLine, read_lines, write_columns
from model.files.uff import (
    ACCELERATION,
    DISPLACEMENT,
    FREQUENCY_RESPONSE,
    UFF_FREQUENCY,
    Function,
    Universal,
    read_universal,
    write_universal,
)
from model.rig.rig import Rig
from model.structure.exciter import Actuator
from model.structure.plate import Plate
from model.structure.statics import GRAVITY

# Tolerances of a ruler [m]: of an ERA's position, and of a sensor beyond the plate's edge.
_ERA_TOLERANCE = 5e-3
_EDGE_TOLERANCE = 1e-3
_logger = logging.getLogger(__name__)
_SILENT_SENSOR = 0.005  # of the loudest sensor, in the median over frequencies and ERAs
LEAST_SENSORS = 3
"""Minimum number of sensors with a signal for fitting a plate."""

COLUMNS = ("era", "sensor", "x_m", "y_m", "frequency_hz", "real_1_s2", "imag_1_s2")
_PER_VOLT = ("real_m_s2_v", "imag_m_s2_v")
ERA_COLUMNS = ("era_x_m", "era_y_m")  # optional
_MASS, SETTING = "sensor_mass_g", "setting"  # optional, too
_NOTE = re.compile(rf"\b{_MASS}=(?P<mass>\S+)(?:\s+{SETTING}=(?P<setting>.*))?")
MAX_SENSOR_MASS = 500.0
"""Largest mass of a moved sensor [g]; a heavier one is not an accelerometer."""

_UP = 3  # +z
_GENERAL = 1  # data type of any other quantity
_FIRST_ERA_NODE = 1001
# SI units by label, without blanks, brackets, powers' signs and the dot of abbreviations.
_ACCELERATION_UNITS = {
    **dict.fromkeys(("", "m/s2", "m/s/s", "m/ss", "ms-2", "ms2", "meter/s2"), 1.0),
    **dict.fromkeys(("mm/s2", "mm/s/s"), 1e-3),
    **dict.fromkeys(("g", "gs", "gn", "g0"), GRAVITY),
    **dict.fromkeys(("in/s2", "in/s/s", "inch/s2"), 0.0254),
}
_DISPLACEMENT_UNITS = {
    **dict.fromkeys(("", "m", "meter", "metre"), 1.0),
    **dict.fromkeys(("mm",), 1e-3),
    **dict.fromkeys(("um", "micron"), 1e-6),
    **dict.fromkeys(("in", "inch"), 0.0254),
}
_FREQUENCY_UNITS = {
    **dict.fromkeys(("", "hz", "hertz", "1/s", "s-1", "cps"), 1.0),
    "khz": 1e3,
    "rad/s": 0.5 / math.pi,
}
_SPELLED = {ord("²"): "2", ord("µ"): "u", ord("μ"): "u", **dict.fromkeys(map(ord, "^*()[]{}·.' "))}

PLACE_COLUMNS = ("sensor", "x_m", "y_m")
INPUT_COLUMNS = ("input", "mv_per_m_s2", "gain", "full_scale_v", "mass_g")

NONLINEAR = 0.02
"""Relative difference of responses at two levels beyond which a plate is not linear."""

DRIFTED = 0.01
"""Relative difference of the first tone, played last again, beyond which a plate has changed."""

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
        sensors = []
        for sensor, (x, y) in zip(self.sensors, points.tolist(), strict=True):
            sensors.append(replace(sensor, x=x, y=y))
        return replace(self, sensors=tuple(sensors))

    def check(self) -> None:
        """Raise InputError for a plate that was not linear or has changed during the
        measurement."""
        _check_repeats(self.half_level, NONLINEAR, "at half the level; measure at a lower level")
        _check_repeats(
            self.at_end, DRIFTED, "at the end; wait until the plate has settled, measure again"
        )


def _check_repeats(repeats: Sequence[Repeat], limit: float, cause: str) -> None:
    """Raise InputError if responses to a tone that was measured twice differ too much."""
    for repeat in repeats:
        size = np.linalg.norm(repeat.values)
        difference = np.linalg.norm(repeat.repeated - repeat.values) / size
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


def sensors_at(
    points: FloatArray, names: Sequence[str] = (), *, mass: float = 0.0
) -> tuple[Sensor, ...]:
    """Sensors at points (s, 2) [m] of the plate, by default numbered; mass: as `Sensor.mass`."""
    if not names:
        names = [f"sensor {number}" for number in range(len(points))]
    sensors = []
    for name, (x, y) in zip(names, np.asarray(points).tolist(), strict=True):
        sensors.append(Sensor(name, x=x, y=y, mass=mass))
    return tuple(sensors)


@dataclass(frozen=True)
class MeasuredValue:
    """Acceleration at a sensor per base displacement of an ERA, or per volt at an exciter.

    Phases as exp(+i omega t), upwards positive for both.
    """

    era: str
    """Name of the ERA, "" if only its position is known."""
    sensor: str
    point: tuple[float, float]
    """Position of the sensor x, y [m]."""
    era_point: tuple[float, float] | None
    """Position of the ERA x, y [m], None if unknown."""
    frequency: float
    """Frequency [Hz]."""
    value: complex
    """Response [1/s²], per volt [m/s²/V]."""
    place: str
    """File and line, for errors."""
    sensor_mass: float = 0.0
    """Mass of a sensor that is moved [kg], as `Sensor.mass`."""
    setting: str = ""
    """Setting of the measurement in words, "" if unknown."""
    is_per_volt: bool = False
    """Whether it is per volt at an exciter."""


def measurement_of(measured: Sequence[MeasuredValue], rig: Rig) -> Measurement:
    """Combine values into a measurement of a rig's plate; drives are assumed to lag (sound card).

    Values outside the rig's frequency limits, such as a spectrum's 0 Hz line, are skipped. Raises
    InputError, with file and line, for points off the plate, unknown ERAs or positions, duplicate
    responses, a sensor at two positions, and if no value is left.
    """
    within = _within_limits(measured, rig)
    first: dict[str, MeasuredValue] = {}
    eras: dict[tuple[str, Point | None], int] = {}
    responses: dict[tuple[float, int, str], complex] = {}
    for response in within:
        if response.sensor not in first:
            _check_point(response, rig)
            first[response.sensor] = response
        _check_sensor(response, first[response.sensor])
        drive = (response.era, response.era_point)
        if drive not in eras:
            eras[drive] = _era_of(response, rig)
        number = eras[drive]
        _check_unit(response, rig.eras[number])
        path = (response.frequency, number, response.sensor)
        if path in responses:
            raise InputError(
                f"{response.place}: response of sensor {response.sensor} to ERA "
                f"{rig.eras[number].name} at {response.frequency:g} Hz must be given once, got two"
            )
        responses[path] = response.value
    frequencies = np.unique([response.frequency for response in within])
    values = np.full((len(frequencies), len(first), len(rig.eras)), np.nan, dtype=complex)
    rows = {frequency: row for row, frequency in enumerate(frequencies.tolist())}
    columns = {name: column for column, name in enumerate(first)}
    for (frequency, number, sensor), value in responses.items():
        values[rows[frequency], columns[sensor], number] = value
    return Measurement(
        sensors=tuple(_sensor_at(response, rig.plate) for response in first.values()),
        frequencies=frequencies,
        values=values,
        drives_lag=True,
        skipped=len(measured) - len(within),
    )


def _within_limits(measured: Sequence[MeasuredValue], rig: Rig) -> list[MeasuredValue]:
    """Return the values within the rig's frequency limits; raises InputError if none is."""
    low = rig.limits.frequency_min
    high = rig.limits.frequency_max
    within = [response for response in measured if low <= response.frequency <= high]
    limits = f"the rig's limits.frequency of {low:g} to {high:g} Hz"
    if measured and not within:
        raise InputError(
            f"{measured[0].place}: a frequency must be within {limits}, got "
            f"{measured[0].frequency:g} Hz; measure others or widen the limits"
        )
    skipped = len(measured) - len(within)
    if skipped:
        _logger.warning("%d of %d values beyond %s are left out", skipped, len(measured), limits)
    return within


def _sensor_at(measured: MeasuredValue, plate: Plate) -> Sensor:
    """Return the sensor of a value; a point at the edge may have been rounded off the plate."""
    x, y = np.clip(measured.point, 0, [plate.length, plate.width]).tolist()
    return Sensor(measured.sensor, x=x, y=y, mass=measured.sensor_mass)


def _check_unit(measured: MeasuredValue, era: Actuator) -> None:
    """Raise InputError if a response is per volt at an ERA, or per displacement at an exciter."""
    if measured.is_per_volt == (era.UNIT == "V"):
        return
    right, wrong = "volt at the exciter", "displacement of the base of an ERA"
    if measured.is_per_volt:
        right, wrong = wrong, right
    raise InputError(
        f"{measured.place}: response to {era.name} must be acceleration per {right}, got "
        f"per {wrong}; check the rig, or its unit"
    )


def _check_sensor(measured: MeasuredValue, first: MeasuredValue) -> None:
    """Raise InputError unless a sensor is where its first value has it, and weighs as much."""
    subject = f"{measured.place}: sensor {measured.sensor}"
    if math.dist(first.point, measured.point) > _EDGE_TOLERANCE:
        raise InputError(
            f"{subject} must have one position, got {_shown(first.point)} ({first.place}) and "
            f"{_shown(measured.point)} m; name sensors differently"
        )
    if measured.sensor_mass != first.sensor_mass:
        raise InputError(
            f"{subject} must have one mass, got {1e3 * first.sensor_mass:g} ({first.place}) and "
            f"{1e3 * measured.sensor_mass:g} g"
        )


def _check_point(measured: MeasuredValue, rig: Rig) -> None:
    plate = rig.plate
    x, y = measured.point
    is_within_length = -_EDGE_TOLERANCE <= x <= plate.length + _EDGE_TOLERANCE
    is_within_width = -_EDGE_TOLERANCE <= y <= plate.width + _EDGE_TOLERANCE
    if not (is_within_length and is_within_width):
        raise InputError(
            f"{measured.place}: sensor {measured.sensor} must be on the rig's plate, from "
            f"(0, 0) to ({plate.length:g}, {plate.width:g}) m, got {_shown(measured.point)} m; "
            "check the plate and the unit"
        )


def _era_of(measured: MeasuredValue, rig: Rig) -> int:
    """Return the index of the driven ERA, found by name or else by position."""
    point = measured.era_point
    names = [era.name for era in rig.eras]
    for number, era in enumerate(rig.eras):
        is_near = point is not None and math.dist(point, (era.x, era.y)) <= _ERA_TOLERANCE
        if era.name == measured.era:
            if point is not None and not is_near:
                raise InputError(
                    f"{measured.place}: ERA {era.name} must be at {_shown((era.x, era.y))} m, its "
                    f"position in the rig, got {_shown(point)} m; check the plate"
                )
            return number
        if is_near and measured.era not in names:
            return number
    positions = ", ".join(f"{era.name} {_shown((era.x, era.y))}" for era in rig.eras)
    unknown = measured.era or _shown(point or (0, 0))
    raise InputError(f"{measured.place}: ERA must be one of {positions}, got {unknown}")


def _shown(point: tuple[float, float]) -> str:
    return f"({point[0]:g}, {point[1]:g})"


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


def read_measured(path: Path) -> list[MeasuredValue]:
    """Read measured responses; raises InputError with file and line."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _read_csv(path)
    if suffix in (".uff", ".unv"):
        return _read_uff(path)
    raise InputError(f"{path}: name of measured responses must end in .csv, .uff or .unv")


def write_responses(path: Path, measurement: Measurement, rig: Rig, *, setting: str = "") -> None:
    """Write responses as CSV or UFF by the name's ending; setting: as `MeasuredValue`.

    Raises OSError.
    """
    if path.suffix.lower() == ".csv":
        write_responses_csv(path, measurement, rig, setting=setting)
    else:
        write_responses_uff(path, measurement, rig, setting=setting)


def write_responses_csv(
    path: Path, measurement: Measurement, rig: Rig, *, setting: str = ""
) -> None:
    """Write responses as CSV with all digits.

    Raises OSError; InputError for a rig with both ERAs and exciters, whose units differ.
    """
    units = {era.UNIT for era in rig.eras}
    if len(units) > 1:
        raise InputError(f"{path}: ERAs and exciters need a .uff file, whose functions have units")
    real, imaginary = _PER_VOLT if "V" in units else COLUMNS[-2:]
    measured = measurement.values.swapaxes(1, 2)
    f, e, s = np.nonzero(np.isfinite(measured))
    values = measured[f, e, s]
    points = measurement.points[s]
    eras = [rig.eras[number] for number in e]
    columns: dict[str, Column] = {
        "era": [era.name for era in eras],
        "era_x_m": [era.x for era in eras],
        "era_y_m": [era.y for era in eras],
        "sensor": [measurement.names[number] for number in s],
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "frequency_hz": measurement.frequencies[f],
        real: values.real,
        imaginary: values.imag,
    }
    masses = np.array([sensor.mass for sensor in measurement.sensors])
    if masses.any():
        columns[_MASS] = 1e3 * masses[s]
    if setting:
        columns[SETTING] = [setting] * len(s)
    write_columns(path, columns)


def write_responses_uff(
    path: Path, measurement: Measurement, rig: Rig, *, setting: str = ""
) -> None:
    """Write responses as UFF 58: nodes from 1 are sensors, nodes from 1001 ERAs; raises OSError."""
    nodes = {}
    for number, sensor in enumerate(measurement.sensors, start=1):
        nodes[number] = (sensor.x, sensor.y, 0.0)
    functions = []
    for e, era in enumerate(rig.eras):
        nodes[_FIRST_ERA_NODE + e] = (era.x, era.y, 0.0)
        data_type = DISPLACEMENT if era.UNIT == "m" else _GENERAL
        for s, sensor in enumerate(measurement.sensors):
            values = measurement.values[:, s, e]
            measured = np.isfinite(values)
            note = ""
            if setting or sensor.mass:
                note = f"{_MASS}={1e3 * sensor.mass:.10g} {SETTING}={setting}"
            if measured.any():
                functions.append(
                    Function(
                        place=str(path),
                        function_type=FREQUENCY_RESPONSE,
                        response=s + 1,
                        reference=_FIRST_ERA_NODE + e,
                        names=(sensor.name, era.name),
                        directions=(_UP, _UP),
                        x=measurement.frequencies[measured],
                        data=values[measured],
                        data_types=(UFF_FREQUENCY, ACCELERATION, data_type),
                        units=("m/s^2", era.UNIT),
                        note=note,
                    )
                )
    write_universal(path, Universal(nodes, functions))


def _read_csv(path: Path) -> list[MeasuredValue]:
    optional = (*ERA_COLUMNS, _MASS, SETTING)
    lines = read_lines(path, COLUMNS, optional=optional, instead=_PER_VOLT)
    return [_csv_value(path, line) for line in lines]


def _csv_value(path: Path, line: CsvLine) -> MeasuredValue:
    era_numbers = [line.number(name) for name in ERA_COLUMNS if name in line.cells]
    if len(era_numbers) == 1:
        raise InputError(f"{path}:1: {' and '.join(ERA_COLUMNS)} must be given together")
    is_per_volt = _PER_VOLT[0] in line.cells
    real, imaginary = _PER_VOLT if is_per_volt else COLUMNS[-2:]
    point = (line.number("x_m"), line.number("y_m"))
    frequency = line.number("frequency_hz")
    value = complex(line.number(real), line.number(imaginary))
    era = line.cells["era"]
    sensor = line.cells["sensor"]
    if not (era and sensor):
        raise InputError(f"{line.place}: era and sensor must have names")
    if frequency < 0:
        raise InputError(f"{line.place}: frequency_hz must be 0 or more, got {frequency:g}")
    return MeasuredValue(
        era=era,
        sensor=sensor,
        point=point,
        era_point=(era_numbers[0], era_numbers[1]) if era_numbers else None,
        frequency=frequency,
        value=value,
        place=line.place,
        sensor_mass=sensor_mass(line.place, line.number(_MASS, 0.0)),
        setting=line.cells.get(SETTING, ""),
        is_per_volt=is_per_volt,
    )


def _read_uff(path: Path) -> list[MeasuredValue]:
    content = read_universal(path)
    functions = [f for f in content.functions if f.function_type == FREQUENCY_RESPONSE]
    if not functions:
        raise InputError(
            f"{path}: file must have frequency responses (dataset 58, function type 4), got none; "
            "export acceleration over the base displacement of an ERA"
        )
    nodes: dict[str, set[int]] = {}
    for function in functions:
        name, _ = function.names
        nodes.setdefault(name, set()).add(function.response)
    measured = []
    for function in functions:
        measured += _uff_values(function, content, nodes)
    return measured


def _uff_values(
    function: Function, content: Universal, nodes: dict[str, set[int]]
) -> list[MeasuredValue]:
    """Return the values of a function; nodes: of the sensors, by name."""
    place = function.place
    is_per_volt = _is_per_volt(function)
    scale = _unit(place, function.units[0], _ACCELERATION_UNITS)
    if not is_per_volt:
        scale /= _unit(place, function.units[1], _DISPLACEMENT_UNITS)
    hertz = _unit(place, function.abscissa_unit, _FREQUENCY_UNITS)
    _check_function(function, content)
    for direction in function.directions:
        if direction < 0:
            scale = -scale
    sensor, era = function.names
    if not sensor or len(nodes[sensor]) > 1:
        sensor = f"{sensor or 'node'}:{function.response}"
    x, y, _ = map(float, content.nodes[function.response])
    era_point = None
    if function.reference in content.nodes:
        era_x, era_y, _ = map(float, content.nodes[function.reference])
        era_point = (era_x, era_y)
    mass, setting = _noted(function)
    measured = []
    for frequency, value in zip(function.x.tolist(), function.data.tolist(), strict=True):
        measured.append(
            MeasuredValue(
                era=era,
                sensor=sensor,
                point=(x, y),
                era_point=era_point,
                frequency=hertz * frequency,
                value=scale * value,
                place=place,
                sensor_mass=mass,
                setting=setting,
                is_per_volt=is_per_volt,
            )
        )
    return measured


def _is_per_volt(function: Function) -> bool:
    """Whether a function is per volt; raises InputError for another quantity."""
    _, response_type, reference_type = function.data_types
    is_per_volt = reference_type == _GENERAL and function.units[1].lower() == "v"
    if response_type != ACCELERATION or not (is_per_volt or reference_type == DISPLACEMENT):
        raise InputError(
            f"{function.place}: data types must be acceleration ({ACCELERATION}) over displacement "
            f"({DISPLACEMENT}) of an ERA's base, or over volts ({_GENERAL}, in V) of an exciter, "
            f"got {response_type} over {reference_type}"
        )
    return is_per_volt


def _check_function(function: Function, content: Universal) -> None:
    """Raise InputError for a function without phases, direction or position."""
    place = function.place
    if not np.iscomplexobj(function.data):
        raise InputError(f"{place}: response must be complex, got real; export it with phases")
    if any(abs(direction) not in (0, _UP) for direction in function.directions):
        raise InputError(
            f"{place}: directions must be across the plate (3 or -3, z), got "
            f"{function.directions[0]} and {function.directions[1]}"
        )
    if function.response not in content.nodes:
        raise InputError(
            f"{place}: node {function.response} must have a position; export nodes too (dataset 15 "
            "or 2411)"
        )


def _unit(place: str, label: str, units: Mapping[str, float]) -> float:
    """Return the SI value of the unit with a given label; raises InputError."""
    plain = label.lower().translate(_SPELLED).replace("sec", "s")
    if plain not in units:
        spelled = ", ".join(filter(None, units))
        raise InputError(f"{place}: unit must be one of {spelled}, got {label!r}; export it so")
    return units[plain]


def _noted(function: Function) -> tuple[float, str]:
    """Return sensor mass [kg] and setting from the free text of a function; raises InputError."""
    note = _NOTE.search(function.note)
    if note is None:
        return 0.0, ""
    try:
        mass = float(note["mass"])
    except ValueError:
        mass = math.nan
    return sensor_mass(function.place, mass), (note["setting"] or "").strip()


def sensor_mass(place: str, grams: float, *, column: str = _MASS) -> float:
    """Convert a sensor's mass from grams in a column to [kg]; raises InputError."""
    if not 0 <= grams <= MAX_SENSOR_MASS:  # nor for NaN
        raise InputError(
            f"{place}: {column} must be from 0 to {MAX_SENSOR_MASS:g}, got {grams:g}; it is in "
            "grams"
        )
    return grams / 1e3


def read_places(path: Path, plate: Plate) -> dict[str, Point]:
    """Read positions of sensors [m] on a plate by name; raises InputError with file and line."""
    places: dict[str, Point] = {}
    for line in read_lines(path, PLACE_COLUMNS, optional=INPUT_COLUMNS):
        name, point = named_place(line, places, plate)
        places[name] = point
    return places


def named_place(line: CsvLine, names: Collection[str], plate: Plate) -> tuple[str, Point]:
    """Return name and position of a sensor; raises InputError for a name among earlier names."""
    name = line.cells["sensor"]
    if not name or name in names:
        raise InputError(f"{line.place}: sensor must be a name that no other has, got {name!r}")
    point = (line.number("x_m"), line.number("y_m"))
    check_on_plate(f"{line.place}: sensor {name}", [point], plate)
    return name, point
