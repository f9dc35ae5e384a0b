"""Overview of a table: map and summary, costs of clocks and weather, export to other programs.

- `find_overview`, `summarize`: cells of the map, and felt contrast of random contacts.
- `clock_cost`, `uncertainty_cost`: the contrast that two contents keep with clock errors of
  amplifiers, in the rig's weather, or with an object on the plate; from answers on the nominal
  plate at a few positions and frequencies, in a second.
- `export_mat`, `export_csv`: a .mat file of everything, or .csv files of patterns or fields;
  `docs/reference/table-file.md` lists every name with its shape and unit.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from model.answer.plan import answer, query, worst_of
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import Complex64Array, FloatArray
from model.config.fields import Section, quantities
from model.drive_modes import UNRESTRICTED
from model.ensemble.draws import ClockErrors
from model.errors import InputError
from model.files.array_file import whole_or_nothing
from model.files.csv_file import write_rows
from model.finger import FELT_DB_SL, FINGERTIP_RADIUS, highest_measured
from model.processes import Progress, unseen
from model.rig.actuator_keys import ACTUATOR_KINDS
from model.rig.rig import PHYSICS, Rig
from model.rig.sections import (
    AirGapSection,
    FingertipSection,
    LayerSection,
    MassSection,
    MaterialSection,
    PlateSection,
)
from model.study.contrast_maps import (
    Contrasts,
    WeakCells,
    ask_once,
    contrasts_reached,
    find_weak_cells,
    pair_questions,
    random_contacts,
    sampling_error,
)
from model.table.table import PAPER_GRID, LocalizationTable
from model.table.table_file import FORMAT_VERSION, TableProblem, solve_table

CONTACT_SETS = 64
"""Number of random contact sets for each number of fingers."""


@dataclass(frozen=True, eq=False)
class Overview:
    """The map of a table, and its contrast to other fingers."""

    cells: WeakCells
    contrasts: Sequence[FloatArray]
    """Promised and nominal felt contrast (2, sets) [dB] to one, two and three other fingers."""


def find_overview(
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> Overview:
    """Query a table for its map and its contact sets; takes a second, five with sixteen ERAs.

    progress: called with the number of queries done and the total.
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
    """Draw queries with random fingers, one being the target; none on too small a plate."""
    found: list[Placement] = []
    with suppress(InputError):
        for _ in range(CONTACT_SETS):
            contacts = random_contacts(rng, others + 1, table.plate, tries=50 * CONTACT_SETS)
            found.append(Placement(contacts[:1], contacts[1:]))
    return found


def summarize(table: LocalizationTable, overview: Overview) -> dict[str, Any]:
    """Summarize a table, with median and tenth percentile of felt contrast [dB] over contact sets.

    Promised contrasts hold on 90 % of plates, the others on the nominal plate; each has a standard
    deviation due to the choice of the sets.
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


_PAIRS, _SEED, _LEVEL_DB_SL = 16, 14, 14.0
_STEP, _HIGHEST = 20.0, 250.0  # Hz; fingers feel most there, and a table of more takes longer


@dataclass(frozen=True)
class PromiseCost:
    """Contrast [dB] promised to the worst of two fingers: without a kind of error, and with it."""

    exact_db: float
    kept_db: float


def clock_cost(rig: Rig, errors: Mapping[str, float]) -> PromiseCost:
    """Compute the contrast of two contents with exact clocks, and with rms errors [s] by amplifier.

    Median over places. Raises InputError for a plate too small for two fingers, or without a table.
    """
    table = _coarse_table(rig)
    clocks = ClockErrors.of([era.name for era in table.eras], rig.wiring, errors)
    exact = _promised_db(table)
    # Made now: it shares what answers have computed.
    return _cost(exact, _promised_db(table.with_clocks(clocks)))


def uncertainty_cost(rig: Rig, key: str) -> PromiseCost:
    """Compute the contrast of two contents as if a key of the uncertainty were 0, and as it is.

    Median over places; raises as `clock_cost`.
    """
    table = _coarse_table(rig)
    still = replace(table, uncertainty=replace(rig.uncertainty, **{key: 0.0}))
    return _cost(_promised_db(still), _promised_db(table))


def _coarse_table(rig: Rig) -> LocalizationTable:
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    frequencies = np.arange(low, max(min(high, _HIGHEST), low) + 1e-9, _STEP)
    problem = TableProblem(rig, frequencies, PAPER_GRID)
    return solve_table(problem, drive_mode=UNRESTRICTED, is_estimated=False)


def _cost(exact: FloatArray, kept: FloatArray) -> PromiseCost:
    # The loss is computed per position, since positions differ far more.
    lost = max(float(np.median(exact - kept)), 0.0)
    median = float(np.median(exact))
    return PromiseCost(median, median - lost)


def _promised_db(table: LocalizationTable) -> FloatArray:
    """Return the contrast (pairs,) promised to the worst of two fingers at random places."""
    rng, found = np.random.default_rng(_SEED), list[float]()
    for _ in range(_PAIRS):
        fingers = [
            Finger(at, Stimulus(_LEVEL_DB_SL))
            for at in random_contacts(rng, 2, table.plate, margin=FINGERTIP_RADIUS)
        ]
        found.append(worst_of(answer(table, fingers, min_contrast_db=-math.inf)))
    return np.array(found)


MAX_MAT_BYTES = (1 << 31) - 1
"""Largest size of a variable in a .mat file of version 5, its header included."""


def export_mat(table: LocalizationTable, path: Path) -> None:
    """Write a struct `table` as a .mat file of version 5.

    Raises InputError for a table that the format cannot hold, OSError if it cannot be written.
    """
    from scipy.io import savemat

    size = 8 * table.raster.point_count * len(table.frequencies) * len(table.eras)
    if size > MAX_MAT_BYTES:
        raise InputError(
            f"a .mat file of version 5 must have up to {MAX_MAT_BYTES / 1e9:.1f} GB, got "
            f"{size / 1e9:.1f} GB; open the table itself, a .npz file, with numpy.load"
        )
    by_unit = {
        key: each.dimension.key(key)
        for section in _SECTIONS
        for key, field in section.model_fields.items()
        for each in quantities(field)
    } | _NAMES
    content = {
        "format_version": float(FORMAT_VERSION),
        "code_version": table.code_version,
        "fingerprint": table.fingerprint,
        "mode": table.drive_mode,
        **{
            name: _exported(getattr(table, name), {} if name == "uncertainty" else by_unit)
            for name in PHYSICS  # all of the rig that a table must have
        },
        "mesh": str(table.mesh),
        "reference_mesh": str(table.reference_mesh),
        "discretisation_error": table.discretisation_error,
        "frequency_hz": table.frequencies,
        "raster_x_m": table.raster.x,
        "raster_y_m": table.raster.y,
        "acceleration_m_s2": _fields(table),
        "mode_omega_rad_s": table.omega,
        "mode_loss_rad2_s2": table.losses,
        "mode_dispersion_hz": table.dispersion_frequencies,
        "mode_dispersion_rad2_s2": table.dispersion,
        "mode_shape": table.shapes,
        "mode_shape_attachments": table.attachment_shapes,
        "cell_centre_m": table.cell_centres,
        "cells_along_x": float(table.grid.nx),
        "cells_along_y": float(table.grid.ny),
    }
    with whole_or_nothing(path) as stream:
        savemat(
            stream,  # type: ignore[arg-type]  # it takes files too, its types do not say so
            {"table": content},
            long_field_names=True,
            oned_as="column",
        )


def export_csv(table: LocalizationTable, path: Path, *, content: str) -> None:
    """Write a .csv file whose columns have their units in their names.

    content: "patterns": a row for each target and quiet finger of the table's map, with the drive
    of each ERA in the table's drive mode (empty if silent) and the promises, all empty if the level
    is not reached; "fields": a row for each raster point and frequency, with real and imaginary
    acceleration for each ERA alone at full stroke.
    """
    write_rows(path, {"patterns": _pattern_rows, "fields": _field_rows}[content](table))


def _pattern_rows(table: LocalizationTable) -> Iterator[list[object]]:
    parts = [f"{era.name}_{part}" for era in table.eras for part in ("hz", "level", "phase_deg")]
    contacts = [f"{finger}_{axis}_m" for finger in ("target", "quiet") for axis in "xy"]
    yield [*contacts, *parts, "promised_level_db_sl", "promised_contrast_db"]
    for placed in chain.from_iterable(pair_questions(table)):
        at = chain.from_iterable(placed.contacts)
        found = query(table, placed)
        if not found.is_reached:
            yield [*at, *[""] * (len(parts) + 2)]
            continue
        drive, target = table.drive_of(found.layers[0].excitation), found.fingers[0]
        tones = (drive[era.name].values() if era.name in drive else [""] * 3 for era in table.eras)
        promised = (target.promised_level_db_sl, target.promised_contrast_db)
        yield [*at, *chain.from_iterable(tones), *promised]


def _field_rows(table: LocalizationTable) -> Iterator[list[object]]:
    parts = [f"{era.name}_{part}_m_s2" for era in table.eras for part in ("real", "imag")]
    yield ["x_m", "y_m", "frequency_hz", *parts]
    for (x, y), at_point in zip(table.raster.points.tolist(), _fields(table), strict=True):
        for frequency, values in zip(table.frequencies.tolist(), at_point, strict=True):
            # Text of single-precision numbers has the shortest decimals that identify them.
            yield [x, y, frequency, *map(str, values.view(np.float32))]


def _fields(table: LocalizationTable) -> Complex64Array:
    """Return the acceleration (points, f, eras) on the raster by each ERA at full stroke [m/s²]."""
    return np.ascontiguousarray(table.unit_fields(table.raster.points).transpose(2, 0, 1))


_SECTIONS: tuple[type[Section], ...] = (
    *(PlateSection, LayerSection, MaterialSection, AirGapSection, MassSection, FingertipSection),
    *ACTUATOR_KINDS.values(),
)
_NAMES = {"x": "x_m", "y": "y_m", "gains": "gain_hz_ratio_rad", "magnet_mass": "magnet_mass_kg"} | {
    "voltage": "voltage_v"
}


def _exported(value: Any, names: Mapping[str, str]) -> Any:
    """Convert a value for .mat files; names: with units, by names of fields."""
    if is_dataclass(value):
        each = {field.name: getattr(value, field.name) for field in fields(value)}
        return {names.get(key, key): _exported(own, names) for key, own in each.items()}
    if value is None:
        return np.zeros((0, 0))
    if not isinstance(value, tuple):
        return value
    rows = [_exported(each, names) for each in value]
    if rows and isinstance(rows[0], dict):
        return _structs(rows)
    is_named = bool(rows) and isinstance(rows[0], str)
    return np.array(rows, dtype=object if is_named else float)  # objects are a cell array


def _structs(rows: list[dict[str, Any]]) -> np.ndarray[Any, np.dtype[Any]]:
    """Make a struct array (n, 1) of rows; a field that a row lacks is empty."""
    names = dict.fromkeys(name for row in rows for name in row)
    structs = np.empty((len(rows), 1), dtype=[(name, object) for name in names])
    for number, row in enumerate(rows):
        for name in names:
            structs[name][number, 0] = row.get(name, np.zeros((0, 0)))
    return structs
