"""Recordings written to files and read again; the ending of its name says what kind a file is.

A file appears when it is whole, or not at all. A new kind is a file in `sim.sensors.formats` and a
line in `_FORMATS`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.files.replacing import begins_with
from sim.sensors.formats.csv_file import CSV
from sim.sensors.formats.format import Format
from sim.sensors.formats.uff_file import UFF
from sim.sensors.formats.wav_file import WAV
from sim.sensors.recording import Recording

_FORMATS = {".csv": CSV, ".wav": WAV, ".uff": UFF, ".unv": UFF}


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording in the format that its name ends in: .csv, .wav, .uff or .unv.

    Raises InputError for another ending and what a format cannot hold, OSError with the name.
    """
    if not len(recording.samples) > 1:
        raise InputError(f"{path}: a recording of fewer than two samples cannot be written")
    if not np.isfinite(recording.samples).all():
        raise InputError(f"{path}: the recording has values that are not finite")
    check_recordable(path, recording.names, sample_rate=recording.sample_rate)
    form = _of_ending(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    # The file itself comes last: where it is, what stands beside it is there.
    parts = dict(zip((*form.beside(part), part), (*form.beside(path), path), strict=True))
    try:
        form.write(part, recording)
        for made, wanted in parts.items():
            made.replace(wanted)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        for made in parts:
            made.unlink(missing_ok=True)


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
    why_not = form.cannot_hold(names, sample_rate)
    if why_not is not None:
        raise InputError(f"{path}: {why_not}")


def values_max(path: Path) -> int:
    """How many values a recording of this name may have, so that memory stays bounded."""
    return _of_ending(path).values_max


def read_recording(path: Path) -> Recording:
    """Read what `write_recording` writes; InputError, with file and line, for anything else."""
    return _of_ending(path).read(path)


def _of_ending(path: Path) -> Format:
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: a recording ends in {', '.join(_FORMATS)}")
    return _FORMATS[path.suffix.lower()]
