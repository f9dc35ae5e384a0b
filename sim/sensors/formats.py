"""File formats of recordings: CSV, WAV for audio tools, universal files for modal software."""

import csv
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.files.regular_file import regular_file
from model.files.uff import (
    ACCELERATION,
    TIME,
    TIME_RESPONSE,
    Function,
    Universal,
    write_universal,
)
from sim.sensors.recording import Recording

_CHUNK = 10_000  # samples; written at once
_UP = 3
_MAX_NAME = 10


@dataclass(frozen=True)
class Format:
    """A file format.

    start: the first bytes of a file; max_values: limit that bounds memory; cannot_hold: why
    recordings of these names at this sampling rate [Hz] do not fit, None where they do; sidecars:
    the files beside one.
    """

    write: Callable[[Path, Recording], None]
    start: bytes
    max_values: int
    cannot_hold: Callable[[Sequence[str], float], str | None] = lambda names, sample_rate: None
    sidecars: Callable[[Path], tuple[Path, ...]] = lambda path: ()


def _write_csv(path: Path, recording: Recording) -> None:
    """Header `time_s`, `P1_m_s2`, ..., positions `x_m` and `y_m`, then samples."""
    with open(path, "w", newline="", encoding="utf-8", opener=regular_file) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["time_s", *(f"{name}_m_s2" for name in recording.names)])
        for label, positions in zip(("x_m", "y_m"), recording.points.T.tolist(), strict=True):
            writer.writerow([label, *positions])
        times = recording.times
        for first in range(0, len(times), _CHUNK):
            part = slice(first, first + _CHUNK)
            writer.writerows(np.column_stack([times[part], recording.samples[part]]).tolist())


def sidecar(path: Path) -> Path:
    """The sidecar of a WAV."""
    return path.with_name(path.name + ".json")


def _write_wav(path: Path, recording: Recording) -> None:
    """A channel per sensor, 32-bit float between -1 and 1: exact to 6e-8 of the largest value.

    Full scale [m/s²], positions and start are in a sidecar `NAME.wav.json`, since audio tools drop
    unknown metadata.
    """
    from scipy.io import wavfile

    # A power of two, so that no digits are lost.
    largest = float(max(recording.samples.max(), -recording.samples.min()))
    full_scale = 2.0 ** math.ceil(math.log2(largest)) if largest > 0 else 1.0
    samples = (recording.samples / full_scale).astype(np.float32)
    wavfile.write(path, int(recording.sample_rate), samples)
    x, y = recording.points.T.tolist()
    metadata = {
        "format": "era-haptics recording 1",
        "sensors": recording.names,
        "x_m": x,
        "y_m": y,
        "start_s": recording.start,
        "sample_rate_hz": recording.sample_rate,
        "full_scale_m_s2": full_scale,
    }
    sidecar(path).write_text(json.dumps(metadata, indent=1) + "\n", encoding="utf-8")


def _whole_rate(names: Sequence[str], sample_rate: float) -> str | None:
    if sample_rate == round(sample_rate):
        return None
    return f"sampling rate must be whole in WAV, got {sample_rate:g} Hz; write .csv or .uff"


def _write_uff(path: Path, recording: Recording) -> None:
    """A dataset 58 per sensor with 12 digits; start and sampling interval have six."""
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


def _short_names(names: Sequence[str], sample_rate: float) -> str | None:
    long = [name for name in names if len(name) > _MAX_NAME]
    return f"names must have at most {_MAX_NAME} characters, got {long[0]!r}" if long else None


_UFF = Format(_write_uff, b"    -1", 1 << 22, _short_names)  # as text in memory, 20 bytes a value

FORMATS = {
    ".csv": Format(_write_csv, b"time_s", 1 << 24),
    ".wav": Format(_write_wav, b"RIFF", 1 << 24, _whole_rate, lambda path: (sidecar(path),)),
    ".uff": _UFF,
    ".unv": _UFF,
}
"""By suffix."""
