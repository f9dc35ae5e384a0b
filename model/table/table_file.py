"""Build, cache and read localization tables.

A table is bit-identical for any number of processes, and cached between runs in the user's cache
folder. The table file is an uncompressed .npz with a JSON header. Members are `header` (JSON as
bytes) and the arrays of `LocalizationTable` under their own names. The header contains the format
version, the plate's fingerprint, the inputs of the table, and a SHA-256 of the content, so that a
damaged or foreign file is rejected before use.
"""

import hashlib
import json
import logging
import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic_core import to_jsonable_python

from model.arrays import FloatArray
from model.caching import NUMERICS_VERSION, cache_folder, code_version
from model.drive_modes import UNRESTRICTED, checked_mode
from model.errors import InputError, expect_instance, expect_path
from model.files.array_file import UNREADABLE, Arrays, digest_of, read_arrays, write_arrays
from model.files.output_paths import begins_with
from model.finger import Grid, check_has_threshold
from model.processes import Progress, on_processes, unseen
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.rig.rig import PHYSICS, Rig, canonical_json, differences
from model.rig.rig_mesh import parse_mesh
from model.spectral.plate_mesh import PlateMesh
from model.structure.attachments import footprints_of
from model.structure.modal_elasticity import Dispersion, check_scales
from model.structure.statics import check_supported
from model.table.raster import Raster
from model.table.table import PAPER_GRID, LocalizationTable, default_drive_frequencies
from model.vibration import estimate_error, finer_mesh
from registry.wording import first_problem

FORMAT = "era-haptics localization table"
ZIP = b"PK\x03\x04"
"""Magic number of .npz files."""

FORMAT_VERSION = 9

_MAX_SHOWN = 3  # keys in which a table is of another rig

# A table of the paper's plate has 0.3 MB.
_MAX_BYTES = 2 << 30

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
_MAX_VALUE = 1e9


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
    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    place = expect_path(path, what="path")
    arrays = {
        name: np.ascontiguousarray(getattr(table, name), dtype=dtype)
        for name, dtype in _DTYPES.items()
        if name != "header"
    }
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "code_version": table.code_version,
        "fingerprint": table.fingerprint,
        "mode": table.drive_mode,
        **{name: to_jsonable_python(getattr(table, name)) for name in PHYSICS},
        "mesh": str(table.mesh),
        "reference_mesh": str(table.reference_mesh),
        "discretisation_error": table.discretization_error.tolist(),
        "frequencies_hz": table.frequencies.tolist(),
        "raster": asdict(table.raster),
        "grid": asdict(table.grid),
    }
    header["sha256"] = _digest(header, arrays)
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    write_arrays(place, {"header": encoded, **arrays})


def load_table(path: Path | str, *, rig: Rig | None = None) -> LocalizationTable:
    """Read a table.

    rig: must match the table, except for mesh, amplifiers, limits, wiring and names
    (docs/reference/table-file.md).
    Raises InputError for a missing, damaged or foreign file, and for another rig, with the keys
    that differ.

    Example:
        >>> era.save_table(table, "table.npz")
        >>> again = era.load_table("table.npz", rig=rig)
    """
    path = expect_path(path, what="path")
    if rig is not None:
        expect_instance(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    content = _read_content(path)
    rebuild = f"build it again, with the options it had: era table build RIG -o {path}"
    try:
        text = content.pop("header").tobytes()
        header = _WholeHeader.model_validate_json(text)
    except ValidationError as error:
        key, problem = first_problem(error)
        raise InputError(f"{path}: bad header ({key or 'header'}: {problem}); {rebuild}") from error
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
    if rig is not None:
        _check_is_of_rig(path, table, rig)
    return table


def _read_content(path: Path) -> dict[str, NDArray[Any]]:
    """Read the header and the arrays of a table file; raises InputError."""
    try:
        return read_arrays(path, _DTYPES, max_bytes=_MAX_BYTES)
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such table; build one: era table build RIG -o {path.with_suffix('.npz')}"
        ) from None
    except UNREADABLE as error:
        reason: object = error
        if isinstance(error, BadZipFile):
            reason = "cut off or damaged" if begins_with(path, ZIP) else "not a .npz file"
        elif isinstance(error, OSError):
            reason = error.strerror or error
        raise InputError(
            f"{path}: not a readable localization table ({reason}); give a file of era table "
            "build, or build it again"
        ) from error


def _check_is_of_rig(path: Path, table: LocalizationTable, rig: Rig) -> None:
    """Raise InputError with the keys in which a table is of another rig."""
    different = differences(table, rig)
    if not different:
        return
    keys = "; ".join(different[:_MAX_SHOWN])
    if len(different) > _MAX_SHOWN:
        keys += f"; and {len(different) - _MAX_SHOWN} more"
    raise InputError(
        f"{path}: must be a table of this rig: {keys}; build it again: era table build RIG "
        f"-o {path} {_options(table)}"
    )


def _options(table: LocalizationTable) -> str:
    """Return the options of `era table build` with which a table was built."""
    words = [f"{frequency:g}" for frequency in table.frequencies]
    steps = np.diff(table.frequencies)
    is_even = len(words) > 1 and np.allclose(steps, steps[0])
    frequencies = f"{words[0]}:{words[-1]}:{steps[0]:g}" if is_even else ",".join(words)
    return f"--mode {table.drive_mode} --grid {table.grid} --frequencies {frequencies}"


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
        discretization_error=np.array(header.discretisation_error, dtype=float),
        raster=header.raster,
        grid=header.grid,
        drive_mode=header.mode,
        code_version=header.code_version,
        **arrays,
    )
    checked_mode(table.drive_mode)
    _check_arrays(table)
    _check_positions(table)
    for threshold_set in table.threshold_sets:
        check_has_threshold(table.frequencies, threshold_set)
    # Rows are found by frequency with a binary search.
    frequencies = table.frequencies
    if not (len(frequencies) > 0 and frequencies[0] > 0 and (np.diff(frequencies) > 0).all()):
        raise InputError("frequencies must be positive and ascend, at least one")
    if frequencies.tolist() != header.frequencies_hz:
        raise InputError("frequencies of header and table must be equal")
    size = (table.raster.length, table.raster.width)
    if size != (table.plate.length, table.plate.width):
        raise InputError("raster and plate must have the same size")
    return table


def _check_arrays(table: LocalizationTable) -> None:
    """Raise InputError for arrays of another shape, and for values out of bounds."""
    count, era_count, coordinates = len(table.frequencies), len(table.eras), len(table.omega)
    nodes = len(table.dispersion_frequencies)
    expected = {
        "frequencies": (count,),
        "discretization_error": (count,),
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
        if not (np.abs(values) <= _MAX_VALUE).all():
            largest = np.abs(values).max()
            raise InputError(f"{name} must be finite and up to {_MAX_VALUE:g}, got {largest:.3g}")
    for name in ("shapes", "attachment_shapes", "omega"):
        if np.abs(getattr(table, name)).max(initial=0) < 1 / _MAX_VALUE:
            raise InputError(f"{name} must not be zero everywhere")


def _check_positions(table: LocalizationTable) -> None:
    """Raise InputError for ERAs and masses off the plate."""
    for attachment in (*table.eras, *table.masses):
        x, y = attachment.x, attachment.y
        if not (0 <= x <= table.plate.length and 0 <= y <= table.plate.width):
            raise InputError(f"ERAs and masses must be on the plate, got ({x:g}, {y:g}) m")


@dataclass(frozen=True, eq=False)
class TableProblem:
    """All inputs that determine the numbers of a table; the drive mode does not.

    frequencies (f,) [Hz], ascending, within the rig's limits. Raises InputError for others, and for
    a rig whose ERAs do not support its plate.
    """

    rig: Rig
    frequencies: FloatArray
    grid: Grid

    def __post_init__(self) -> None:
        """Reject invalid frequencies, and a table that would be too large."""
        frequencies = self.frequencies
        if len(frequencies) == 0 or not (np.isfinite(frequencies).all()):
            raise InputError("frequencies of a table must be finite numbers, at least one")
        if not (np.diff(frequencies) > 0).all():
            raise InputError("frequencies of a table must ascend without repetition")
        low, high = self.rig.limits.frequency_min, self.rig.limits.frequency_max
        if frequencies[0] < low or frequencies[-1] > high:
            raise InputError(
                f"frequencies must be within the rig's limits.frequency of {low:g} to {high:g} Hz, "
                f"got {frequencies[0]:g} to {frequencies[-1]:g} Hz; choose others or change the "
                "limits"
            )
        for threshold_set in (self.rig.threshold, *self.rig.promised_thresholds):
            check_has_threshold(frequencies, threshold_set)
        check_supported(self.rig.plate, self.rig.eras, loads=self.rig.masses)
        plate = self.rig.plate
        check_scales(plate, 1 + self.rig.uncertainty.frequency)
        wavelength = plate.bending_wavelength(2 * float(self.frequencies[-1]))
        modes = math.pi * plate.length * plate.width / wavelength**2
        size = 4 * self.raster.point_count * modes
        if size > _MAX_BYTES:
            raise InputError(
                f"a table must have up to {_MAX_BYTES / 1e9:.1f} GB, got {size / 1e9:.1f} GB; take "
                "lower frequencies"
            )

    @cached_property
    def raster(self) -> Raster:
        """Points of the fields."""
        return Raster.for_plate(self.rig.plate, frequency_max=float(self.frequencies[-1]))

    @cached_property
    def free_plate(self) -> FreePlate:
        """Free plate, solved up to the highest frequency."""
        highest = float(self.frequencies[-1])
        return solve_free_plate(self.rig.plate, self.rig.mesh, frequency_max=highest)

    @property
    def reference_mesh(self) -> PlateMesh:
        """Finer mesh for the discretization error."""
        return finer_mesh(
            self.rig.plate,
            self.rig.mesh,
            frequency_max=self.rig.limits.frequency_max,
            stiffness=self.rig.largest_stiffness,
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all inputs that determine the numbers of the table, and of the file format."""
        decisive = {
            "format": FORMAT_VERSION,
            "numerics": NUMERICS_VERSION,
            "plate": self.rig.fingerprint,
            "mesh": str(self.rig.mesh),
            "reference_mesh": str(self.reference_mesh),  # follows from the rig's limits
            "grid": [self.grid.nx, self.grid.ny],
            "frequencies": self.frequencies.tolist(),
        }
        return hashlib.sha256(canonical_json(decisive).encode()).hexdigest()


def build_table(
    rig: Rig,
    *,
    frequencies: FloatArray | None = None,
    grid: Grid = PAPER_GRID,
    drive_mode: str = UNRESTRICTED,
    progress: Progress = unseen,
) -> LocalizationTable:
    """Build the localization table of a rig.

    frequencies (f,) [Hz], ascending, within the rig's limits, `default_drive_frequencies` if None;
    drive_mode: one of DRIVE_MODES. Raises InputError.
    """
    if frequencies is None:
        frequencies = default_drive_frequencies(rig.limits)
    problem = TableProblem(rig, frequencies, grid)
    return solve_table(problem, drive_mode=drive_mode, progress=progress)


def solve_table(
    problem: TableProblem,
    *,
    drive_mode: str,
    workers: int = 1,
    progress: Progress = unseen,
    is_estimated: bool = True,
) -> LocalizationTable:
    """Solve modes and discretization error by several processes.

    progress: called with the number of finished parts and the total; is_estimated: whether to
    estimate the discretization error; an error of zero takes a tenth of the time. Raises
    InputError.
    """
    mode = checked_mode(drive_mode)
    parts = {0: _discretization if is_estimated else _no_error, 1: _modes}
    solved: dict[str, Any] = {name: getattr(problem.rig, name) for name in PHYSICS}
    # A copy without cached properties, which cannot all be sent to a process.
    results = on_processes(workers, _solve, replace(problem), parts)
    for done, (_, arrays) in enumerate(results, start=1):
        solved |= arrays
        progress(done, len(parts))
    return LocalizationTable(
        mesh=problem.rig.mesh,
        raster=problem.raster,
        grid=problem.grid,
        drive_mode=mode,
        code_version=code_version(),
        frequencies=problem.frequencies,
        reference_mesh=problem.reference_mesh,
        **solved,
    )


def _solve(problem: TableProblem, part: Callable[[TableProblem], Arrays]) -> Arrays:
    return part(problem)


def _modes(problem: TableProblem) -> Arrays:
    """Reduced plate at ERAs and loads, and on the raster."""
    attached = footprints_of(problem.rig.eras, problem.rig.masses)
    reduced = reduce_free_plate(problem.free_plate, attached)
    dispersion = reduced.dispersion
    if dispersion is None:
        no_dispersion = np.zeros((0, len(reduced.omega)), dtype=complex)
        dispersion = Dispersion(np.empty(0), no_dispersion)
    return {
        "omega": reduced.omega,
        "losses": reduced.losses,
        "dispersion_frequencies": dispersion.frequencies,
        "dispersion": dispersion.values,
        "attachment_shapes": reduced.at(attached),
        "shapes": reduced.at(problem.raster.points).astype(np.float32),
    }


def _discretization(problem: TableProblem) -> Arrays:
    """Estimated relative L2 error of the fields, maximum over the ERAs (f,)."""
    error = estimate_error(
        problem.free_plate,
        problem.reference_mesh,
        problem.rig.eras,
        problem.frequencies,
        problem.raster.points[problem.rig.plate.covers(problem.raster.points)],
        loads=problem.rig.masses,
    )
    return {"discretization_error": error.max(axis=1)}


def _no_error(problem: TableProblem) -> Arrays:
    return {"discretization_error": np.zeros(len(problem.frequencies))}


MAX_CACHED_TABLES = 50  # of some megabytes each; the least recently used go first

CURRENT_PREFIX = f"table-{FORMAT_VERSION}.{NUMERICS_VERSION}-"

_logger = logging.getLogger(__name__)


def cached_table(
    rig: Rig,
    *,
    frequencies: FloatArray | None = None,
    grid: Grid = PAPER_GRID,
    drive_mode: str = UNRESTRICTED,
    progress: Progress = unseen,
) -> tuple[LocalizationTable, Path | None]:
    """Return a rig's table from the user's cache folder, built if it is not there, and its file.

    frequencies (f,) [Hz]: `default_drive_frequencies` if None. A damaged file is built again. The
    file is None if the folder is not writable.
    """
    if frequencies is None:
        frequencies = default_drive_frequencies(rig.limits)
    problem = TableProblem(rig, frequencies, grid)
    try:
        folder = cache_folder()
    except OSError as error:
        _logger.warning("table cache: table not kept for the next run: %s", error)
        return solve_table(problem, drive_mode=drive_mode, progress=progress), None
    path = folder / f"{CURRENT_PREFIX}{problem.digest[:16]}-{drive_mode}.npz"
    try:
        table = load_table(path, rig=rig)
    except InputError as error:
        reason, _, _ = str(error).partition("; ")  # without the remedy, which follows here
        _logger.info("table cache: building a table: %s", reason)
    else:
        with suppress(OSError):
            os.utime(path)
        return table, path
    table = solve_table(problem, drive_mode=drive_mode, progress=progress)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_table(table, path)
    except OSError as error:
        _logger.warning("table cache: table not kept for the next run: %s", error)
        return table, None
    with suppress(OSError):
        _clean_up(folder)
    return table, path


def _clean_up(folder: Path) -> None:
    """Remove tables of other versions, and all but the most recently used ones."""
    tables = list(folder.glob("table-*.npz"))
    current = [path for path in tables if path.name.startswith(CURRENT_PREFIX)]
    recent = sorted(current, key=lambda path: path.stat().st_mtime)[-MAX_CACHED_TABLES:]
    for path in set(tables) - set(recent):
        path.unlink(missing_ok=True)
