"""Measured responses of a rig, their files, and the accelerometer file.

A CSV file has the columns `COLUMNS`, one value per row, in any order. A UFF file has a function of
type 4 for every sensor and ERA, acceleration over displacement, with the nodes' positions in
dataset 15 or 2411. The reference node is the ERA, identified by name or position. Responses to
exciters are per volt: in columns `real_m_s2_v` and `imag_m_s2_v`, or in functions whose reference
has the general data type (1) and the unit V. The mass of a moved sensor and the setting of a
measurement have their own columns, or are in the second line of free text of a function:
`sensor_mass_g=2 setting=level 0.1`.

Sensor positions are read from the accelerometer file, whose other columns describe their inputs
(`era_haptics.lab.measuring.sound_card`).
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
from model.structure.attachments import GRAVITY
from model.structure.plate import Plate

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
_GENERAL = 1  # a data type without one of its own
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

# Of readings: their usual error, relative, and its floor,
_NOISE = 0.01
_FLOOR = 0.1  # of a sensor's rms: below it an error no longer falls with the response


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
    bases: ComplexArray | None = None
    """Amplitude of each ERA (f, eras) if all play together as one channel, None if each plays
    alone."""

    def __post_init__(self) -> None:
        """Raise InputError for unordered frequencies."""
        if not (np.diff(self.frequencies) > 0).all():
            raise InputError("measurement: frequencies must ascend, each once")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors (s,)."""
        return tuple(each.name for each in self.sensors)

    @property
    def points(self) -> FloatArray:
        """Positions of the sensors (s, 2) [m]."""
        return np.array([(each.x, each.y) for each in self.sensors]).reshape(-1, 2)

    @cached_property
    def std(self) -> FloatArray:
        """Standard error of the real and of the imaginary part (f, s, n), infinite for outliers.

        The default is 1 % of a response plus 1 % of a tenth of its sensor's RMS, since a response
        can be zero. Raises InputError for a standard error of zero.
        """
        found = self.errors
        if found is None:
            measured = np.isfinite(self.values)
            squares = np.where(measured, np.abs(self.values), 0.0) ** 2
            count = measured.sum(axis=(0, 2))[:, None]
            rms2 = squares.sum(axis=(0, 2))[:, None] / np.maximum(count, 1)
            found = _NOISE * np.sqrt(squares + _FLOOR**2 * rms2)
        least = np.where(np.isfinite(self.values), found, np.inf).min(initial=np.inf)
        if not least > 0:
            raise InputError(f"measurement: std must be above zero, got {least:g}")
        return found

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
        if self.bases is not None:
            mixed = np.einsum("fse...,fe->fs...", responses, self.bases)
            return np.asarray(mixed[:, :, None])
        return responses[:, :, list(self.drives)] if self.drives else responses

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.known.sum())

    @cached_property
    def tone_rms(self) -> FloatArray:
        """RMS of the values at each tone, (f, 1, 1) [1/s²]."""
        squares = np.where(self.known, np.abs(self.values) ** 2, 0.0)
        count = self.known.sum(axis=(1, 2), keepdims=True)
        return np.asarray(np.sqrt(squares.sum(axis=(1, 2), keepdims=True) / np.maximum(count, 1)))

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
        places = zip(self.sensors, points.tolist(), strict=True)
        return replace(self, sensors=tuple(replace(each, x=x, y=y) for each, (x, y) in places))

    def check(self) -> None:
        """Raise InputError for a plate that was not linear or has changed during the
        measurement."""
        for repeats, limit, cause in (
            (self.half_level, NONLINEAR, "at half the level; measure at a lower level"),
            (self.at_end, DRIFTED, "at the end; wait until the plate has settled, measure again"),
        ):
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
    called = names or [f"sensor {number}" for number in range(len(points))]
    at = zip(called, np.asarray(points).tolist(), strict=True)
    return tuple(Sensor(name, x=x, y=y, mass=mass) for name, (x, y) in at)


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
    first: dict[str, MeasuredValue] = {}
    eras: dict[tuple[str, tuple[float, float] | None], int] = {}
    found: dict[tuple[float, int, str], complex] = {}
    for each in within:
        if each.sensor not in first:
            _check_point(each, rig)
        _check_sensor(each, first.setdefault(each.sensor, each))
        if (each.era, each.era_point) not in eras:
            eras[each.era, each.era_point] = _era_of(each, rig)
        number = eras[each.era, each.era_point]
        actuator = rig.eras[number]
        if each.is_per_volt != (actuator.UNIT == "V"):
            right, wrong = ("volt at the exciter", "displacement of the base of an ERA")
            if each.is_per_volt:
                right, wrong = wrong, right
            raise InputError(
                f"{each.place}: response to {actuator.name} must be acceleration per {right}, got "
                f"per {wrong}; check the rig, or its unit"
            )
        if (each.frequency, number, each.sensor) in found:
            raise InputError(
                f"{each.place}: response of sensor {each.sensor} to ERA {rig.eras[number].name} "
                f"at {each.frequency:g} Hz must be given once, got two"
            )
        found[each.frequency, number, each.sensor] = each.value
    frequencies = np.unique([each.frequency for each in within])
    values = np.full((len(frequencies), len(first), len(rig.eras)), np.nan, dtype=complex)
    column = {name: number for number, name in enumerate(first)}
    for (frequency, number, sensor), value in found.items():
        values[np.searchsorted(frequencies, frequency), column[sensor], number] = value
    # A point at the edge may have been rounded off the plate.
    points = [each.point for each in first.values()]
    points = np.clip(points, 0, [rig.plate.length, rig.plate.width]).tolist()
    at = zip(first.values(), points, strict=True)
    return Measurement(
        tuple(Sensor(each.sensor, x=x, y=y, mass=each.sensor_mass) for each, (x, y) in at),
        frequencies,
        values,
        drives_lag=True,
        skipped=skipped,
    )


def _check_sensor(measured: MeasuredValue, first: MeasuredValue) -> None:
    """Raise InputError unless a sensor is where its first value has it, and weighs as much."""
    of, before = f"{measured.place}: sensor {measured.sensor}", first.place
    if math.dist(first.point, measured.point) > _EDGE_TOLERANCE:
        raise InputError(
            f"{of} must have one position, got {_shown(first.point)} ({before}) and "
            f"{_shown(measured.point)} m; name sensors differently"
        )
    if measured.sensor_mass != first.sensor_mass:
        raise InputError(
            f"{of} must have one mass, got {1e3 * first.sensor_mass:g} ({before}) and "
            f"{1e3 * measured.sensor_mass:g} g"
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


def _era_of(measured: MeasuredValue, rig: Rig) -> int:
    """Return the index of the driven ERA, found by name or else by position."""
    at, names = measured.era_point, [era.name for era in rig.eras]
    for number, era in enumerate(rig.eras):
        near = at is not None and math.dist(at, (era.x, era.y)) <= _ERA_TOLERANCE
        if era.name == measured.era:
            if at is not None and not near:
                raise InputError(
                    f"{measured.place}: ERA {era.name} must be at {_shown((era.x, era.y))} m, its "
                    f"position in the rig, got {_shown(at)} m; check the plate"
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


def silent_sensors(measurement: Measurement) -> NDArray[np.bool_]:
    """Return a mask of sensors without a response to any ERA (s,)."""
    size = np.abs(measurement.values)
    loudest = np.where(np.isfinite(size), size, 0).max(axis=1, keepdims=True)
    share = size / np.where(loudest > 0, loudest, np.nan)
    heard = [typical(share[:, s]) for s in range(size.shape[1])]
    return ~(np.array(heard) >= _SILENT_SENSOR)


def check_enough_sensors(alive: NDArray[np.bool_], measurement: Measurement) -> None:
    """Raise InputError unless enough sensors (s,) have a signal."""
    if alive.sum() < LEAST_SENSORS:
        dead = ", ".join(compress(measurement.names, ~alive))
        without = f" ({dead} without a signal)" if dead else ""
        raise InputError(
            f"at least {LEAST_SENSORS} sensors must have a signal (eight or more are better), got "
            f"{alive.sum()}{without}"
        )


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
    write = write_responses_csv if path.suffix.lower() == ".csv" else write_responses_uff
    write(path, measurement, rig, setting=setting)


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
    values, points = measured[f, e, s], measurement.points
    masses = np.array([each.mass for each in measurement.sensors])
    further: dict[str, Column] = {}
    if masses.any():
        further[_MASS] = 1e3 * masses[s]
    if setting:
        further[SETTING] = [setting] * len(s)
    write_columns(
        path,
        {
            "era": [rig.eras[number].name for number in e],
            "era_x_m": [rig.eras[number].x for number in e],
            "era_y_m": [rig.eras[number].y for number in e],
            "sensor": [measurement.names[number] for number in s],
            "x_m": points[s, 0],
            "y_m": points[s, 1],
            "frequency_hz": measurement.frequencies[f],
            real: values.real,
            imaginary: values.imag,
            **further,
        },
    )


def write_responses_uff(
    path: Path, measurement: Measurement, rig: Rig, *, setting: str = ""
) -> None:
    """Write responses as UFF 58: nodes 1.. are the sensors, 1001.. the ERAs; raises OSError."""
    sensors = measurement.sensors
    positions = [*((each.x, each.y) for each in sensors), *((era.x, era.y) for era in rig.eras)]
    numbers = [*range(1, len(sensors) + 1), *range(1001, 1001 + len(rig.eras))]
    functions = []
    for e, era in enumerate(rig.eras):
        reference = (DISPLACEMENT if era.UNIT == "m" else _GENERAL, era.UNIT)
        for s, sensor in enumerate(sensors):
            values = measurement.values[:, s, e]
            measured = np.isfinite(values)
            note = f"{_MASS}={1e3 * sensor.mass:.10g} {SETTING}={setting}"
            if measured.any():
                functions.append(
                    Function(
                        str(path),
                        FREQUENCY_RESPONSE,
                        s + 1,
                        1001 + e,
                        (sensor.name, era.name),
                        (_UP, _UP),
                        measurement.frequencies[measured],
                        values[measured],
                        (UFF_FREQUENCY, ACCELERATION, reference[0]),
                        ("m/s^2", reference[1]),
                        note=note if setting or sensor.mass else "",
                    )
                )
    nodes = {n: (x, y, 0.0) for n, (x, y) in zip(numbers, positions, strict=True)}
    write_universal(path, Universal(nodes, functions))


def _read_csv(path: Path) -> list[MeasuredValue]:
    found = []
    optional = (*ERA_COLUMNS, _MASS, SETTING)
    for line in read_lines(path, COLUMNS, optional=optional, instead=_PER_VOLT):
        is_per_volt = _PER_VOLT[0] in line.cells
        at_era = [line.number(name) for name in ERA_COLUMNS if name in line.cells]
        if len(at_era) == 1:
            raise InputError(f"{path}:1: {' and '.join(ERA_COLUMNS)} must be given together")
        parts = _PER_VOLT if is_per_volt else COLUMNS[-2:]
        x, y, frequency, real, imaginary = map(line.number, (*COLUMNS[2:-2], *parts))
        era, sensor = line.cells["era"], line.cells["sensor"]
        if not (era and sensor):
            raise InputError(f"{line.place}: era and sensor must have names")
        if frequency < 0:
            raise InputError(f"{line.place}: frequency_hz must be 0 or more, got {frequency:g}")
        era_point = (at_era[0], at_era[1]) if at_era else None
        value = complex(real, imaginary)
        mass, setting = line.number(_MASS, 0.0), line.cells.get(SETTING, "")
        found.append(
            MeasuredValue(
                era,
                sensor,
                (x, y),
                era_point,
                frequency,
                value,
                line.place,
                sensor_mass(line.place, mass),
                setting,
                is_per_volt,
            )
        )
    return found


def _read_uff(path: Path) -> list[MeasuredValue]:
    content = read_universal(path)
    functions = [f for f in content.functions if f.function_type == FREQUENCY_RESPONSE]
    if not functions:
        raise InputError(
            f"{path}: file must have frequency responses (dataset 58, function type 4), got none; "
            "export acceleration over the base displacement of an ERA"
        )
    named: dict[str, set[int]] = {}
    for function in functions:
        named.setdefault(function.names[0], set()).add(function.response)
    return [value for function in functions for value in _uff_values(function, content, named)]


def _uff_values(
    function: Function, content: Universal, named: dict[str, set[int]]
) -> list[MeasuredValue]:
    place = function.place
    is_per_volt = function.data_types[2] == _GENERAL and function.units[1].lower() == "v"
    is_known = is_per_volt or function.data_types[2] == DISPLACEMENT
    if function.data_types[1] != ACCELERATION or not is_known:
        raise InputError(
            f"{place}: data types must be acceleration ({ACCELERATION}) over displacement "
            f"({DISPLACEMENT}) of an ERA's base, or over volts ({_GENERAL}, in V) of an exciter, "
            f"got {function.data_types[1]} over {function.data_types[2]}"
        )
    scale = _unit(place, function.units[0], _ACCELERATION_UNITS)
    if not is_per_volt:
        scale /= _unit(place, function.units[1], _DISPLACEMENT_UNITS)
    hertz = _unit(place, function.abscissa_unit, _FREQUENCY_UNITS)
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
    name, reference = function.names[0], content.nodes.get(function.reference)
    if not name or len(named[name]) > 1:
        name = f"{name or 'node'}:{function.response}"
    scale *= math.prod(-1 if direction < 0 else 1 for direction in function.directions)
    x, y, _ = content.nodes[function.response]
    mass, setting = _noted(function)
    era_point = None if reference is None else (float(reference[0]), float(reference[1]))
    return [
        MeasuredValue(
            function.names[1],
            name,
            (float(x), float(y)),
            era_point,
            hertz * frequency,
            scale * value,
            place,
            mass,
            setting,
            is_per_volt,
        )
        for frequency, value in zip(function.x.tolist(), function.data.tolist(), strict=True)
    ]


def _unit(place: str, label: str, known: Mapping[str, float]) -> float:
    """Return the SI value of the unit with a given label; raises InputError."""
    plain = label.lower().translate(_SPELLED).replace("sec", "s")
    if plain not in known:
        spelled = ", ".join(filter(None, known))
        raise InputError(f"{place}: unit must be one of {spelled}, got {label!r}; export it so")
    return known[plain]


def _noted(function: Function) -> tuple[float, str]:
    """Return sensor mass [kg] and setting from the free text of a function; raises InputError."""
    found = _NOTE.search(function.note)
    if found is None:
        return 0.0, ""
    try:
        mass = float(found["mass"])
    except ValueError:
        mass = math.nan
    return sensor_mass(function.place, mass), (found["setting"] or "").strip()


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
        name, at = named_place(line, places, plate)
        places[name] = at
    return places


def named_place(line: CsvLine, before: Collection[str], plate: Plate) -> tuple[str, Point]:
    """Return name and position of a sensor; raises InputError for a duplicate name."""
    name = line.cells["sensor"]
    if not name or name in before:
        raise InputError(f"{line.place}: sensor must be a name that no other has, got {name!r}")
    at = line.number("x_m"), line.number("y_m")
    check_on_plate(f"{line.place}: sensor {name}", [at], plate)
    return name, at
