"""Responses from a stepped sine that any converter has measured: CSV or WAV files.

Of a sensor's samples by those of a reference, an input that a cable connects with what plays: the
same that `era measure` finds by itself. CSV columns are `frequency_hz`, `output`, `sensor`, and
`magnitude` or `magnitude_db` with `phase_deg`, or `real` with `imag`. An output is an ERA's name,
or its number from 1. What a file does not say is in its name: SENSOR-OUTPUT.csv, or SENSOR.wav.
"""

import cmath
import math
from collections.abc import Iterator
from pathlib import Path

from model.calibration.responses import MeasuredValue
from model.calibration.sensor_file import WiredSensor, are_places
from model.errors import InputError
from model.files.csv_file import Line, read_lines
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.stepped_recording import Tone, tones_of

_OPTIONAL = ("output", "sensor", "magnitude", "magnitude_db", "phase_deg", "real", "imag")
_ENDINGS = (".csv", ".wav")


def read_stepped(source: Path, desk: Desk) -> list[MeasuredValue]:
    """Read a file, or all of a folder; raises InputError with file and line or time."""
    files = [source]
    if source.is_dir():
        files = sorted(each for each in source.iterdir() if each.suffix.lower() in _ENDINGS)
    if not files or any(each.suffix.lower() not in _ENDINGS for each in files):
        raise InputError(f"--from {source}: must be a .csv or .wav file, or a folder with such")
    found: list[MeasuredValue] = []
    for path in files:
        read = _of_recording if path.suffix.lower() == ".wav" else _of_lines
        found += read(path, desk)
    return found


def _of_lines(path: Path, desk: Desk) -> Iterator[MeasuredValue]:
    for line in read_lines(path, ("frequency_hz",), optional=_OPTIONAL):
        sensor, output = (
            line.cells.get(column) or _in_name(path, number, column)
            for number, column in enumerate(("sensor", "output"))
        )
        place = _sensor(desk, sensor, line.place)
        frequency = line.number("frequency_hz")
        if frequency <= 0:
            raise InputError(f"{line.place}: frequency_hz must be above 0, got {frequency:g}")
        era = _era(desk, output, line.place)
        yield _value(desk, era, place, frequency, _ratio(line), line.place)


def _ratio(line: Line) -> complex:
    """What a line has of a sensor's samples by the reference's."""
    given = line.cells.keys()
    if {"real", "imag"} <= given:
        return complex(line.number("real"), line.number("imag"))
    if "phase_deg" in given and ("magnitude" in given or "magnitude_db" in given):
        size = (
            line.number("magnitude")
            if "magnitude" in given
            else 10 ** (line.number("magnitude_db") / 20)
        )
        if size < 0:
            raise InputError(f"{line.place}: magnitude must be 0 or more, got {size:g}")
        return cmath.rect(size, math.radians(line.number("phase_deg")))
    raise InputError(
        f"{line.place}: columns must have magnitude or magnitude_db with phase_deg, or real with "
        f"imag, got {', '.join(given)}"
    )


def _of_recording(path: Path, desk: Desk) -> Iterator[MeasuredValue]:
    sensors = [*desk.sensors]
    if are_places(sensors):
        sensors = [_sensor(desk, _in_name(path, 0, "sensor"), str(path))]
    names = [name for name, _ in desk.eras]
    if "-" in path.stem:
        names = [_era(desk, _in_name(path, 1, "output"), str(path))]
    for tone in tones_of(path, sensors, names):
        for sensor, ratio in zip(sensors, tone.ratios, strict=True):
            if ratio is not None:
                yield _value(desk, tone.era, sensor, tone.frequency, ratio, _at(path, tone))


def _at(path: Path, tone: Tone) -> str:
    return f"{path} at {tone.start:.1f} s"


def _in_name(path: Path, number: int, what: str) -> str:
    """The part of a file's name SENSOR-OUTPUT that stands for what a column would say."""
    parts = path.stem.rpartition("-")[::2] if "-" in path.stem else (path.stem, "")
    if not parts[number]:
        raise InputError(
            f"{path}: must have a column {what}, or a name such as SENSOR-OUTPUT{path.suffix}, for "
            f"instance P3-1{path.suffix}"
        )
    return parts[number]


def _sensor(desk: Desk, name: str, place: str) -> WiredSensor:
    for sensor in desk.sensors:
        if sensor.name == name:
            return sensor
    known = ", ".join(sensor.name for sensor in desk.sensors)
    raise InputError(f"{place}: sensor must be one of --sensors, {known}, got {name!r}")


def _era(desk: Desk, output: str, place: str) -> str:
    for name, number in desk.eras:
        if output in (name, str(number)):
            return name
    known = ", ".join(f"{number} ({name})" for name, number in desk.eras)
    raise InputError(f"{place}: output must be one of {known}, got {output!r}")


def _value(
    desk: Desk, era: str, sensor: WiredSensor, frequency: float, ratio: complex, place: str
) -> MeasuredValue:
    actuator = desk.rig.era(era)
    return MeasuredValue(
        era,
        sensor.name,
        (sensor.x, sensor.y),
        None,
        frequency,
        ratio / actuator.full_level / sensor.sensitivity,
        place,
        sensor.mass,
        is_per_volt=actuator.UNIT == "V",
    )
