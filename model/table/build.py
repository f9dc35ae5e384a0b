"""Building a localization table from independent parts.

The result is the same to the bit for any number of processes. Finished parts can be kept
(`model.table.kept_parts`), so that an interrupted build can be resumed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.files.array_file import Arrays
from model.finger.grid import Grid
from model.processes import on_processes
from model.rig.rig import Rig
from model.table.kept_parts import KeptParts
from model.table.table import PAPER_GRID, LocalizationTable, default_drive_frequencies
from model.table.table_parts import Part, TableProblem, solve_part
from model.version import code_version


@dataclass(frozen=True, eq=False)
class Build:
    """A table, with the number of its parts that were reused from an interrupted build."""

    table: LocalizationTable
    part_count: int
    reused_count: int


def build_table(
    rig: Rig,
    *,
    frequencies: FloatArray | None = None,
    grid: Grid = PAPER_GRID,
    drive_mode: str = "switched",
) -> LocalizationTable:
    """Build the localization table of a rig.

    frequencies (f,) [Hz], ascending, within the rig's limits, `default_drive_frequencies` if None;
    drive_mode: one of DRIVE_MODES. Raises InputError.
    """
    if frequencies is None:
        frequencies = default_drive_frequencies(rig.limits)
    return build_in_parts(TableProblem(rig, frequencies, grid), drive_mode=drive_mode).table


def build_in_parts(
    problem: TableProblem,
    *,
    drive_mode: str,
    workers: int = 1,
    kept: KeptParts | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Build:
    """Solve the parts of a table by several processes, and join them.

    kept: where finished parts are read from and stored, an exception or Ctrl-C included. progress:
    called with the number of finished parts and the total. Raises InputError.
    """
    if drive_mode not in DRIVE_MODES:
        raise InputError(f"drive mode must be one of {', '.join(DRIVE_MODES)}, got {drive_mode!r}")
    parts = dict(enumerate(problem.parts()))
    found = {number: kept.load(part) for number, part in parts.items()} if kept else {}
    done = {number: arrays for number, arrays in found.items() if arrays is not None}
    reused_count = len(done)
    progress(len(done), len(parts))
    missing = {number: part for number, part in parts.items() if number not in done}
    # A copy without cached properties, which cannot all be sent to a process.
    for number, arrays in on_processes(workers, solve_part, replace(problem), missing):
        if kept:
            kept.store(parts[number], arrays)
        done[number] = arrays
        progress(len(done), len(parts))
    table = _joined(problem, drive_mode, {parts[number]: done[number] for number in parts})
    return Build(table, len(parts), reused_count)


def _joined(
    problem: TableProblem, drive_mode: str, solved: Mapping[Part, Arrays]
) -> LocalizationTable:
    def joined(name: str, *, axis: int) -> NDArray[Any]:
        pieces = [arrays[name] for arrays in solved.values() if name in arrays]
        return np.concatenate(pieces, axis=axis)

    rig = problem.rig
    (modes,) = (arrays for part, arrays in solved.items() if part.kind == "modes")
    return LocalizationTable(
        plate=rig.plate,
        eras=rig.eras,
        masses=rig.masses,
        uncertainty=rig.uncertainty,
        fingertip=rig.fingertip,
        threshold=rig.threshold,
        mesh=rig.mesh,
        raster=problem.raster,
        grid=problem.grid,
        drive_mode=drive_mode,
        code_version=code_version(),
        frequencies=problem.frequencies,
        reference_mesh=problem.reference_mesh,
        discretisation_error=joined("discretisation_error", axis=0),
        **modes,
    )
