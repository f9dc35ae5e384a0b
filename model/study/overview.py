"""Overview of a table: its map of weak cells, and its contrast to random other fingers."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from model.answer.stimulus import Placement
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import FELT_DB_SL, highest_measured
from model.processes import Progress, unseen
from model.study.contact_sets import random_contacts
from model.study.weak_cells import (
    MAX_GRID,
    Contrasts,
    WeakCells,
    ask_once,
    contrasts_reached,
    find_weak_cells,
    pair_questions,
    sampling_error,
)
from model.table.table import LocalizationTable

CONTACT_SETS = 64
"""Number of random contact sets for each number of fingers."""


@dataclass(frozen=True, eq=False)
class Overview:
    """The map of a table, and its contrast to other fingers."""

    cells: WeakCells
    contrasts: Sequence[FloatArray]
    """Promised and nominal felt contrast (2, sets) [dB] to one, two and three other fingers."""


def promised_to_another(table: LocalizationTable) -> float | None:
    """Return the promised contrast of a finger to another [dB]; None if no pair reaches the level.

    The definition of this figure in all commands, pages and pictures: the median over targets at
    the centers of 8 by 6 cells with another finger at random positions (`pair_questions`), at 20 dB
    SL, in the table's drive mode.
    """
    ask = ask_once(table)
    answers = [ask(question) for question in _common_pairs(table)]
    promised, _ = contrasts_reached(answers)
    return float(np.median(promised)) if len(promised) else None


def _common_pairs(table: LocalizationTable) -> list[Placement]:
    """Return pairs of fingers that do not depend on the grid of a table."""
    return list(chain.from_iterable(pair_questions(table, MAX_GRID)))


def find_overview(
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> Overview:
    """Query a table for its map and its contact sets; takes a second, five with sixteen ERAs.

    progress: called with the number of queries done and the total.
    """
    rng = np.random.default_rng(0)
    cell_questions = pair_questions(table)
    contact_sets = [set_questions(table, others=others, rng=rng) for others in (2, 3)]
    groups = [*cell_questions, _common_pairs(table), *contact_sets]
    total = sum(len(group) for group in groups)
    ask = ask_once(table)
    answered: list[list[Contrasts | None]] = []
    for group in groups:
        answered.append([ask(question) for question in group])
        progress(sum(len(answers) for answers in answered), total)
    cell_count = len(cell_questions)
    weak = find_weak_cells(table, answered[:cell_count])
    contrasts = [contrasts_reached(answers) for answers in answered[cell_count:]]
    return Overview(weak, contrasts)


def set_questions(
    table: LocalizationTable, *, others: int, rng: np.random.Generator
) -> list[Placement]:
    """Draw questions with random fingers, one being the target; none on too small a plate."""
    questions: list[Placement] = []
    with suppress(InputError):
        for _ in range(CONTACT_SETS):
            contacts = random_contacts(rng, others + 1, table.plate, tries=50 * CONTACT_SETS)
            questions.append(Placement(contacts[:1], contacts[1:]))
    return questions


def summarize(table: LocalizationTable, overview: Overview) -> dict[str, Any]:
    """Summarize a table, with median and tenth percentile of felt contrast [dB] over contact sets.

    Promised contrasts hold on 90 % of plates, the others on the nominal plate. Each has a standard
    error due to the choice of contact sets.
    """
    weak = overview.cells
    available = table.available_level_db_sl
    is_known = np.isfinite(weak.tenth_db) | np.isneginf(weak.tenth_db)
    thickness = (table.plate.laminate or table.plate).thickness
    return {
        "mode": table.drive_mode,
        "plate_m": [table.plate.length, table.plate.width, thickness],
        "eras": [era.name for era in table.eras],
        "frequency_range_hz": [float(table.frequencies[0]), float(table.frequencies[-1])],
        "frequency_count": len(table.frequencies),
        "threshold": table.threshold,
        "threshold_measured_to_hz": highest_measured(table.threshold),
        "grid": str(table.grid),
        "cells": table.grid.cell_count,
        "patterns": table.pattern_count,
        "least_level_at_full_stroke_db_sl": float(available.min()),
        "dead_zone_share": float((available < FELT_DB_SL).mean()),
        "feasible_share": float(weak.feasible[is_known].mean()) if is_known.any() else None,
        "weak_share": float(weak.weak[is_known].mean()) if is_known.any() else None,
        **_summary_of_contrasts(overview.contrasts),
        "mesh_name": str(table.mesh),
        "discretisation_error_percent": 100 * float(table.discretization_error.max()),
        "reference_mesh": str(table.reference_mesh),
        "raster": f"{table.raster.nx}x{table.raster.ny}",
        "code_version": table.code_version,
        "fingerprint": table.fingerprint,
    }


def _summary_of_contrasts(by_quiet_count: Sequence[FloatArray]) -> dict[str, float | None]:
    """Return percentiles and their errors by key, None without contact sets."""
    summary: dict[str, float | None] = {}
    for quiet_count, (promised, nominal) in enumerate(by_quiet_count, start=1):
        for kind, contrasts in (("promised_contrast", promised), ("contrast", nominal)):
            for name, percent in (("median", 50), ("tenth_percentile", 10)):
                key = f"{kind}_{quiet_count}_quiet_{name}"
                has_sets = len(contrasts) > 0
                value = float(np.percentile(contrasts, percent)) if has_sets else None
                error = sampling_error(contrasts, percent) if has_sets else None
                summary[f"{key}_db"] = value
                summary[f"{key}_error_db"] = error
    return summary
