"""Recordings as WAV, for audio tools: 32-bit float between -1 and 1, a channel a sensor.

The full scale [m/s²] and all that a WAV cannot say stand in a file beside it, `NAME.wav.json`.
Audio tools drop metadata inside a WAV that they do not know; a sidecar survives them. Equal to 6e-8
of the largest value.
"""

import io
import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model.errors import InputError
from model.files.uff import read_bytes
from sim.sensors.formats.format import Format
from sim.sensors.recording import Recording

_SIDECAR_KEYS = {"format", "sensors", "x_m", "y_m", "start_s", "sample_rate_hz", "full_scale_m_s2"}
_FORMAT = "era-haptics recording 1"


def sidecar(path: Path) -> Path:
    """The file that stands beside a WAV."""
    return path.with_name(path.name + ".json")


def _write(path: Path, recording: Recording) -> None:
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


def _read(path: Path) -> Recording:
    from scipy.io import wavfile

    content = read_bytes(path)
    told = _read_sidecar(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # scipy only warns of a file that was cut off
            rate, samples = wavfile.read(io.BytesIO(content))
    except Exception as error:  # whatever a damaged file leads scipy into
        raise InputError(
            f"{path}: is no WAV, or damaged or cut off; make the recording again"
        ) from error
    if samples.dtype != np.float32:
        raise InputError(
            f"{path}: holds {samples.dtype} samples, a recording has 32-bit float; export it so"
        )
    samples = samples.reshape(len(samples), -1)
    if rate != told["sample_rate_hz"] or samples.shape[1] != len(told["sensors"]):
        raise InputError(
            f"{path}: channels: {samples.shape[1]} at {rate} Hz, {sidecar(path).name} tells of "
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


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _cannot_hold(names: Sequence[str], sample_rate: float) -> str | None:
    if sample_rate == round(sample_rate):
        return None
    return f"a WAV takes whole sampling rates only, not {sample_rate:g} Hz; write .csv or .uff"


WAV = Format(
    _write,
    _read,
    start=b"RIFF",
    values_max=1 << 24,
    cannot_hold=_cannot_hold,
    beside=lambda path: (sidecar(path),),
)
