"""Files written whole or not at all: arrays in an uncompressed .npz, and checks of output paths.

Arrays are checked before they are read: names, types and sizes must be those expected; nothing may
be compressed or pickled, and no array may declare more than the file holds. Output paths are
checked for their ending, their folder, and the kind of file that they would replace.
"""

import hashlib
import math
import os
import struct
import uuid
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.errors import shown
from registry.files import open_regular

Arrays: TypeAlias = Mapping[str, NDArray[Any]]

Types: TypeAlias = Mapping[str, str | Collection[str]]
"""Accepted type (`dtype.str`), or types, of each array by name."""

WHOLE_NUMBERS = frozenset(np.dtype(order + code).str for order in "<>" for code in "bBhHiIqQ")
"""Types of whole numbers of any size."""

REAL_NUMBERS = WHOLE_NUMBERS | {np.dtype(order + code).str for order in "<>" for code in "efdg"}
"""Types of real numbers of any size."""

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
_END = struct.Struct("<4s6xHI4xH")  # mark, number of members, size of the directory and of a remark
_END_MARK = b"PK\x05\x06"
_END_64 = b"PK\x06\x07"  # before the end of a file of more than 2 GiB
_END_64_SIZE = 20
_MAX_DIRECTORY = 1 << 16  # bytes; an entry of 50 becomes an object of 700


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


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays by name, atomically."""
    with whole_or_nothing(path) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_arrays(path: Path, types: Types, *, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Read arrays of exactly these names and types; raises one of UNREADABLE."""
    with open_regular(path, max_bytes) as file:
        return arrays_in(file, types)


def arrays_in(
    file: BinaryIO, types: Types, *, optional: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an open file; raises one of UNREADABLE.

    types: of all arrays that the file may have; optional: names of arrays that may be missing.
    """
    file_bytes = file.seek(0, os.SEEK_END)
    _check_end(file, file_bytes)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        members = {entry.filename.removesuffix(".npy"): entry for entry in entries}
        is_missing = types.keys() - members.keys() - set(optional)
        if is_missing or members.keys() - types.keys() or len(members) < len(entries):
            required = ", ".join(sorted(types.keys() - set(optional)))
            further = f", optionally {', '.join(sorted(optional))}" if optional else ""
            names = shown(", ".join(sorted(members)))
            raise ValueError(f"members must be {required}{further}, got {names}")
        for name, entry in members.items():
            if entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{name}: must not be compressed; write it with numpy.savez")
            if entry.flag_bits & _ENCRYPTED:
                raise ValueError(f"{name}: must not be encrypted")
        declared = sum(entry.file_size for entry in entries)
        if declared > file_bytes:
            raise ValueError(f"size must match the file's, got {declared} bytes")
        arrays = {}
        for name, entry in members.items():
            with archive.open(entry) as stream:
                _check_npy_header(stream, name, types[name], member_bytes=entry.file_size)
            with archive.open(entry) as stream:
                arrays[name] = np.lib.format.read_array(stream, allow_pickle=False)
        return arrays


def _check_end(file: BinaryIO, file_bytes: int) -> None:
    """Raise an error of UNREADABLE for a directory too large to read, or without an end."""
    file.seek(max(0, file_bytes - _END.size - _END_64_SIZE))
    locator, end = file.read(_END_64_SIZE), file.read()
    if len(end) != _END.size:
        raise zipfile.BadZipFile("the file is too short")
    mark, _, directory_bytes, remark_bytes = _END.unpack(end)
    if mark != _END_MARK or remark_bytes:
        raise zipfile.BadZipFile("the file must end with the directory of an archive")
    if locator.startswith(_END_64) or directory_bytes > _MAX_DIRECTORY:
        raise ValueError(f"the directory must be of up to {_MAX_DIRECTORY >> 10} KiB")


def digest_of(text: str, arrays: Arrays) -> str:
    """SHA-256 over a text and every array with its name, type and shape."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        digest.update(f"{name}{arrays[name].dtype.str}{arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def _check_npy_header(
    stream: IO[bytes], name: str, accepted: str | Collection[str], *, member_bytes: int
) -> None:
    """Raise ValueError unless the declared type is accepted and the size is the member's."""
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"{name}: .npy version must be (1, 0), got {version}")
    try:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    except Exception as error:  # numpy parses the header as Python text, which fails in many ways
        raise ValueError(f"{name}: unreadable header") from error
    if isinstance(accepted, str):
        is_accepted, expected = dtype.str == accepted, accepted
    else:
        is_accepted = dtype.str in accepted
        expected = "real numbers" if "<f8" in accepted else "whole numbers"
    if not is_accepted:
        raise ValueError(f"{name}: type must be {expected}, got {shown(dtype.str)}")
    # A dimension of an array without values could be any number.
    if any(type(count) is not int or not 0 <= count <= member_bytes for count in shape):
        rule = f"dimensions must be whole numbers from 0 to {member_bytes}"
        raise ValueError(f"{name}: {rule}, got {shown(str(shape))}")
    size = dtype.itemsize * math.prod(shape)  # Python integers: no overflow
    if size + stream.tell() != member_bytes:
        raise ValueError(f"{name}: size must match the member's, got {size} bytes")
