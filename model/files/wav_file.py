"""WAV files of PCM or float.

A program that writes to a pipe, or a recorder that lost power, leaves sizes of 0 or of about 2^31
or 2^32. Such samples extend to the end of the file.
"""

import struct
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE  # formats; the last has another one in an extension
_EXTENDED = 24  # position of the format in an extended header
_LONG = b"ds64"  # a chunk of RF64 with sizes of 64 bits
_UNKNOWN_SIZE = 0x7FFF0000  # or larger: written before the size is known
_MAX_SAMPLE = 1e3  # times full scale
_KINDS = {
    (_PCM, 1): "u1",
    (_PCM, 2): "i2",
    (_PCM, 3): "i4",
    (_PCM, 4): "i4",
    (_PCM, 8): "i8",
    (_FLOAT, 4): "f4",
    (_FLOAT, 8): "f8",
}
"""Sample types by format and size [bytes]; the array type is the next larger one."""


def samples_of(content: bytes) -> tuple[int, FloatArray]:
    """Return the sample rate [Hz] of a file, and samples (n, channels) relative to full scale.

    Raises InputError, which does not name the file.
    """
    order = ">" if content.startswith(b"RIFX") else "<"
    form, data = _chunks(content, order)
    code, channels, rate, _, frame, bits = struct.unpack_from(f"{order}HHIIHH", form)
    if code == _EXTENSIBLE and len(form) >= _EXTENDED + 2:
        (code,) = struct.unpack_from(f"{order}H", form, _EXTENDED)
    size = frame // max(channels, 1)
    kind = _KINDS.get((code, size))
    if kind is None or frame != channels * size or not rate:
        raise _refused(f"got format {code}, {channels} channels of {bits} bits, {rate} Hz")
    raw = np.frombuffer(data[: len(data) // frame * frame], np.uint8).reshape(-1, size)
    if missing := np.dtype(kind).itemsize - size:
        raw = np.pad(raw, ((0, 0), (0, missing) if order == ">" else (missing, 0)))
    if not raw.size:
        raise InputError("has no samples")
    samples = _scaled(raw.ravel().view(f"{order}{kind}")).reshape(-1, channels)
    is_sample = np.abs(samples).max(axis=1) <= _MAX_SAMPLE  # False for NaN
    if not is_sample.all():
        raise InputError(f"sample {int(is_sample.argmin())} must be -1 to 1, or not far beyond")
    return rate, samples


def _chunks(content: bytes, order: str) -> tuple[bytes, memoryview]:
    """Return the format of a file, 16 bytes or more, and its samples; raises InputError."""
    if content[:4] not in (b"RIFF", b"RIFX", b"RF64") or content[8:12] != b"WAVE":
        raise _refused("it must begin with RIFF and WAVE")
    (stated,) = struct.unpack_from(f"{order}I", content, 4)
    at, chunks = 12, dict[bytes, bytes]()
    while at + 8 <= len(content):
        name, size = struct.unpack_from(f"{order}4sI", content, at)
        at += 8
        if name == b"data" and len(chunks.get(b"fmt ", b"")) >= 16:
            available = len(content) - at
            if len(chunks.get(_LONG, b"")) >= 16:
                size = struct.unpack_from("<Q", chunks[_LONG], 8)[0] or size
            if size >= _UNKNOWN_SIZE or (size == 0 and stated + 8 < len(content)):
                size = available
            if size > available:
                raise _refused(
                    f"it must have {size} bytes of samples, got {available}: it was cut off"
                )
            return chunks[b"fmt "], memoryview(content)[at : at + size]
        chunks[name] = content[at : at + size]
        at += size + size % 2
    raise _refused("it has no format, or no samples behind it")


def _refused(why: str) -> InputError:
    return InputError(f"is no WAV file of PCM or float: {why}; save it as PCM of 16 bits")


def _scaled(raw: Any) -> FloatArray:
    with np.errstate(all="ignore"):  # floats that are too large or not numbers are rejected below
        plain = raw.astype(np.float32)
    if raw.dtype == np.uint8:
        return np.asarray((plain - 128) / 128)
    full = 1.0 if raw.dtype.kind == "f" else -float(np.iinfo(raw.dtype).min)
    return np.asarray(plain / full)
