"""Recordings as WAV, for audio tools: 32-bit float between -1 and 1, a channel per sensor.

Full scale [m/s²], positions and start are in a sidecar `NAME.wav.json`, since audio tools drop
unknown metadata. Samples are exact to 6e-8 of the largest value.
"""

import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, FiniteFloat, ValidationError

from model.errors import InputError, first_problem
from model.files.uff import read_bytes
from sim.sensors.recording import Format, Recording


class _Sidecar(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    format: Literal["era-haptics recording 1"] = "era-haptics recording 1"
    sensors: list[str]
    x_m: list[FiniteFloat]
    y_m: list[FiniteFloat]
    start_s: FiniteFloat
    sample_rate_hz: FiniteFloat
    full_scale_m_s2: FiniteFloat


def sidecar(path: Path) -> Path:
    """The sidecar of a WAV."""
    return path.with_name(path.name + ".json")


def _write(path: Path, recording: Recording) -> None:
    from scipy.io import wavfile

    # A power of two, so that no digits are lost.
    largest = float(max(recording.samples.max(), -recording.samples.min()))
    full_scale = 2.0 ** math.ceil(math.log2(largest)) if largest > 0 else 1.0
    samples = (recording.samples / full_scale).astype(np.float32)
    wavfile.write(path, int(recording.sample_rate), samples)
    x, y = recording.points.T.tolist()
    metadata = _Sidecar(
        sensors=list(recording.names),
        x_m=x,
        y_m=y,
        start_s=recording.start,
        sample_rate_hz=recording.sample_rate,
        full_scale_m_s2=full_scale,
    )
    sidecar(path).write_text(metadata.model_dump_json(indent=1) + "\n", encoding="utf-8")


def _read(path: Path) -> Recording:
    from scipy.io import wavfile

    content = read_bytes(path)
    metadata = _read_sidecar(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # scipy only warns of a truncated file
            rate, samples = wavfile.read(io.BytesIO(content))
    except Exception as error:  # damaged files raise various errors in scipy
        raise InputError(f"{path}: must be a complete WAV file; record it again") from error
    if samples.dtype != np.float32:
        raise InputError(f"{path}: samples must be 32-bit float, got {samples.dtype}")
    samples = samples.reshape(len(samples), -1)
    if rate != metadata.sample_rate_hz or samples.shape[1] != len(metadata.sensors):
        raise InputError(
            f"{path}: {samples.shape[1]} channels at {rate} Hz do not match {sidecar(path).name}, "
            f"{len(metadata.sensors)} at {metadata.sample_rate_hz:g} Hz; copy both files together"
        )
    if len(samples) < 2 or not np.isfinite(samples).all():
        raise InputError(f"{path}: must have at least two samples, all finite")
    return Recording(
        tuple(metadata.sensors),
        np.column_stack([metadata.x_m, metadata.y_m]),
        float(rate),
        metadata.start_s,
        metadata.full_scale_m_s2 * samples.astype(float),
    )


def _read_sidecar(path: Path) -> _Sidecar:
    file = sidecar(path)
    if not file.exists():
        raise InputError(f"{path}: {file.name} is missing beside it; copy both files together")
    try:
        metadata = _Sidecar.model_validate_json(read_bytes(file))
    except ValidationError as error:
        key, problem = first_problem(error)
        raise InputError(f"{file}: {key}: {problem}") from error
    if not len(metadata.sensors) == len(metadata.x_m) == len(metadata.y_m):
        raise InputError(f"{file}: sensors, x_m and y_m must have equal lengths")
    return metadata


def _cannot_hold(names: Sequence[str], sample_rate: float) -> str | None:
    if sample_rate == round(sample_rate):
        return None
    return f"sampling rate must be whole in WAV, got {sample_rate:g} Hz; write .csv or .uff"


WAV = Format(
    _write,
    _read,
    start=b"RIFF",
    max_values=1 << 24,
    cannot_hold=_cannot_hold,
    sidecars=lambda path: (sidecar(path),),
)
