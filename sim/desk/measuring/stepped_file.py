"""Responses from a stepped sine that any converter has measured: CSV or WAV files.

Of a sensor's samples by those of a reference, an input that a cable connects with what plays: the
same that `era measure` finds by itself. CSV columns are `frequency_hz`, `output`, `sensor`, and
`magnitude` or `magnitude_db` with `phase_deg`, or `real` with `imag`. An output is an ERA's name,
or its number from 1. What a file does not say is in its name: SENSOR-OUTPUT.csv, or SENSOR.wav.
"""

import cmath
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from model.calibration.responses import (
    MeasuredValue,
    Responses,
    WiredSensor,
    are_places,
    responses_of,
    write_responses,
)
from model.errors import InputError
from model.files.csv_file import read_lines
from model.quantities import counted
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.stepped_recording import CLOSE, tones_of

_OPTIONAL = ("output", "sensor", "magnitude", "magnitude_db", "phase_deg", "real", "imag")
_UNNAMED = ("frequency_hz", "magnitude_db", "phase_deg")
_ENDINGS = (".csv", ".wav")


_Known = TypeVar("_Known")


def measured_from(
    source: Path, desk: Desk, output: Path
) -> tuple[list[str | None], dict[str, Any]]:
    """Read files of a stepped sine, write responses, and return the report; raises InputError."""
    found = responses_of(read_stepped(source, desk), desk.rig)
    return written(found, desk, output, source=str(source))


def written(
    found: Responses, desk: Desk, output: Path, *, source: str
) -> tuple[list[str | None], dict[str, Any]]:
    """Write responses that have a source; return the report. Raises InputError."""
    write_responses(output, found, desk.rig)
    absent = [each.name for each in desk.sensors if each.name not in found.sensors]
    lines = found.frequencies
    count = found.values.size - found.count
    rows = [
        f"{source}: {counted(len(found.sensors), 'sensor')}, "
        f"{counted(len(lines), 'frequency', plural='frequencies')} from {lines[0]:g} to "
        f"{lines[-1]:g} Hz, {counted(found.count, 'value')}",
        f"{counted(count, 'value')} missing, or not settled and left out" if count else None,
        f"without {', '.join(absent)}" if absent else None,
        f"wrote {output}",
    ]
    return rows, {
        "frequencies_hz": lines.tolist(),
        "sensors": [*found.sensors],
        "without": absent,
        "values": found.count,
        "values_missing": count,
        "files": [str(output)],
    }


def read_stepped(source: Path, desk: Desk) -> list[MeasuredValue]:
    """Read a file, or all of a folder; raises InputError with file and line or time."""
    files = [source]
    if source.is_dir():
        files = sorted(each for each in source.iterdir() if each.suffix.lower() in _ENDINGS)
    if not files or any(each.suffix.lower() not in _ENDINGS for each in files):
        raise InputError(f"--from {source}: must be a .csv or .wav file, or a folder with such")
    stated: list[MeasuredValue] = []
    heard: list[MeasuredValue] = []
    for path in files:
        if path.suffix.lower() == ".wav":
            heard += _of_recording(path, desk)
        else:
            stated += _of_lines(path, desk)
    # Clocks of converters say nearly, and not quite, the same of one tone in several recordings.
    order, same = np.unique([each.frequency for each in heard]), dict[float, float]()
    while order.size:
        group = order[order <= order[0] * (1 + CLOSE)]
        same |= dict.fromkeys(group.tolist(), float(group.mean()))
        order = order[len(group) :]
    return [*stated, *(replace(each, frequency=same[each.frequency]) for each in heard)]


def _of_lines(path: Path, desk: Desk) -> Iterator[MeasuredValue]:
    for line in read_lines(path, ("frequency_hz",), optional=_OPTIONAL, unnamed=_UNNAMED):
        sensor, output = (
            line.cells.get(column) or _in_name(path, number, column)
            for number, column in enumerate(("sensor", "output"))
        )
        place = _sensor(desk, sensor, line.place)
        frequency = line.number("frequency_hz")
        if frequency <= 0:
            raise InputError(f"{line.place}: frequency_hz must be above 0, got {frequency:g}")
        era = _era(desk, output, line.place)
        yield _value(desk, era, place, frequency, line.complex_number(), line.place)


def _of_recording(path: Path, desk: Desk) -> Iterator[MeasuredValue]:
    sensors = [*desk.sensors]
    if are_places(sensors):
        sensors = [_sensor(desk, _in_name(path, 0, "sensor"), str(path))]
    names = [name for name, _ in desk.eras]
    if "-" in path.stem:
        names = [_era(desk, _in_name(path, 1, "output"), str(path))]
    for tone in tones_of(path, sensors, names):
        for sensor, ratio in zip(sensors, tone.ratios.tolist(), strict=True):
            if not cmath.isnan(ratio):
                yield _value(desk, tone.era, sensor, tone.frequency, ratio, tone.place)


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
    return _known(f"{place}: sensor", name, {sensor.name: sensor for sensor in desk.sensors})


def _era(desk: Desk, output: str, place: str) -> str:
    numbers = {str(number): name for name, number in desk.eras}
    return _known(f"{place}: output", output, numbers | {name: name for name, _ in desk.eras})


def _known(what: str, given: str, known: Mapping[str, _Known]) -> _Known:
    if given not in known:
        raise InputError(f"{what} must be one of {', '.join(known)}, got {given!r}")
    return known[given]


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
