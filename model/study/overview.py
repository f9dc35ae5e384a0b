"""What a table reaches: cells of its map, felt contrast of random contacts, their summary."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.answer.stimulus import Placement
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import FELT_DB_SL, highest_measured
from model.processes import Progress, unseen
from model.study.random_contacts import random_contacts
from model.study.weak_cells import (
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


@dataclass(frozen=True, eq=False)
class Overview:
    """The map of a table, and its contrast to other fingers.

    contrasts: to one, two and three others, each promised and nominal felt contrast [dB] of contact
    sets (2, sets).
    """

    cells: WeakCells
    contrasts: Sequence[FloatArray]


def find_overview(
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> Overview:
    """Query a table for its map and its contact sets; takes a second, five with sixteen ERAs.

    progress: called with the number of answered questions, and the total.
    """
    rng, ask, answered = np.random.default_rng(0), ask_once(table), list[list[Contrasts | None]]()
    cells = pair_questions(table)
    groups = [*cells, *(set_questions(table, others=others, rng=rng) for others in (2, 3))]
    total = sum(map(len, groups))
    for group in groups:
        answered.append([*map(ask, group)])
        progress(sum(map(len, answered)), total)
    weak = find_weak_cells(table, answered[: len(cells)])
    sets = [contrasts_reached(each) for each in answered[len(cells) :]]
    return Overview(weak, [weak.pairs_db, *sets])


def set_questions(
    table: LocalizationTable, *, others: int, rng: np.random.Generator
) -> list[Placement]:
    """Questions with fingers at random, one the target; none on a plate too small for them."""
    found: list[Placement] = []
    with suppress(InputError):
        for _ in range(CONTACT_SETS):
            contacts = random_contacts(rng, others + 1, table.plate, tries=50 * CONTACT_SETS)
            found.append(Placement(contacts[:1], contacts[1:]))
    return found


def summarize(table: LocalizationTable, overview: Overview) -> dict[str, Any]:
    """Summarize a table; felt contrast [dB]: median and tenth percentile over contact sets.

    Promised contrasts are those of nine of ten plates, the others those of the nominal plate;
    beside each one standard deviation by the choice of the sets.
    """
    weak = overview.cells
    available = table.available_level_db_sl
    known = np.isfinite(weak.tenth_db) | np.isneginf(weak.tenth_db)
    thickness = (table.plate.laminate or table.plate).thickness
    summary: dict[str, Any] = {
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
        "feasible_share": float(weak.feasible[known].mean()) if known.any() else None,
        "weak_share": float(weak.weak[known].mean()) if known.any() else None,
    }
    for others, found in enumerate(overview.contrasts, start=1):
        for kind, contrasts in zip(("promised_contrast", "contrast"), found, strict=True):
            for name, percentile in (("median", 50), ("tenth_percentile", 10)):
                value = float(np.percentile(contrasts, percentile)) if len(contrasts) else None
                error = sampling_error(contrasts, percentile) if len(contrasts) else None
                summary[f"{kind}_{others}_quiet_{name}_db"] = value
                summary[f"{kind}_{others}_quiet_{name}_error_db"] = error
    summary["mesh_name"] = str(table.mesh)
    summary["discretisation_error_percent"] = 100 * float(table.discretisation_error.max())
    summary["reference_mesh"] = str(table.reference_mesh)
    summary["raster"] = f"{table.raster.nx}x{table.raster.ny}"
    summary["code_version"] = table.code_version
    summary["fingerprint"] = table.fingerprint
    return summary
