"""Files written whole or not at all: arrays in an uncompressed .npz, and checks of output paths.

Arrays are checked before they are read: names, types and sizes must be those expected; nothing may
be compressed or pickled, and no array may declare more than the file holds. Output paths are
checked for their ending, their folder, and the kind of file that they would replace.
"""

import glob
import hashlib
import math
import os
import tokenize
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.errors import shown
from registry.files import open_regular

Arrays: TypeAlias = Mapping[str, NDArray[Any]]

UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    RecursionError,
    zipfile.BadZipFile,
    NotImplementedError,
)
"""Errors of `read_arrays` for a file that is missing, damaged or unexpected."""

_RANDOM = 12  # letters of a temporary name
_ENCRYPTED = 0x1  # a flag of a zip member

# numpy parses a header as Python text and does not turn all errors of that into ValueError.
_NO_HEADER = (SyntaxError, tokenize.TokenError, TypeError, RecursionError, MemoryError)


@contextmanager
def whole_or_nothing(path: Path) -> Iterator[IO[bytes]]:
    """Yield a stream that replaces the file when the block succeeds and is removed when it fails.

    Raises OSError with the file's name, unless the block raised one with the name of another file.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:_RANDOM]}")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary), temporary):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def remove_partial(path: Path) -> None:
    """Remove temporary files of killed writers; the file must not be written meanwhile."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.{'[0-9a-f]' * _RANDOM}"):
        with suppress(OSError):
            left.unlink()


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays by name, atomically."""
    with whole_or_nothing(path) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_arrays(path: Path, types: Mapping[str, str], *, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Read arrays of exactly these names and types (`dtype.str`); raises one of UNREADABLE."""
    with open_regular(path, max_bytes) as file, zipfile.ZipFile(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        if sorted(members) != sorted(types) or len(archive.infolist()) != len(types):
            given = shown(", ".join(sorted(members)))
            raise ValueError(f"members must be {', '.join(sorted(types))}, got {given}")
        if any(info.compress_type != zipfile.ZIP_STORED for info in members.values()):
            raise ValueError("members must not be compressed")
        if any(info.flag_bits & _ENCRYPTED for info in members.values()):
            raise ValueError("members must not be encrypted")
        declared = sum(info.file_size for info in members.values())
        if declared > os.fstat(file.fileno()).st_size:
            raise ValueError(f"size must be that of the file, got {declared} bytes")
        arrays = {}
        for name, info in members.items():
            with archive.open(info) as stream:
                _check_npy_header(stream, name, types[name], member_bytes=info.file_size)
            with archive.open(info) as stream:
                arrays[name] = np.lib.format.read_array(stream, allow_pickle=False)
        return arrays


def digest_of(text: str, arrays: Arrays) -> str:
    """SHA-256 over a text and every array with its name, type and shape."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        digest.update(f"{name}{arrays[name].dtype.str}{arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def _check_npy_header(stream: IO[bytes], name: str, kind: str, *, member_bytes: int) -> None:
    """Raise ValueError unless the declared type is expected and the size is the member's."""
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"{name}: .npy version must be (1, 0), got {version}")
    try:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    except _NO_HEADER as error:
        raise ValueError(f"{name}: unreadable header") from error
    if dtype.str != kind:
        raise ValueError(f"{name}: type must be {kind}, got {dtype.str}")
    if any(type(count) is not int or count < 0 for count in shape):
        raise ValueError(f"{name}: shape must be of whole numbers, got {shape}")
    size = dtype.itemsize * math.prod(shape)  # Python integers: no overflow
    if size + stream.tell() != member_bytes:
        raise ValueError(f"{name}: size must be that of the member, got {size} bytes")
