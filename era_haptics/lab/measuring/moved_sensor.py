"""Measure with a single sensor, which a person at a terminal moves from position to position.

Every position is a separate measurement. Phases are relative to the loop-back, so that positions
measured minutes apart agree. The file is written after each position, so that the measurement can
be resumed.
"""

import math
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import LinkError
from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.measure import MeasuredResponses, measure
from era_haptics.lab.measuring.multisine import Multisine
from era_haptics.lab.measuring.sensor_file import WiredSensor
from era_haptics.lab.measuring.sound_card import DeviceLost, SoundCard
from model.arrays import ComplexArray, FloatArray
from model.commands.options import Stopwatch
from model.errors import InputError
from model.estimate.measurement import Measurement
from model.response_files import measurement_of, read_measured, write_responses

_MIN_CHANGE = 0.02  # of the response, after a move; or so many times its noise:
_NOISE_FACTOR = 3.0
_MIN_DISTANCE = 5e-3  # m; nearer positions may sound alike
_POSITION_TOLERANCE = 5e-4  # m, between positions in a file and the sensors' positions
_NOISY = 0.03  # of the response


@dataclass(eq=False)
class PositionsFile:
    """Responses measured at the positions of a desk with one multisine, and their file.

    values (f, eras) [1/s²] by position name.
    """

    path: Path
    desk: Desk
    multisine: Multisine
    values: dict[str, ComplexArray] = field(default_factory=dict)

    @property
    def setting(self) -> str:
        """Settings that must be the same at all positions, as text for the file."""
        grams = 1e3 * self.desk.sensors[0].mass
        rig = self.desk.rig.fingerprint[:8]
        return f"level {self.multisine.level:g}, sensor {grams:.6g} g, rig {rig}"

    @property
    def missing(self) -> list[WiredSensor]:
        """Places that are not measured, in the order of their file."""
        return [place for place in self.desk.sensors if place.name not in self.values]

    def read(self) -> None:
        """Resume from the file; raises InputError if it belongs to another measurement."""
        rows = read_measured(self.path)
        other_settings = {row.setting for row in rows} - {self.setting}
        if other_settings:
            raise self._other("setting", self.setting, " and ".join(other_settings) or "none")
        measurement = measurement_of(rows, self.desk.rig)
        frequencies, played = measurement.frequencies, self.multisine.frequencies
        if measurement.skipped or not np.array_equal(frequencies.round(6), played.round(6)):
            raise self._other("frequencies", _span(played), _span(frequencies))
        values_by_place = measurement.values.swapaxes(0, 1)
        for point, values in zip(measurement.points.tolist(), values_by_place, strict=True):
            self.values[self._place_at(point).name] = values

    def keep(self, place: WiredSensor, measured: MeasuredResponses) -> None:
        """Write the file with another place; raises OSError."""
        values_by_name = self.values | {place.name: measured.responses.values[:, 0]}
        places = [sensor for sensor in self.desk.sensors if sensor.name in values_by_name]
        values = np.stack([values_by_name[sensor.name] for sensor in places], axis=1)
        measurement = Measurement(
            tuple(sensor.place for sensor in places), self.multisine.frequencies, values
        )
        write_responses(self.path, measurement, self.desk.rig, setting=self.setting)
        self.values = values_by_name

    def _place_at(self, point: Sequence[float]) -> WiredSensor:
        for place in self.desk.sensors:
            if math.dist((place.x, place.y), point) <= _POSITION_TOLERANCE:
                return place
        position = f"({point[0]:g}, {point[1]:g}) m"
        raise self._other("places", "one at each line of --sensors", position)

    def __str__(self) -> str:
        """Return the progress as a line of text."""
        count, total = len(self.values), len(self.desk.sensors)
        text = f"{count} of {total} places are measured"
        if count:
            text += f", in {self.path}"
        return f"{text}; go on with --resume" if 0 < count < total else text

    def _other(self, what: str, expected: str, got: str) -> InputError:
        return InputError(
            f"--resume {self.path}: {what} must be {expected}, got {got} in the file; measure as "
            "it was begun, or leave out --resume and write another file"
        )


def measure_by_moving(
    desk: Desk,
    opened: AbstractContextManager[tuple[SoundCard, Multisine]],
    output: Path,
    *,
    periods: int,
    is_resumed: bool,
) -> tuple[list[str], dict[str, Any], bool]:
    """Guide a person at a terminal through the positions of a desk.

    Return the lines to print, the report, and whether all positions are measured. Raises
    InputError and LinkError, and KeyboardInterrupt after printing the progress.
    """
    _check_output(output, is_resumed=is_resumed)
    with Stopwatch() as stopwatch, opened as (card, multisine):
        file = PositionsFile(output, desk, multisine)
        if is_resumed:
            file.read()
            _tell(str(file))
        try:
            measured = measure_positions(file, card, periods=periods)
        except KeyboardInterrupt:
            card.close()  # silence the outputs before printing
            _tell(f"\nstopped; {file}")
            raise
        except DeviceLost as problem:
            raise LinkError(f"{problem}; check its cable; {file}") from problem
        except OSError as problem:
            raise InputError(
                f"{output}: cannot be written: {problem.strerror}; {file}"
            ) from problem
    missing = [place.name for place in file.missing]
    report = {
        "frequencies_hz": multisine.frequencies.tolist(),
        "places": {"measured": list(measured), "missing": missing},
        "sensors": {name: responses.quality(0) for name, responses in measured.items()},
        "measure_time_s": stopwatch.elapsed,
        "files": [str(output)] if file.values else [],
    }
    return [str(file)], report, not missing


def _check_output(output: Path, *, is_resumed: bool) -> None:
    """Raise InputError unless the file exists if, and only if, it is resumed."""
    if is_resumed and not output.exists():
        raise InputError(
            f"{output}: a file must be there to go on from with --resume, got none; leave it out"
        )
    if output.exists() and not is_resumed:
        raise InputError(f"{output}: exists; go on with --resume, or choose another name")


def _prompt(text: str) -> str:
    sys.stderr.write(text)
    sys.stderr.flush()
    return sys.stdin.readline() or "q"


def _tell(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def measure_positions(
    file: PositionsFile, card: SoundCard, *, periods: int
) -> dict[str, MeasuredResponses]:
    """Guide a person through the missing positions; returns the new measurements by position.

    A position that fails a check is reported with its remedy, and repeated. Raises DeviceLost,
    OSError; earlier measurements are then in the file.
    """
    measured: dict[str, MeasuredResponses] = {}
    pending = file.missing
    last: WiredSensor | None = None
    _tell(
        "Enter: measure this position; r: repeat the previous one; s: skip; q: stop. Measured "
        "positions are saved"
    )
    while pending:
        place = pending[0]
        reply = _prompt(_instruction(file, place)).strip()
        match reply.lower():
            case "q":
                break
            case "s":
                pending.pop(0)
            case "r" if last is not None:
                pending.insert(0, last)
                last = None
            case "":
                responses = _measure_position(file, card, place, periods=periods)
                if responses is not None:
                    measured[place.name] = responses
                    last = pending.pop(0)
            case _:
                _tell(f"a reply must be Enter, s, q, or r once, got {reply[:20]!r}")
    return measured


def _instruction(file: PositionsFile, place: WiredSensor) -> str:
    places = file.desk.sensors
    return (
        f"Put the sensor at {place.name}, x {1e3 * place.x:g} mm, y {1e3 * place.y:g} mm "
        f"(place {places.index(place) + 1} of {len(places)}), then Enter: "
    )


def _measure_position(
    file: PositionsFile, card: SoundCard, place: WiredSensor, *, periods: int
) -> MeasuredResponses | None:
    """Measure a position and write it to the file; return None if it fails a check."""
    desk = replace(file.desk, sensors=(place,))
    is_heard = bool(file.values)
    try:
        measured = measure(desk, card, file.multisine, periods=periods, is_heard=is_heard)
        _check_changed(file, place, measured)
    except DeviceLost:
        raise
    except (InputError, LinkError) as problem:
        _tell(f"{place.name} is not kept: {problem}")
        return None
    file.keep(place, measured)
    _tell(_line(place, measured))
    return measured


def _check_changed(file: PositionsFile, place: WiredSensor, measured: MeasuredResponses) -> None:
    """Raise InputError for a response that matches another position."""
    response = measured.responses.values[:, 0]
    limit = max(_MIN_CHANGE, _NOISE_FACTOR * float(np.median(measured.std)))
    for other in file.desk.sensors:
        is_near = math.dist((place.x, place.y), (other.x, other.y)) < _MIN_DISTANCE
        other_response = file.values.get(other.name)
        if other_response is None or is_near or other.name == place.name:
            continue
        change = np.linalg.norm(response - other_response) / np.linalg.norm(other_response)
        if change < limit:
            raise InputError(
                f"response must differ from that at {other.name} by more than {100 * limit:.1f} %, "
                f"got {100 * change:.1f} %: the sensor is still there; move it to {place.name}"
            )


def _line(place: WiredSensor, measured: MeasuredResponses) -> str:
    noise = float(np.median(measured.std))
    text = (
        f"{place.name}: coherence {np.median(measured.coherence):.4f}, noise {100 * noise:.2f} % "
        "of the response; kept"
    )
    if noise > _NOISY:
        text += "; it is noisy: raise --periods in another measurement"
    return text


def _span(frequencies: FloatArray) -> str:
    return f"{len(frequencies)} from {frequencies[0]:g} to {frequencies[-1]:g} Hz"
