"""Arrays in a file: an uncompressed .npz, written whole or not at all, checked before it is read.

Reading trusts nothing: names, types and sizes must be those expected, nothing may be compressed or
pickled, and no array may declare more than the file holds.
"""

import hashlib
import os
import tokenize
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Arrays: TypeAlias = Mapping[str, NDArray[Any]]

UNREADABLE = (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError)
"""What `read_arrays` raises for a file that is not there, damaged, or not what was expected."""


_ENCRYPTED = 0x1  # a flag of a zip member

# numpy parses a header as Python text, and not all that parsing raises is turned to ValueError.
_NO_HEADER = (SyntaxError, tokenize.TokenError, TypeError, RecursionError, MemoryError)


@contextmanager
def whole_or_nothing(path: Path) -> Iterator[IO[bytes]]:
    """A stream that becomes the file when the block ends well, and leaves nothing when it does not.

    Raises OSError, with the file's name, where it cannot be written. One that the block raises with
    the name of another file keeps that.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}")
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


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays by name; the file is either the old one or the whole new one, never between."""
    with whole_or_nothing(path) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_arrays(path: Path, types: Mapping[str, str], *, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Arrays of exactly these names and types (numpy's `dtype.str`); raises one of UNREADABLE."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        if sorted(members) != sorted(types) or len(archive.infolist()) != len(types):
            raise ValueError(f"it holds {', '.join(sorted(members)) or 'nothing'}")
        if any(info.compress_type != zipfile.ZIP_STORED for info in members.values()):
            raise ValueError("it is compressed")
        if any(info.flag_bits & _ENCRYPTED for info in members.values()):
            raise ValueError("it is encrypted")
        declared = sum(info.file_size for info in members.values())
        if declared > min(path.stat().st_size, max_bytes):
            raise ValueError(f"it declares {declared} bytes")
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
    """Refuse an array whose declared type or size is not what the member can hold."""
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"{name} has .npy version {version}")
    try:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    except _NO_HEADER as error:
        raise ValueError(f"{name} has a header that cannot be read") from error
    if dtype.str != kind:
        raise ValueError(f"{name} holds {dtype.str}")
    size = dtype.itemsize
    for length in shape:
        size *= length  # Python integers: no overflow
    if size + stream.tell() != member_bytes:
        raise ValueError(f"{name} declares {size} bytes")
