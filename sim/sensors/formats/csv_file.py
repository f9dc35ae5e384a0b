"""Recordings as CSV: header `time_s`, `P1_m_s2`, ..., positions `x_m` and `y_m`, then samples."""

import csv
import io
import math
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.files.regular_file import regular_file
from model.files.uff import read_bytes
from sim.sensors.recording import Format, Recording, rounded

_UNIT = "_m_s2"
_POSITIONS = ("x_m", "y_m")
_TIME_TOLERANCE = 1e-3  # of a sampling interval; tolerance of times
_CHUNK = 10_000  # written at once


def _write(path: Path, recording: Recording) -> None:
    with open(path, "w", newline="", encoding="utf-8", opener=regular_file) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["time_s", *(name + _UNIT for name in recording.names)])
        for label, positions in zip(_POSITIONS, recording.points.T.tolist(), strict=True):
            writer.writerow([label, *positions])
        times = recording.times
        for first in range(0, len(times), _CHUNK):
            part = slice(first, first + _CHUNK)
            writer.writerows(np.column_stack([times[part], recording.samples[part]]).tolist())


def _read(path: Path) -> Recording:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be UTF-8 text") from error
    rows = csv.reader(io.StringIO(text), strict=True)
    try:
        header = next(rows)
        if header[0] != "time_s" or len(header) < 2:
            raise InputError(f"{path}:1: first column must be time_s, followed by sensors")
        wrong = [name for name in header[1:] if not name.endswith(_UNIT)]
        if wrong:
            raise InputError(
                f"{path}:1: names of sensors must end in {_UNIT}, got {wrong[0][:30]!r}"
            )
        positions = [
            _numbers(path, 2 + n, next(rows), header, key) for n, key in enumerate(_POSITIONS)
        ]
        table = [_numbers(path, rows.line_num, row, header, None) for row in rows if row]
    except csv.Error as error:
        raise InputError(f"{path}:{rows.line_num}: invalid CSV: {error}") from error
    except StopIteration:
        raise InputError(f"{path}:{rows.line_num}: no samples") from None
    if len(table) < 2:
        raise InputError(f"{path}:{rows.line_num}: must have at least two samples")
    values = np.array(table)
    times = values[:, 0]
    step = float(np.median(np.diff(times)))
    uneven = np.flatnonzero(~(np.abs(np.diff(times) - step) <= _TIME_TOLERANCE * abs(step)))
    if len(uneven) or not step > 0:
        line = 5 + (int(uneven[0]) if len(uneven) else 0)
        raise InputError(f"{path}:{line}: time_s must increase in equal steps")
    names = tuple(name.removesuffix(_UNIT) for name in header[1:])
    points = np.array([place[1:] for place in positions]).T
    return Recording(
        names,
        points,
        rounded((len(times) - 1) / (times[-1] - times[0]), 9),
        float(times[0]),
        values[:, 1:],
    )


def _numbers(
    path: Path, line: int, row: list[str], header: list[str], label: str | None
) -> list[float]:
    """The numbers of a line; NaN in place of a label."""
    if len(row) != len(header):
        raise InputError(f"{path}:{line}: must have {len(header)} values, got {len(row)}")
    if label is not None and row[0] != label:
        raise InputError(f"{path}:{line}: must hold the positions {label}, got {row[0][:30]!r}")
    numbers = []
    for name, text in zip(header, row, strict=True):
        try:
            numbers.append(math.nan if text == label else float(text))
        except ValueError:
            numbers.append(math.inf)
        if math.isinf(numbers[-1]) or (math.isnan(numbers[-1]) and text != label):
            raise InputError(f"{path}:{line}: {name} must be a finite number, got {text[:30]!r}")
    return numbers


CSV = Format(_write, _read, start=b"time_s", max_values=1 << 24)
