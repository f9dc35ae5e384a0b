"""Export a table for other programs: a complete .mat file, or .csv files.

`docs/reference/table-file.md` lists every name with its shape and unit.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from model.answer.answer import Answer
from model.answer.plan import query
from model.arrays import Complex64Array
from model.config.fields import Section, quantities
from model.errors import InputError
from model.files.array_file import whole_or_nothing
from model.files.csv_file import write_rows
from model.rig.actuator_keys import ACTUATOR_KINDS
from model.rig.plate_sections import (
    AirGapSection,
    LayerSection,
    MaterialSection,
    PlateSection,
)
from model.rig.rig import PHYSICS
from model.rig.sections import FingertipSection, MassSection
from model.study.weak_cells import pair_questions
from model.table.table import LocalizationTable
from model.table.table_file import FORMAT_VERSION

MAX_MAT_BYTES = (1 << 31) - 1
"""Largest size of a variable in a .mat file of version 5, its header included."""

_SECTIONS: tuple[type[Section], ...] = (
    PlateSection,
    LayerSection,
    MaterialSection,
    AirGapSection,
    MassSection,
    FingertipSection,
    *ACTUATOR_KINDS.values(),
)

_NAMES = {
    "x": "x_m",
    "y": "y_m",
    "gains": "gain_hz_ratio_rad",
    "magnet_mass": "magnet_mass_kg",
    "voltage": "voltage_v",
}
"""Names with units of fields whose unit is not in a section."""


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
    with whole_or_nothing(path) as stream:
        savemat(
            stream,  # type: ignore[arg-type]  # it takes files too, its types do not say so
            {"table": _mat_content(table)},
            long_field_names=True,
            oned_as="column",
        )


def _mat_content(table: LocalizationTable) -> dict[str, Any]:
    names = _names_with_units()
    rig_values = {}
    for key in PHYSICS:  # all properties of the rig that a table contains
        names_of_key = {} if key == "uncertainty" else names
        rig_values[key] = _exported(getattr(table, key), names_of_key)
    return {
        "format_version": float(FORMAT_VERSION),
        "code_version": table.code_version,
        "fingerprint": table.fingerprint,
        "mode": table.drive_mode,
        **rig_values,
        "mesh": str(table.mesh),
        "reference_mesh": str(table.reference_mesh),
        "discretisation_error": table.discretization_error,
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
        "cell_centre_m": table.cell_centers,
        "cells_along_x": float(table.grid.nx),
        "cells_along_y": float(table.grid.ny),
    }


def _names_with_units() -> dict[str, str]:
    """Return names with units by names of fields."""
    names = {}
    for section in _SECTIONS:
        for key, model_field in section.model_fields.items():
            for quantity in quantities(model_field):
                names[key] = quantity.dimension.key(key)
    return names | _NAMES


def _exported(value: Any, names: Mapping[str, str]) -> Any:
    """Convert a value for .mat files; names: with units, by names of fields."""
    if is_dataclass(value):
        exported = {}
        for field in fields(value):
            name = names.get(field.name, field.name)
            exported[name] = _exported(getattr(value, field.name), names)
        return exported
    if value is None:
        return np.zeros((0, 0))
    if not isinstance(value, tuple):
        return value
    rows = [_exported(row, names) for row in value]
    if rows and isinstance(rows[0], dict):
        return _structs(rows)
    is_text = bool(rows) and isinstance(rows[0], str)
    return np.array(rows, dtype=object if is_text else float)  # objects are a cell array


def _structs(rows: list[dict[str, Any]]) -> np.ndarray[Any, np.dtype[Any]]:
    """Make a struct array (n, 1) of rows; a field that a row lacks is empty."""
    names = dict.fromkeys(name for row in rows for name in row)
    structs = np.empty((len(rows), 1), dtype=[(name, object) for name in names])
    for number, row in enumerate(rows):
        for name in names:
            structs[name][number, 0] = row.get(name, np.zeros((0, 0)))
    return structs


def export_csv(table: LocalizationTable, path: Path, *, content: str) -> None:
    """Write a .csv file whose columns have their units in their names.

    content: "patterns": a row for each target and quiet finger of the table's map, with the drive
    of each ERA in the table's drive mode (empty if silent) and the promises, all empty if the level
    is not reached; "fields": a row for each raster point and frequency, with real and imaginary
    acceleration for each ERA alone at full stroke.
    """
    rows_of_content = {"patterns": _pattern_rows, "fields": _field_rows}
    write_rows(path, rows_of_content[content](table))


def _pattern_rows(table: LocalizationTable) -> Iterator[list[object]]:
    contact_columns = ["target_x_m", "target_y_m", "quiet_x_m", "quiet_y_m"]
    drive_columns = []
    for era in table.eras:
        drive_columns += [f"{era.name}_hz", f"{era.name}_level", f"{era.name}_phase_deg"]
    promise_columns = ["promised_level_db_sl", "promised_contrast_db"]
    yield [*contact_columns, *drive_columns, *promise_columns]
    empty = [""] * (len(drive_columns) + len(promise_columns))
    for placed in chain.from_iterable(pair_questions(table)):
        positions = chain.from_iterable(placed.contacts)
        answer = query(table, placed)
        if answer.is_reached:
            yield [*positions, *_drive_cells(table, answer), *_promise_cells(answer)]
        else:
            yield [*positions, *empty]


def _drive_cells(table: LocalizationTable, answer: Answer) -> list[object]:
    """Return frequency, level and phase of each ERA in turn, empty if it is silent."""
    drive = table.drive_of(answer.layers[0].excitation)
    cells: list[object] = []
    for era in table.eras:
        cells.extend(drive[era.name].values() if era.name in drive else [""] * 3)
    return cells


def _promise_cells(answer: Answer) -> list[object]:
    target = answer.fingers[0]
    return [target.promised_level_db_sl, target.promised_contrast_db]


def _field_rows(table: LocalizationTable) -> Iterator[list[object]]:
    columns = ["x_m", "y_m", "frequency_hz"]
    for era in table.eras:
        columns += [f"{era.name}_real_m_s2", f"{era.name}_imag_m_s2"]
    yield list(columns)
    for (x, y), at_point in zip(table.raster.points.tolist(), _fields(table), strict=True):
        for frequency, values in zip(table.frequencies.tolist(), at_point, strict=True):
            # Text of single-precision numbers has the shortest decimals that identify them.
            yield [x, y, frequency, *map(str, values.view(np.float32))]


def _fields(table: LocalizationTable) -> Complex64Array:
    """Return the acceleration (points, f, eras) on the raster by each ERA at full stroke [m/s²]."""
    return np.ascontiguousarray(table.unit_fields(table.raster.points).transpose(2, 0, 1))
