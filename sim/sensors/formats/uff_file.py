"""Recordings as universal files (UFF 58), for modal software.

One record per sensor with 12 digits; start and sampling interval have six.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.files.uff import (
    ACCELERATION,
    TIME,
    TIME_RESPONSE,
    Function,
    Universal,
    read_universal,
    write_universal,
)
from sim.sensors.recording import Format, Recording, rounded

_UP = 3
_MAX_NAME = 10


def _write(path: Path, recording: Recording) -> None:
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


def _read(path: Path) -> Recording:
    content = read_universal(path)
    records = [f for f in content.functions if f.function_type == TIME_RESPONSE]
    if not records:
        raise InputError(f"{path}: no signals (dataset 58, function type 1)")
    first = records[0]
    for record in records:
        if record.data_types[0] != TIME or record.data_types[1] != ACCELERATION:
            raise InputError(f"{record.place}: must be acceleration over time")
        if record.units[0].replace(" ", "") not in ("m/s^2", "m/s2", "m/s²"):
            raise InputError(f"{record.place}: unit must be m/s^2, got {record.units[0]!r}")
        if len(record.x) < 2 or not np.array_equal(record.x, first.x):
            raise InputError(f"{record.place}: times must equal those of the first record")
        if record.response not in content.nodes:
            raise InputError(
                f"{record.place}: node {record.response} has no position (dataset 2411)"
            )
    rate = (len(first.x) - 1) / (first.x[-1] - first.x[0])
    return Recording(
        tuple(record.names[0] or f"node {record.response}" for record in records),
        np.array([content.nodes[record.response][:2] for record in records]),
        rounded(float(rate), 6),
        float(first.x[0]),
        np.column_stack([record.data for record in records]),
    )


def _cannot_hold(names: Sequence[str], sample_rate: float) -> str | None:
    long = [name for name in names if len(name) > _MAX_NAME]
    return f"names must have at most {_MAX_NAME} characters, got {long[0]!r}" if long else None


UFF = Format(
    _write,
    _read,
    start=b"    -1",
    max_values=1 << 22,  # as text in memory, 20 bytes a value
    cannot_hold=_cannot_hold,
)
