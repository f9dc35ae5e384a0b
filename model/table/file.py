"""Table files: uncompressed .npz with a JSON header.

Members: `header` (JSON as bytes) and the arrays of `LocalizationTable` under their own names. The
header has the format version, the plate's fingerprint, the inputs of the table, and a SHA-256 over
the content, so that a damaged or foreign file is refused before any of it is used.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_type_hints
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic_core import to_jsonable_python

from model.drive_modes import checked_mode
from model.errors import InputError, expect, expect_path
from model.files.array_file import UNREADABLE, begins_with, digest_of, read_arrays, write_arrays
from model.finger import Grid, check_has_threshold
from model.rig.rig import PHYSICS, Rig, differences
from model.rig.rig_file import parse_mesh
from model.table.raster import Raster
from model.table.table import LocalizationTable
from registry.wording import first_problem

FORMAT = "era-haptics localization table"
ZIP = b"PK\x03\x04"
"""Magic number of .npz files."""

FORMAT_VERSION = 9

_MAX_SHOWN = 3  # keys in which a table is of another rig

# A table of the paper's plate has 0.3 MB.
MAX_BYTES = 2 << 30

_DTYPES = {
    "header": "|u1",
    "frequencies": "<f8",
    "omega": "<f8",
    "losses": "<f8",
    "dispersion_frequencies": "<f8",
    "dispersion": "<c16",
    "attachment_shapes": "<f8",
    "shapes": "<f4",
}


# Bound of accelerations [m/s²], frequencies [rad/s] and shapes [1/sqrt(kg)], whose squares fit into
# single precision.
MAX_VALUE = 1e9


class _Header(BaseModel):
    """JSON header."""

    model_config = ConfigDict(extra="forbid", strict=True)

    format: str
    format_version: int
    code_version: str
    fingerprint: str
    sha256: str
    mode: str
    mesh: str
    reference_mesh: str
    discretisation_error: list[float]
    frequencies_hz: list[float]
    raster: Raster
    grid: Grid


_PHYSICS: dict[str, Any] = {
    name: (kind, ...) for name, kind in get_type_hints(LocalizationTable).items() if name in PHYSICS
}
_WholeHeader = create_model("_WholeHeader", __base__=_Header, **_PHYSICS)


def save_table(table: LocalizationTable, path: Path | str) -> None:
    """Write a table; the file is replaced as a whole or stays as it was. Raises OSError.

    Example:
        >>> era.save_table(table, "table.npz")
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    place = expect_path(path, what="path")
    arrays = _arrays(table)
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "code_version": table.code_version,
        "fingerprint": table.fingerprint,
        "mode": table.drive_mode,
        **{name: to_jsonable_python(getattr(table, name)) for name in PHYSICS},
        "mesh": str(table.mesh),
        "reference_mesh": str(table.reference_mesh),
        "discretisation_error": table.discretisation_error.tolist(),
        "frequencies_hz": table.frequencies.tolist(),
        "raster": asdict(table.raster),
        "grid": asdict(table.grid),
    }
    header["sha256"] = _digest(header, arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    write_arrays(place, {"header": encoded, **arrays})


def load_table(path: Path | str, *, rig: Rig | None = None) -> LocalizationTable:
    """Read a table.

    rig: that it must be of, but for what may differ (`model.rig.rig.MAY_DIFFER`). Raises InputError
    for a missing, damaged or foreign file, with the keys in which it is of another rig.

    Example:
        >>> era.save_table(table, "table.npz")
        >>> again = era.load_table("table.npz", rig=rig)
    """
    path = expect_path(path, what="path")
    if rig is not None:
        expect(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    rebuild = f"build it again, with the options it had: era table build RIG -o {path}"
    try:
        content = read_arrays(path, _DTYPES, max_bytes=MAX_BYTES)
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such table; build one: era table build RIG -o {path.with_suffix('.npz')}"
        ) from None
    except UNREADABLE as error:
        why: object = error
        if isinstance(error, BadZipFile):
            why = "cut off or damaged" if begins_with(path, ZIP) else "not a .npz file"
        elif isinstance(error, OSError):
            why = error.strerror or error
        raise InputError(
            f"{path}: not a readable localization table ({why}); give a file of era table build, "
            "or build it again"
        ) from error
    try:
        text = content.pop("header").tobytes()
        header = _WholeHeader.model_validate_json(text)
    except ValidationError as error:
        where, said = first_problem(error)
        raise InputError(f"{path}: bad header ({where or 'header'}: {said}); {rebuild}") from error
    if header.format != FORMAT or header.format_version != FORMAT_VERSION:
        raise InputError(
            f"{path}: format must be {FORMAT!r} version {FORMAT_VERSION}, got {header.format!r} "
            f"version {header.format_version}; {rebuild}"
        )
    try:
        if _digest(json.loads(text), content) != header.sha256:
            raise InputError("content does not match its checksum")
        table = _assemble(header, content)
    except ValueError as error:  # also of numbers with more digits than Python takes
        raise InputError(f"{path}: {error}; {rebuild}") from error
    if table.fingerprint != header.fingerprint:
        raise InputError(f"{path}: fingerprint does not match the plate of the file; {rebuild}")
    if rig is not None and (different := differences(table, rig)):
        more = len(different) - _MAX_SHOWN
        raise InputError(
            f"{path}: must be a table of this rig: {'; '.join(different[:_MAX_SHOWN])}"
            f"{f'; and {more} more' if more > 0 else ''}; build it again: era table build RIG "
            f"-o {path} {_options(table)}"
        )
    return table


def _options(table: LocalizationTable) -> str:
    """The options of `era table build` with which a table was built."""
    f = [f"{each:g}" for each in table.frequencies]
    steps = np.diff(table.frequencies)
    is_even = len(f) > 1 and np.allclose(steps, steps[0])
    frequencies = f"{f[0]}:{f[-1]}:{steps[0]:g}" if is_even else ",".join(f)
    return f"--mode {table.drive_mode} --grid {table.grid} --frequencies {frequencies}"


def _arrays(table: LocalizationTable) -> dict[str, NDArray[Any]]:
    return {
        name: np.ascontiguousarray(getattr(table, name), dtype=dtype)
        for name, dtype in _DTYPES.items()
        if name != "header"
    }


def _digest(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> str:
    """SHA-256 over the header without its checksum, and over every array with its shape."""
    hashed = {key: value for key, value in header.items() if key != "sha256"}
    return digest_of(json.dumps(hashed, sort_keys=True), arrays)


def _assemble(header: _Header, arrays: dict[str, Any]) -> LocalizationTable:
    """Build a table from checked entries; sizes must match and all numbers be finite."""
    physics: dict[str, Any] = {name: getattr(header, name) for name in PHYSICS}
    table = LocalizationTable(
        **physics,
        mesh=parse_mesh(header.mesh, physics["plate"]),
        reference_mesh=parse_mesh(header.reference_mesh, physics["plate"]),
        discretisation_error=np.array(header.discretisation_error, dtype=float),
        raster=header.raster,
        grid=header.grid,
        drive_mode=header.mode,
        code_version=header.code_version,
        **arrays,
    )
    checked_mode(table.drive_mode)
    count, era_count, coordinates = len(table.frequencies), len(table.eras), len(table.omega)
    nodes = len(table.dispersion_frequencies)
    expected = {
        "frequencies": (count,),
        "discretisation_error": (count,),
        "omega": (coordinates,),
        "losses": (coordinates,),
        "dispersion_frequencies": (nodes,),
        "dispersion": (nodes, coordinates),
        "attachment_shapes": (era_count + len(table.masses), coordinates),
        "shapes": (table.raster.point_count, coordinates),
    }
    for name, shape in expected.items():
        values = getattr(table, name)
        if values.shape != shape:
            raise InputError(f"shape of {name} must be {shape}, got {values.shape}")
        if not (np.abs(values) <= MAX_VALUE).all():
            largest = np.abs(values).max()
            raise InputError(f"{name} must be finite and up to {MAX_VALUE:g}, got {largest:.3g}")
    for name in ("shapes", "attachment_shapes", "omega"):
        if np.abs(getattr(table, name)).max(initial=0) < 1 / MAX_VALUE:
            raise InputError(f"{name} must not be zero everywhere")
    places = [(each.x, each.y) for each in table.eras] + [(m.x, m.y) for m in table.masses]
    for x, y in places:
        if not (0 <= x <= table.plate.length and 0 <= y <= table.plate.width):
            raise InputError(f"ERAs and masses must be on the plate, got ({x:g}, {y:g}) m")
    for each in table.threshold_sets:
        check_has_threshold(table.frequencies, each)
    # Rows are found by frequency with a binary search.
    if not (count > 0 and table.frequencies[0] > 0 and (np.diff(table.frequencies) > 0).all()):
        raise InputError("frequencies must be positive and ascend, at least one")
    if table.frequencies.tolist() != header.frequencies_hz:
        raise InputError("frequencies of header and table must be equal")
    size = (table.raster.length, table.raster.width)
    if size != (table.plate.length, table.plate.width):
        raise InputError("raster and plate must have the same size")
    return table
