"""What a table can do, in a handful of numbers."""

import contextlib
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.perception import FELT_DB_SL
from model.table import LocalizationTable

CONTACT_SETS = 200
LEAST_DISTANCE = 0.05
"""Fingers of a contact set are at least this far apart [m]: fingertips of two hands."""


def summarize(table: LocalizationTable) -> dict[str, Any]:
    """Provenance, levels that can be had, dead zones and contrast to one, two and three others.

    Contrast: median and tenth percentile [dB] over random contact sets (seed 0).
    """
    available = table.available_level_db_sl
    summary: dict[str, Any] = {
        "mode": table.mode,
        "plate_m": [table.plate.length, table.plate.width, table.plate.thickness],
        "eras": [era.name for era in table.eras],
        "frequencies_hz": f"{table.frequencies[0]:g}..{table.frequencies[-1]:g}",
        "frequency_count": len(table.frequencies),
        "mesh": str(table.mesh),
        "grid": str(table.grid),
        "cells": table.grid.cell_count,
        "patterns": len(table.patterns),
        "dead_zone_share": float((available < FELT_DB_SL).mean()),
        "least_level_at_full_stroke_db_sl": float(available.min()),
    }
    rng = np.random.default_rng(0)
    for others in (1, 2, 3):
        contrasts = contrast_distribution(table, others=others, rng=rng)
        for name, percentile in (("median", 50), ("tenth_percentile", 10)):
            value = float(np.percentile(contrasts, percentile)) if len(contrasts) else None
            summary[f"contrast_{others}_quiet_{name}_db"] = value
    summary["code_version"] = table.code_version
    summary["fingerprint"] = table.fingerprint
    return summary


def contrast_distribution(
    table: LocalizationTable, *, others: int, rng: np.random.Generator
) -> FloatArray:
    """Predicted contrast [dB] of random contact sets, up to (CONTACT_SETS,).

    Sets whose target no pattern reaches are left out, and so are all on a plate too small for them.
    """
    size = np.array([table.plate.length, table.plate.width])
    contrasts: list[float] = []
    for _ in range(50 * CONTACT_SETS):
        contacts = rng.uniform(0, size, (others + 1, 2))
        gaps = np.linalg.norm(contacts[:, None] - contacts[None], axis=-1)
        if gaps[np.triu_indices(others + 1, 1)].min() < LEAST_DISTANCE:
            continue
        target, *quiet = [(float(x), float(y)) for x, y in contacts]
        with contextlib.suppress(InputError):
            contrast = table.answer(target, quiet=quiet).contrast_db
            contrasts.append(np.nan if contrast is None else contrast)
        if len(contrasts) == CONTACT_SETS:
            break
    return np.array(contrasts)
