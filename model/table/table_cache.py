"""Tables kept between runs in the user's cache folder."""

import logging
import os
from contextlib import suppress
from pathlib import Path

from model.arrays import FloatArray
from model.cache_folder import cache_folder
from model.errors import InputError
from model.finger.grid import Grid
from model.progress import Progress, unseen
from model.rig.rig import Rig
from model.table.build import TableProblem, solve_table
from model.table.file import FORMAT_VERSION, load_table, save_table
from model.table.table import PAPER_GRID, LocalizationTable, default_drive_frequencies
from model.version import NUMERICS_VERSION

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
