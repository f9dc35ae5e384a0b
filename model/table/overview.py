"""What the cells of a table reach, and its random contact sets: computed once, kept for all uses.

A kept overview is in the user's cache folder beside tables. Its name is a digest of the table
file's content and of the model's source: of another table, or after a change of the code, it is
computed again.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import platformdirs

from model.arrays import FloatArray
from model.errors import InputError
from model.files.array_file import whole_or_nothing
from model.finger.grid import Grid
from model.table.contact_sets import CONTACT_SETS, contrast_distribution
from model.table.many_answers import Ask, ask_here, ask_on_processes
from model.table.mirrored_questions import ask_once, mirror_images
from model.table.table import LocalizationTable
from model.table.weak_cells import WeakCells, find_weak_cells, map_grid, pair_questions
from model.version import code_version

MAX_KEPT_OVERVIEWS = 200  # of some kilobytes; the oldest go first

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Overview:
    """The map of a table, and its contrast to other fingers.

    contrasts: to one, two and three others, each robust and nominal felt contrast [dB] of contact
    sets (2, sets).
    """

    cells: WeakCells
    contrasts: Sequence[FloatArray]


def find_overview(
    table: LocalizationTable,
    *,
    ask: Ask | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Overview:
    """Query a table for its map and its contact sets.

    ask: answers the questions, in this process by default; progress: called with the number of
    finished cells and sets, and the total.
    """
    ask = ask_once(ask or ask_here(table), table)
    cells = map_grid(table).cell_count
    total = cells + 2 * CONTACT_SETS
    found = find_weak_cells(table, ask=ask, progress=lambda done, _: progress(done, total))
    rng = np.random.default_rng(0)
    contrasts = [found.pairs_db]
    for others in (2, 3):
        before = cells + (others - 2) * CONTACT_SETS
        report = partial(_report_sets, progress, before=before, total=total)
        contrasts.append(
            contrast_distribution(table, others=others, rng=rng, ask=ask, progress=report)
        )
    return Overview(found, contrasts)


def question_count(table: LocalizationTable) -> int:
    """About how many questions `find_overview` asks."""
    pairs = sum(len(each) for each in pair_questions(table))
    return pairs // len(mirror_images(table)) + 2 * CONTACT_SETS


def _report_sets(
    progress: Callable[[int, int], None], done: int, *, before: int, total: int
) -> None:
    progress(before + done, total)


def kept_overview(
    path: Path,
    table: LocalizationTable,
    *,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Overview:
    """Read the overview of a table from the user's cache, or compute it.

    path: the table's file.
    """
    digest = hashlib.sha256(path.read_bytes() + code_version().encode()).hexdigest()[:32]
    folder = platformdirs.user_cache_path("era-haptics", appauthor=False)
    kept = folder / f"overview-{digest}.json"
    with suppress(OSError, ValueError, KeyError, TypeError, InputError):
        return _read(kept, map_grid(table), table)
    with ask_on_processes(table, questions=question_count(table)) as ask:
        overview = find_overview(table, ask=ask, progress=progress)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(kept, overview)
        oldest_first = sorted(folder.glob("overview-*.json"), key=lambda each: each.stat().st_mtime)
        for each in oldest_first[:-MAX_KEPT_OVERVIEWS]:
            each.unlink(missing_ok=True)
    except OSError as error:
        _logger.warning("table overview: not kept for the next run: %s", error)
    return overview


def _write(path: Path, overview: Overview) -> None:
    cells = overview.cells
    content = {
        "median_db": cells.median_db.tolist(),
        "tenth_db": cells.tenth_db.tolist(),
        "errors_db": cells.errors_db.tolist(),
        "contrasts": [each.tolist() for each in overview.contrasts],
    }
    with whole_or_nothing(path) as stream:
        stream.write(json.dumps(content).encode())


def _read(path: Path, grid: Grid, table: LocalizationTable) -> Overview:
    content = json.loads(path.read_bytes())
    contrasts = [np.array(each, dtype=float).reshape(2, -1) for each in content["contrasts"]]
    keys = ("median_db", "tenth_db", "errors_db")
    median, tenth, errors = (np.array(content[key], dtype=float) for key in keys)
    count = grid.cell_count
    shapes = [each.shape for each in (median, tenth, errors)]
    if not (len(contrasts) == 3 and shapes == [(count,), (count,), (2, count)]):
        raise ValueError("an overview must have a value for each cell")
    return Overview(
        WeakCells(grid, grid.centres(table.plate), median, tenth, errors, contrasts[0]), contrasts
    )
