"""The file of a learned plate: parameters and covariance, beside the table that they correct."""

import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.files.array_file import UNREADABLE, begins_with, read_arrays, write_arrays
from model.identification.settled import State

_VERSION = 2
_TYPES = {"header": "|u1", "x": "<f8", "covariance": "<f8", "digest": "|u1"}
_MAX_BYTES = 1 << 24


class OtherPlate(InputError):
    """A learned plate of another table, or of other parameters."""


@dataclass(frozen=True, eq=False)
class LearnedPlate:
    """A state of parameters by name, counted from a rig; table, base: fingerprints of both.

    change: how the plate has changed since in a way that its parameters do not follow, or nothing.
    """

    table: str
    base: str
    names: tuple[str, ...]
    state: State
    change: str = ""


def save_learned(learned: LearnedPlate, file: Path) -> None:
    """Write a learned plate, atomically; raises OSError."""
    header = {
        "version": _VERSION,
        "table": learned.table,
        "base": learned.base,
        "names": learned.names,
        "change": learned.change,
    }
    text = json.dumps(header)
    x, covariance = learned.state.x, learned.state.covariance
    write_arrays(
        file,
        {
            "header": np.frombuffer(text.encode(), dtype=np.uint8),
            "x": x,
            "covariance": covariance,
            "digest": np.frombuffer(_digest(text, x, covariance), dtype=np.uint8),
        },
    )


def load_learned(file: Path, *, table: str) -> LearnedPlate:
    """Read a learned plate of a table by its fingerprint.

    Raises InputError for a damaged file or another version, OtherPlate for another table.
    """
    try:
        arrays = read_arrays(file, _TYPES, max_bytes=_MAX_BYTES)
        text, x, covariance = arrays["header"].tobytes().decode(), arrays["x"], arrays["covariance"]
        if arrays["digest"].tobytes() != _digest(text, x, covariance):
            raise ValueError("digest must be that of the content")
        header = json.loads(text)
        version, names = header["version"], tuple(header["names"])
        found = LearnedPlate(
            header["table"],
            header["base"],
            names,
            State(x, covariance),
            str(header["change"]),
        )
    except (*UNREADABLE, KeyError, TypeError) as error:
        why = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(
            f"{file}: must be a learned plate: {why}; remove the file to learn anew"
        ) from error
    p = len(names)
    if version != _VERSION or x.shape != (p,) or covariance.shape != (p, p):
        raise InputError(f"{file}: version must be {_VERSION}; remove the file to learn anew")
    if found.table != table:
        raise OtherPlate(
            f"{file}: must be learned for this table, got one of another rig; remove the file to "
            "learn anew"
        )
    return found


def was_learned(file: Path) -> bool:
    """Whether a file is a learned plate of any version, or may have been before it was damaged."""
    if not begins_with(file, b"PK"):
        return False
    try:
        with zipfile.ZipFile(file) as members:
            return "covariance.npy" in members.namelist()
    except zipfile.BadZipFile:
        return True


def _digest(text: str, x: np.ndarray, covariance: np.ndarray) -> bytes:
    return hashlib.sha256(text.encode() + x.tobytes() + covariance.tobytes()).digest()
