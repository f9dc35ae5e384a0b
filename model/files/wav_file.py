"""WAV files of PCM or float."""

import io
import warnings
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError


def samples_of(content: bytes) -> tuple[int, FloatArray]:
    """The rate [Hz] of a file, and samples (n, channels) of which 1 is full scale.

    Raises InputError, which does not name the file.
    """
    from scipy.io import wavfile  # slow to import

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", r"Chunk \(non-data\)", wavfile.WavFileWarning)
        try:
            rate, given = wavfile.read(io.BytesIO(content))
        except Exception as error:  # of a damaged file anything
            raise InputError(f"is no WAV file of PCM or float: {error}; save it as one") from error
    if not given.size:
        raise InputError("has no samples")
    return rate, _scaled(given).reshape(len(given), -1)


def _scaled(given: Any) -> FloatArray:
    if given.dtype == np.uint8:
        return np.asarray((given.astype(np.float32) - 128) / 128)
    full = 1.0 if given.dtype.kind == "f" else -float(np.iinfo(given.dtype).min)
    with np.errstate(all="ignore"):  # of float what is too large or no number is refused later
        return np.asarray(given.astype(np.float32) / full)
