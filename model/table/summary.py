"""Summary of a table: levels, dead zones, weak cells, contrast, origin."""

from collections.abc import Callable
from itertools import islice
from typing import Any

import numpy as np

from model.arrays import FloatArray, IntArray
from model.drive_modes.sources import all_combinations
from model.finger.perception import FELT_DB_SL, highest_measured
from model.table.many_answers import Ask, Contrasts, ask_here
from model.table.question import Question
from model.table.table import LocalizationTable
from model.table.weak_cells import WeakCells, are_apart

CONTACT_SETS = 200

PAIRS = 20_000
MIN_SIMILARITY = 0.95
"""Correlation of responses at the cells above which two patterns count as similar."""


def summarize(
    table: LocalizationTable,
    weak: WeakCells,
    *,
    ask: Ask | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, Any]:
    """Summarize a table; felt contrast [dB]: median and tenth percentile over random contact sets.

    Robust contrasts are those of nine of ten plates, the others those of the plate as modelled.

    ask: answers the questions, in this process by default; progress: called with the number of
    finished sets and the total.
    """
    available = table.available_level_db_sl
    known = np.isfinite(weak.tenth_db) | np.isneginf(weak.tenth_db)
    summary: dict[str, Any] = {
        "mode": table.drive_mode,
        "plate_m": [table.plate.length, table.plate.width, table.plate.thickness],
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
    rng = np.random.default_rng(0)
    for others in (1, 2, 3):
        found = contrast_distribution(table, others=others, rng=rng, ask=ask, progress=progress)
        for kind, contrasts in zip(("robust_felt", "felt"), found, strict=True):
            for name, percentile in (("median", 50), ("tenth_percentile", 10)):
                value = float(np.percentile(contrasts, percentile)) if len(contrasts) else None
                summary[f"{kind}_contrast_{others}_quiet_{name}_db"] = value
    summary["alike_pattern_pairs_share"] = similar_share(table)
    summary["mesh_name"] = str(table.mesh)
    summary["discretisation_error_percent"] = 100 * float(table.discretisation_error.max())
    summary["reference_mesh"] = str(table.reference_mesh)
    summary["raster"] = f"{table.raster.nx}x{table.raster.ny}"
    summary["code_version"] = table.code_version
    summary["fingerprint"] = table.fingerprint
    return summary


def contrast_distribution(
    table: LocalizationTable,
    *,
    others: int,
    rng: np.random.Generator,
    ask: Ask | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> FloatArray:
    """Robust and nominal felt contrast [dB] of random contact sets, (2, up to CONTACT_SETS).

    Sets with an unreachable target are left out, and all on a plate too small for them. ask and
    progress: as for `summarize`, which takes one, two and three others in turn.
    """
    size = np.array([table.plate.length, table.plate.width])
    ask = ask or ask_here(table)
    contrasts: list[Contrasts] = []
    tried = 0
    drawn = (rng.uniform(0, size, (others + 1, 2)) for _ in range(50 * CONTACT_SETS))
    apart = filter(are_apart, drawn)
    while count := min(CONTACT_SETS - len(contrasts), 2 * CONTACT_SETS - tried):
        questions = []
        for contacts in islice(apart, count):
            target, *quiet = [(float(x), float(y)) for x, y in contacts]
            questions.append(Question((target,), tuple(quiet)))
        if not questions:
            break
        tried += len(questions)
        for found in ask(questions):
            if found is not None:
                contrasts.append(found)
            progress((others - 1) * CONTACT_SETS + len(contrasts), 3 * CONTACT_SETS)
    return np.array(contrasts, dtype=float).reshape(-1, 2).T


def similar_share(table: LocalizationTable) -> float | None:
    """Share of similar pairs of `switched` patterns in a random sample of PAIRS.

    None for a single pattern or cell.
    """
    patterns = all_combinations(len(table.eras), len(table.frequencies))
    count = len(patterns.first)
    if min(count, table.grid.cell_count) < 2:
        return None
    rng = np.random.default_rng(0)
    one = rng.integers(count, size=PAIRS)
    other = (one + rng.integers(1, count, size=PAIRS)) % count  # never a pattern with itself

    def scaled(chosen: IntArray) -> FloatArray:
        sources = table.cell_sources.astype(float)
        rows = sources[patterns.first[chosen]] + sources[patterns.second[chosen]]
        rows -= rows.mean(axis=1, keepdims=True)
        return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))

    correlation = (scaled(one) * scaled(other)).sum(axis=1)
    return float((correlation > MIN_SIMILARITY).mean())
