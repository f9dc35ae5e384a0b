"""Summary of a table: levels, dead zones, weak cells, contrast, origin."""

from typing import Any

import numpy as np

from model.finger.perception import FELT_DB_SL, highest_measured
from model.table.overview import Overview
from model.table.table import LocalizationTable
from model.table.weak_cells import sampling_error


def summarize(table: LocalizationTable, overview: Overview) -> dict[str, Any]:
    """Summarize a table; felt contrast [dB]: median and tenth percentile over contact sets.

    Robust contrasts are those of nine of ten plates, the others those of the plate as modelled;
    beside each one standard deviation by the choice of the sets.
    """
    weak = overview.cells
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
    for others, found in enumerate(overview.contrasts, start=1):
        for kind, contrasts in zip(("robust_felt", "felt"), found, strict=True):
            for name, percentile in (("median", 50), ("tenth_percentile", 10)):
                value = float(np.percentile(contrasts, percentile)) if len(contrasts) else None
                error = sampling_error(contrasts, percentile) if len(contrasts) else None
                summary[f"{kind}_contrast_{others}_quiet_{name}_db"] = value
                summary[f"{kind}_contrast_{others}_quiet_{name}_error_db"] = error
    summary["mesh_name"] = str(table.mesh)
    summary["discretisation_error_percent"] = 100 * float(table.discretisation_error.max())
    summary["reference_mesh"] = str(table.reference_mesh)
    summary["raster"] = f"{table.raster.nx}x{table.raster.ny}"
    summary["code_version"] = table.code_version
    summary["fingerprint"] = table.fingerprint
    return summary
