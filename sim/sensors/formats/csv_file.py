"""Recordings as CSV, for spreadsheets.

A line of names (`time_s`, then `P1_m_s2`, ...), the lines `x_m` and `y_m` with the sensors' places,
then a line a sample with every digit.
"""

import csv
import io
import math
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.files.uff import read_bytes
from sim.sensors.formats.format import Format, rounded
from sim.sensors.recording import Recording

_UNIT = "_m_s2"
_PLACES = ("x_m", "y_m")
_EVEN = 1e-3  # of a sampling interval; by how much times may wander
_ROWS = 10_000  # that are made at once


def _write(path: Path, recording: Recording) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["time_s", *(name + _UNIT for name in recording.names)])
        for label, places in zip(_PLACES, recording.points.T.tolist(), strict=True):
            writer.writerow([label, *places])
        times = recording.times
        for first in range(0, len(times), _ROWS):
            part = slice(first, first + _ROWS)
            writer.writerows(np.column_stack([times[part], recording.samples[part]]).tolist())


def _read(path: Path) -> Recording:
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
        places = [_numbers(path, 2 + n, next(rows), header, key) for n, key in enumerate(_PLACES)]
        table = [_numbers(path, rows.line_num, row, header, None) for row in rows if row]
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
        rounded((len(times) - 1) / (times[-1] - times[0]), 9),
        float(times[0]),
        values[:, 1:],
    )


def _numbers(
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


CSV = Format(_write, _read, start=b"time_s", values_max=1 << 24)
