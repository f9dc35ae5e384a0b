"""Building a localization table, the same to the bit by any number of processes, or keeping it.

Tables are kept between runs in the user's cache folder.
"""

import hashlib
import logging
import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.caching import NUMERICS_VERSION, cache_folder, code_version
from model.drive_modes import checked_mode
from model.errors import InputError
from model.files.array_file import Arrays
from model.finger import Grid, check_has_threshold
from model.processes import Progress, on_processes, unseen
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.rig.rig import PHYSICS, Rig, canonical_json
from model.spectral.modes import PlateMesh
from model.structure.attachments import check_supported, footprints_of
from model.structure.modal_elasticity import Dispersion, check_scales
from model.table.file import FORMAT_VERSION, MAX_BYTES, load_table, save_table
from model.table.raster import Raster
from model.table.table import PAPER_GRID, LocalizationTable, default_drive_frequencies
from model.vibration import estimate_error, finer_mesh


@dataclass(frozen=True, eq=False)
class TableProblem:
    """All that the numbers of a table depend on; the drive mode is not among it.

    frequencies (f,) [Hz], ascending, within the rig's limits. Raises InputError for others, and
    for a rig whose ERAs do not support its plate.
    """

    rig: Rig
    frequencies: FloatArray
    grid: Grid

    def __post_init__(self) -> None:
        """Refuse frequencies that make no table, and a table that would be too large to be read."""
        _check_frequencies(self.frequencies, self.rig)
        check_supported(self.rig.plate, self.rig.eras, loads=self.rig.masses)
        plate = self.rig.plate
        check_scales(plate, 1 + self.rig.uncertainty.thickness)
        wavelength = plate.bending_wavelength(2 * float(self.frequencies[-1]))
        modes = math.pi * plate.length * plate.width / wavelength**2
        size = 4 * self.raster.point_count * modes
        if size > MAX_BYTES:
            raise InputError(
                f"a table must have up to {MAX_BYTES / 1e9:.1f} GB, got {size / 1e9:.1f} GB; take "
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
        """Finer mesh for the discretisation error."""
        return finer_mesh(
            self.rig.plate,
            self.rig.mesh,
            frequency_max=self.rig.limits.frequency_max,
            stiffness=self.rig.largest_stiffness,
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 over everything that decides the numbers of the table, and their format."""
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
    drive_mode: str = "switched",
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
    """Solve modes and discretisation error by several processes.

    progress: called with the number of finished parts and the total; is_estimated: unless the error
    is taken for none, which takes a tenth of the time. Raises InputError.
    """
    mode, error = checked_mode(drive_mode), _discretisation if is_estimated else _no_error
    parts = dict(enumerate((error, _modes)))
    solved: dict[str, Any] = {name: getattr(problem.rig, name) for name in PHYSICS}
    # A copy without cached properties, which cannot all be sent to a process.
    found = on_processes(workers, _solve, replace(problem), parts)
    for done, (_, arrays) in enumerate(found, start=1):
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
        nothing = np.zeros((0, len(reduced.omega)), dtype=complex)
        dispersion = Dispersion(np.empty(0), nothing)
    return {
        "omega": reduced.omega,
        "losses": reduced.losses,
        "dispersion_frequencies": dispersion.frequencies,
        "dispersion": dispersion.values,
        "attachment_shapes": reduced.at(attached),
        "shapes": reduced.at(problem.raster.points).astype(np.float32),
    }


def _discretisation(problem: TableProblem) -> Arrays:
    """Estimated relative L2 error of the fields, maximum over the ERAs (f,)."""
    error = estimate_error(
        problem.free_plate,
        problem.reference_mesh,
        problem.rig.eras,
        problem.frequencies,
        problem.raster.points,
        loads=problem.rig.masses,
    )
    return {"discretisation_error": error.max(axis=1)}


def _no_error(problem: TableProblem) -> Arrays:
    return {"discretisation_error": np.zeros(len(problem.frequencies))}


def _check_frequencies(frequencies: FloatArray, rig: Rig) -> None:
    if len(frequencies) == 0 or not (np.isfinite(frequencies).all()):
        raise InputError("frequencies of a table must be finite numbers, at least one")
    if not (np.diff(frequencies) > 0).all():
        raise InputError("frequencies of a table must ascend without repetition")
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    if frequencies[0] < low or frequencies[-1] > high:
        raise InputError(
            f"frequencies must be within the rig's limits.frequency of {low:g} to {high:g} Hz, got "
            f"{frequencies[0]:g} to {frequencies[-1]:g} Hz; choose others or change the limits"
        )
    for each in (rig.threshold, *rig.promised_thresholds):
        check_has_threshold(frequencies, each)


MAX_CACHED_TABLES = 50  # of some megabytes each; the least recently used go first

_CURRENT = f"table-{FORMAT_VERSION}.{NUMERICS_VERSION}-"

_logger = logging.getLogger(__name__)


def cached_table(
    rig: Rig,
    *,
    frequencies: FloatArray | None = None,
    grid: Grid = PAPER_GRID,
    drive_mode: str = "switched",
    progress: Progress = unseen,
) -> tuple[LocalizationTable, Path | None]:
    """Return a rig's table from the user's cache folder, built if it is not there, and its file.

    frequencies (f,) [Hz]: `default_drive_frequencies` if None. A damaged file is built again. The
    file is None where the folder cannot be written.
    """
    if frequencies is None:
        frequencies = default_drive_frequencies(rig.limits)
    problem = TableProblem(rig, frequencies, grid)
    try:
        folder = cache_folder()
    except OSError as error:
        _logger.warning("table cache: table not kept for the next run: %s", error)
        return solve_table(problem, drive_mode=drive_mode, progress=progress), None
    path = folder / f"{_CURRENT}{problem.digest[:16]}-{drive_mode}.npz"
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
    current = [path for path in tables if path.name.startswith(_CURRENT)]
    recent = sorted(current, key=lambda path: path.stat().st_mtime)[-MAX_CACHED_TABLES:]
    for path in set(tables) - set(recent):
        path.unlink(missing_ok=True)
