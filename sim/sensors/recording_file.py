"""Write recordings; the suffix selects the format. Files are replaced atomically."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.files.replacing import begins_with
from sim.sensors.formats import FORMATS, Format
from sim.sensors.recording import Recording


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording in the format of the suffix: .csv, .wav, .uff or .unv.

    Raises InputError for another suffix or what the format cannot hold, OSError.
    """
    if not len(recording.samples) > 1:
        raise InputError(f"{path}: a recording must have at least two samples")
    if not np.isfinite(recording.samples).all():
        raise InputError(f"{path}: samples must be finite")
    check_recordable(path, recording.names, sample_rate=recording.sample_rate)
    kind = _format_of(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    # The main file last: where it exists, its sidecar does.
    parts = dict(zip((*kind.sidecars(part), part), (*kind.sidecars(path), path), strict=True))
    try:
        kind.write(part, recording)
        for made, wanted in parts.items():
            made.replace(wanted)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        for made in parts:
            made.unlink(missing_ok=True)


def check_recordable(path: Path, names: Sequence[str], *, sample_rate: float) -> None:
    """Raise InputError for a recording that the format cannot hold, or an unrelated file there."""
    kind = _format_of(path)
    if path.is_file() and not begins_with(path, kind.start):
        raise InputError(
            f"{path}: exists and is not a recording; give another name, or remove it first"
        )
    why_not = kind.cannot_hold(names, sample_rate)
    if why_not is not None:
        raise InputError(f"{path}: {why_not}")


def max_values(path: Path) -> int:
    """Maximum number of values of a recording in this file."""
    return _format_of(path).max_values


def _format_of(path: Path) -> Format:
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: suffix must be one of {', '.join(FORMATS)}")
    return FORMATS[path.suffix.lower()]
