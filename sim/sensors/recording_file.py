"""Recordings as files: CSV for spreadsheets, WAV for audio tools, UFF 58 for modal software.

- CSV: a line of names (`time_s`, then `P1_m_s2`, ...), the lines `x_m` and `y_m` with the sensors'
  places, then a line a sample with every digit.
- WAV: 32-bit float, a channel a sensor, between -1 and 1; the full scale [m/s²] and all that a WAV
  cannot say stand in a file beside it, `NAME.wav.json`. Audio tools drop metadata inside a WAV that
  they do not know; a sidecar survives them. Equal to 6e-8 of the largest value.
- UFF: one record a sensor, 12 digits; start and sampling interval have six.

A file appears when it is whole, or not at all.
"""

import csv
import io
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from model.errors import InputError
from model.replacing import begins_with
from model.uff import (
    ACCELERATION,
    TIME,
    TIME_RESPONSE,
    Function,
    Universal,
    read_bytes,
    read_universal,
    write_universal,
)
from sim.sensors.accelerometer import Recording

_UNIT = "_m_s2"
_UP = 3
_LONGEST_NAME = 10
_EVEN = 1e-3  # of a sampling interval; by how much times may wander
_SIDECAR_KEYS = {"format", "sensors", "x_m", "y_m", "start_s", "sample_rate_hz", "full_scale_m_s2"}
_FORMAT = "era-haptics recording 1"
_ROWS = 10_000  # of a CSV that are made at once


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording in the format that its name ends in: .csv, .wav, .uff or .unv.

    Raises InputError for another ending and what a format cannot hold, OSError.
    """
    if not len(recording.samples) > 1:
        raise InputError(f"{path}: a recording of fewer than two samples cannot be written")
    if not np.isfinite(recording.samples).all():
        raise InputError(f"{path}: the recording has values that are not finite")
    check_recordable(path, recording.names, sample_rate=recording.sample_rate)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        _of_ending(path).write(part, recording)
        if sidecar(part).exists():
            sidecar(part).replace(sidecar(path))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
        sidecar(part).unlink(missing_ok=True)


def check_recordable(path: Path, names: Sequence[str], *, sample_rate: float) -> None:
    """Raise InputError for what a file of this name cannot hold, or where another one stands.

    sample_rate [Hz]; names: of what is recorded.
    """
    form = _of_ending(path)
    if path.is_file() and not begins_with(path, form.start):
        raise InputError(
            f"{path}: a file is there that is no recording; it is left alone. Give another name, "
            "or remove it first"
        )
    if form.start == _WAV and sample_rate != round(sample_rate):
        raise InputError(
            f"{path}: a WAV takes whole sampling rates only, not {sample_rate:g} Hz; "
            "write .csv or .uff"
        )
    long = [name for name in names if len(name) > _LONGEST_NAME]
    if form.start == _UFF and long:
        raise InputError(f"{path}: a UFF keeps {_LONGEST_NAME} characters of a name; {long[0]!r}")


def values_max(path: Path) -> int:
    """How many values a recording of this name may have, so that memory stays bounded."""
    return _of_ending(path).values_max


def read_recording(path: Path) -> Recording:
    """Read what `write_recording` writes; InputError, with file and line, for anything else."""
    return _of_ending(path).read(path)


def sidecar(path: Path) -> Path:
    """The file that stands beside a WAV."""
    return path.with_name(path.name + ".json")


def _write_csv(path: Path, recording: Recording) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["time_s", *(name + _UNIT for name in recording.names)])
        for label, places in zip(_PLACES, recording.points.T.tolist(), strict=True):
            writer.writerow([label, *places])
        times = recording.times
        for first in range(0, len(times), _ROWS):
            part = slice(first, first + _ROWS)
            writer.writerows(np.column_stack([times[part], recording.samples[part]]).tolist())


def _read_csv(path: Path) -> Recording:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text in UTF-8; it is damaged or no CSV") from error
    rows = csv.reader(io.StringIO(text), strict=True)
    try:
        header = next(rows)
        if header[0] != "time_s" or len(header) < 2:
            raise InputError(
                f"{path}:1: the first column must be time_s, the others sensors' readings"
            )
        wrong = [name for name in header[1:] if not name.endswith(_UNIT)]
        if wrong:
            raise InputError(
                f"{path}:1: column {wrong[0][:30]!r} is not in m/s²; convert it and end its name "
                f"in {_UNIT}"
            )
        places = [
            _csv_numbers(path, 2 + n, next(rows), header, key) for n, key in enumerate(_PLACES)
        ]
        table = [_csv_numbers(path, rows.line_num, row, header, None) for row in rows if row]
    except csv.Error as error:
        raise InputError(f"{path}:{rows.line_num}: is no CSV: {error}") from error
    except StopIteration:
        raise InputError(f"{path}:{rows.line_num}: ends before the first sample") from None
    if len(table) < 2:
        raise InputError(f"{path}:{rows.line_num}: holds fewer than two samples")
    values = np.array(table)
    times = values[:, 0]
    step = float(np.median(np.diff(times)))
    uneven = np.flatnonzero(~(np.abs(np.diff(times) - step) <= _EVEN * abs(step)))
    if len(uneven) or not step > 0:
        line = 5 + (int(uneven[0]) if len(uneven) else 0)
        raise InputError(f"{path}:{line}: time_s goes on in unequal steps; samples are missing")
    names = tuple(name.removesuffix(_UNIT) for name in header[1:])
    points = np.array([place[1:] for place in places]).T
    return Recording(
        names,
        points,
        _digits((len(times) - 1) / (times[-1] - times[0]), 9),
        float(times[0]),
        values[:, 1:],
    )


_PLACES = ("x_m", "y_m")


def _csv_numbers(
    path: Path, line: int, row: list[str], header: list[str], label: str | None
) -> list[float]:
    """The numbers of a line; of a labelled one, NaN in place of its label."""
    if len(row) != len(header):
        raise InputError(
            f"{path}:{line}: {len(row)} values stand here, not {len(header)}; the file is damaged"
        )
    if label is not None and row[0] != label:
        raise InputError(f"{path}:{line}: the line {label} with the sensors' places is missing")
    numbers = []
    for name, text in zip(header, row, strict=True):
        try:
            numbers.append(math.nan if text == label else float(text))
        except ValueError:
            numbers.append(math.inf)
        if math.isinf(numbers[-1]) or (math.isnan(numbers[-1]) and text != label):
            raise InputError(f"{path}:{line}: {name} is {text[:30]!r}, not a finite number")
    return numbers


def _write_wav(path: Path, recording: Recording) -> None:
    from scipy.io import wavfile

    # A power of two takes nothing from the digits.
    largest = float(max(recording.samples.max(), -recording.samples.min()))
    full_scale = 2.0 ** math.ceil(math.log2(largest)) if largest > 0 else 1.0
    samples = (recording.samples / full_scale).astype(np.float32)
    wavfile.write(path, int(recording.sample_rate), samples)
    x, y = recording.points.T.tolist()
    told = {
        "format": _FORMAT,
        "sensors": list(recording.names),
        "x_m": x,
        "y_m": y,
        "start_s": recording.start,
        "sample_rate_hz": recording.sample_rate,
        "full_scale_m_s2": full_scale,
    }
    sidecar(path).write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def _read_wav(path: Path) -> Recording:
    from scipy.io import wavfile

    content = read_bytes(path)
    told = _read_sidecar(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # scipy only warns of a file that was cut off
            rate, samples = wavfile.read(io.BytesIO(content))
    except Exception as error:  # whatever a damaged file leads scipy into
        raise InputError(f"{path}: is no WAV, or damaged: {error}") from error
    if samples.dtype != np.float32:
        raise InputError(
            f"{path}: holds {samples.dtype} samples, a recording has 32-bit float; export it so"
        )
    samples = samples.reshape(len(samples), -1)
    if rate != told["sample_rate_hz"] or samples.shape[1] != len(told["sensors"]):
        raise InputError(
            f"{path}: {samples.shape[1]} channels at {rate} Hz, {sidecar(path).name} tells of "
            f"{len(told['sensors'])} at {told['sample_rate_hz']:g} Hz; they do not belong together"
        )
    if len(samples) < 2 or not np.isfinite(samples).all():
        raise InputError(f"{path}: holds fewer than two samples, or some that are not finite")
    return Recording(
        tuple(told["sensors"]),
        np.column_stack([told["x_m"], told["y_m"]]),
        float(rate),
        told["start_s"],
        told["full_scale_m_s2"] * samples.astype(float),
    )


def _read_sidecar(path: Path) -> dict[str, Any]:
    beside = sidecar(path)
    if not beside.exists():
        raise InputError(
            f"{path}: {beside.name} does not stand beside it, without which its scale and sensors "
            "are unknown; copy both"
        )
    try:
        told = json.loads(read_bytes(beside).decode("utf-8"))
    except json.JSONDecodeError as error:
        raise InputError(f"{beside}:{error.lineno}: is no JSON: {error.msg}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{beside}: is no text in UTF-8") from error
    if not isinstance(told, dict) or set(told) != _SIDECAR_KEYS or told["format"] != _FORMAT:
        raise InputError(f"{beside}: does not tell of a recording; was it written by another tool?")
    numbers = ("start_s", "sample_rate_hz", "full_scale_m_s2")
    lists = [told[key] for key in ("sensors", "x_m", "y_m")]
    if (
        not all(isinstance(each, list) and len(each) == len(lists[0]) for each in lists)
        or not all(isinstance(name, str) for name in told["sensors"])
        or not all(_is_number(told[key]) for key in numbers)
        or not all(_is_number(place) for place in [*told["x_m"], *told["y_m"]])
    ):
        raise InputError(f"{beside}: sensors, places or numbers in it are not what they should be")
    return told


def _write_uff(path: Path, recording: Recording) -> None:
    nodes = {n: (x, y, 0.0) for n, (x, y) in enumerate(recording.points.tolist(), start=1)}
    functions = [
        Function(
            str(path),
            TIME_RESPONSE,
            number,
            0,
            (name, ""),
            (_UP, 0),
            recording.times,
            recording.samples[:, number - 1],
            (TIME, ACCELERATION, 0),
            ("m/s^2", ""),
        )
        for number, name in enumerate(recording.names, start=1)
    ]
    write_universal(path, Universal(nodes, functions))


def _read_uff(path: Path) -> Recording:
    content = read_universal(path)
    records = [f for f in content.functions if f.function_type == TIME_RESPONSE]
    if not records:
        raise InputError(f"{path}: holds no signals (dataset 58, function type 1)")
    first = records[0]
    for record in records:
        if record.kinds[0] != TIME or record.kinds[1] != ACCELERATION:
            raise InputError(f"{record.place}: the record is no acceleration over time")
        if record.units[0].replace(" ", "") not in ("m/s^2", "m/s2", "m/s²"):
            raise InputError(
                f"{record.place}: the record is in {record.units[0] or 'no unit'!r}, not in m/s²"
            )
        if len(record.x) < 2 or not np.array_equal(record.x, first.x):
            raise InputError(
                f"{record.place}: the record's times are not those of the first; only sensors that "
                "were recorded together can be read"
            )
        if record.response not in content.nodes:
            raise InputError(f"{record.place}: node {record.response} has no place (dataset 2411)")
    rate = (len(first.x) - 1) / (first.x[-1] - first.x[0])
    return Recording(
        tuple(record.names[0] or f"node {record.response}" for record in records),
        np.array([content.nodes[record.response][:2] for record in records]),
        _digits(float(rate), 6),
        float(first.x[0]),
        np.column_stack([record.data for record in records]),
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _digits(value: float, count: int) -> float:
    return float(f"{value:.{count}g}")


@dataclass(frozen=True)
class _Format:
    """How a kind of file is written and read, what it begins with, and how many values it takes."""

    write: Callable[[Path, Recording], None]
    read: Callable[[Path], Recording]
    start: bytes
    values_max: int


_CSV, _WAV, _UFF = b"time_s", b"RIFF", b"    -1"
_UNIVERSAL = _Format(_write_uff, _read_uff, _UFF, 1 << 22)  # as text in memory, 20 bytes a value
_FORMATS = {
    ".csv": _Format(_write_csv, _read_csv, _CSV, 1 << 24),
    ".wav": _Format(_write_wav, _read_wav, _WAV, 1 << 24),
    ".uff": _UNIVERSAL,
    ".unv": _UNIVERSAL,
}


def _of_ending(path: Path) -> _Format:
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: a recording ends in {', '.join(_FORMATS)}")
    return _FORMATS[path.suffix.lower()]
