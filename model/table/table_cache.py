"""Tables kept between runs, by everything that makes them."""

import hashlib
import logging
from pathlib import Path

import platformdirs

from model.arrays import FloatArray
from model.errors import InputError
from model.finger.grid import Grid
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.file import FORMAT_VERSION, load_table, save_table
from model.table.table import PAPER_GRID, LocalizationTable, default_drive_frequencies
from model.version import code_version

_logger = logging.getLogger(__name__)


def cached_table(
    rig: Rig,
    *,
    frequencies: FloatArray | None = None,
    grid: Grid = PAPER_GRID,
    drive_mode: str = "switched",
) -> tuple[LocalizationTable, Path | None]:
    """The table of a rig, from the user's cache folder or built and kept there; and its file.

    frequencies (f,) [Hz]: `default_drive_frequencies` if None. A damaged cache file, and one
    that other code has made, is built anew. Where nothing can be written the table is built all the
    same and the file is None.
    """
    if frequencies is None:
        frequencies = default_drive_frequencies(rig.limits)
    path = _cache_path(rig, frequencies, grid, drive_mode)
    try:
        kept = load_table(path, fingerprint=rig.fingerprint)
    except InputError as error:
        reason, _, _ = str(error).partition("; ")  # what is to be done about it is done here
        _logger.info("building the localization table: %s", reason)
    else:
        if kept.code_version == code_version():
            return kept, path
        _logger.info("building the localization table: %s made the one kept", kept.code_version)
    table = build_table(rig, frequencies=frequencies, grid=grid, drive_mode=drive_mode)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_table(table, path)
    except OSError as error:
        _logger.warning("the table is not kept for the next run: %s", error)
        return table, None
    return table, path


def _cache_path(rig: Rig, frequencies: FloatArray, grid: Grid, drive_mode: str) -> Path:
    name = f"{FORMAT_VERSION} {rig.mesh} {grid} {drive_mode} {frequencies.tolist()}"
    digest = hashlib.sha256(f"{rig.fingerprint} {name}".encode()).hexdigest()[:16]
    return platformdirs.user_cache_path("era-haptics", appauthor=False) / f"table-{digest}.npz"
