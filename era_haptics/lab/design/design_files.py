"""Files and JSON of a design: the rig with the best layout, a table of all layouts, a template."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from era_haptics.lab.design.design_figures import count_figure, quiet_fingers_figure
from era_haptics.lab.design.layout_keys import layout_keys
from era_haptics.lab.design.problem import DesignProblem
from era_haptics.lab.design.results import Design, RankedLayout
from model.config.document import Value, data_text
from model.figures.style import save_figure
from model.figures.template import Template, write_template
from model.files.array_file import whole_or_nothing
from model.files.csv_file import write_columns
from model.quantities import counted
from model.structure.statics import rigid_body_frequencies, static_loads

MAX_SHOWN = 10
"""Layouts in a summary; the CSV file contains all."""


def write_design(folder: Path, design: Design, data: Mapping[str, Value]) -> list[Path]:
    """Write rig.yaml, layouts.csv, contrast.png, count.png and template.svg; data: of the rig file.

    Raises OSError if the folder cannot be written.
    """
    rig_path, table_path = folder / "rig.yaml", folder / "layouts.csv"
    with whole_or_nothing(rig_path) as stream:
        stream.write(rig_text(design, data).encode())
    write_columns(table_path, _columns(design))
    contrast_path, count_path = folder / "contrast.png", folder / "count.png"
    save_figure(quiet_fingers_figure(design), contrast_path)
    save_figure(count_figure(design), count_path)
    template_path = folder / "template.svg"
    rig = replace(design.problem.rig, eras=design.best.eras)
    write_template(template_path, Template(rig, {}))
    return [rig_path, table_path, contrast_path, count_path, template_path]


def _columns(design: Design) -> dict[str, Any]:
    """Return the columns of the table of all layouts."""
    rows = [_csv_row(layout) for layout in design.layouts]
    columns: dict[str, Any] = {"rank": range(1, len(rows) + 1)}
    for name in rows[0]:
        columns[name] = [row[name] for row in rows]
    return columns


def _csv_row(layout: RankedLayout) -> dict[str, Any]:
    """Return the cells of a layout by column, empty for unknown values."""
    cells = _layout_row(layout)
    positions = [f"({x:.6g};{y:.6g})" for x, y in cells["at_m"].values()]
    cells["at_m"] = " ".join(positions)
    cells["score"] = "" if layout.score is None else layout.score
    cells["contrast_db"] = "" if layout.judged is None else f"{layout.mean_db:.6g}"
    return cells


def rig_text(design: Design, data: Mapping[str, Value]) -> str:
    """Return the text of the rig file with the best layout's ERAs on free channels."""
    best = design.best
    keys = layout_keys(design.problem, best.found.positions, data)
    contrast = f"{best.count} ERAs, {best.mean_db:.1f} dB over new contact sets"
    comment = f"# Designed for contrast: {contrast}.\n"
    own_names = design.problem.rig.amplifiers.keys()
    added_names = [name for name in keys["amplifiers"] if name not in own_names]
    if added_names:
        names = ", ".join(added_names)
        comment += f"# Replace the URLs of amplifiers {names} by URLs of real amplifiers.\n"
    return comment + data_text(keys)


def design_summary(design: Design) -> dict[str, Any]:
    """The design for JSON."""
    problem = design.problem
    best = design.best
    rig = problem.rig
    frequencies = rigid_body_frequencies(rig.plate, best.eras, loads=rig.masses)
    by_count = {}
    for count, layout in design.by_count.items():
        by_count[str(count)] = layout.mean_db
    by_stiffness = {}
    for stiffness, layout in design.by_stiffness.items():
        by_stiffness[f"{stiffness:g}"] = layout.mean_db
    unsupported = [layout for layout in design.layouts if not layout.found.is_supported]
    own_contrast = None if design.own is None else design.own.summary
    return {
        "eras": _era_rows(design),
        "contrast_db": best.answers.summary,
        "own_contrast_db": own_contrast,
        "reached_share": best.answers.reached_share,
        "starts_db": [layout.mean_db for layout in design.starts],
        "gap_db": design.gap_db,
        "by_count_db": by_count,
        "by_stiffness_db": by_stiffness,
        "layout_count": len(design.layouts),
        "unsupported": len(unsupported),
        "layouts": _ranked_rows(design.layouts),
        "lowest_rigid_body_hz": float(frequencies[0]),
        "contents": problem.contacts.contents,
        "sets": len(design.sets),
    }


def _era_rows(design: Design) -> dict[str, dict[str, Any]]:
    """Return the ERAs of the best layout for JSON."""
    rig, eras = design.problem.rig, design.best.eras
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    rows: dict[str, dict[str, Any]] = {}
    for era, sensitivity, load in zip(eras, design.sensitivities, loads, strict=False):
        rows[era.name] = {
            "at_m": [era.x, era.y],
            "sensitivity_db_per_mm": float(sensitivity) / 1000,
            "static_load_n": float(load),
        }
    return rows


def _ranked_rows(layouts: Sequence[RankedLayout]) -> list[dict[str, Any]]:
    """Return the best layouts with their ranks for JSON."""
    rows = []
    for rank, layout in enumerate(layouts[:MAX_SHOWN], start=1):
        rows.append({"rank": rank, **_layout_row(layout)})
    return rows


def _layout_row(layout: RankedLayout) -> dict[str, Any]:
    """Return a layout for JSON."""
    positions = {era.name: [era.x, era.y] for era in layout.eras}
    new_era = layout.eras[-1]
    return {
        "layout": layout.name,
        "at_m": positions,
        "stiffness_n_m": new_era.in_time.stiffness,
        "supported": layout.found.is_supported,
        "score": layout.score,
        "contrast_db": layout.judged.summary if layout.judged else None,
    }


class UnfinishedDesign:
    """Layouts of an interrupted design, as far as they were scored or evaluated in full."""

    def __init__(self) -> None:
        self._layouts: dict[tuple[DesignProblem, bytes], RankedLayout] = {}

    def add(self, layout: RankedLayout) -> None:
        """Add a scored layout, or replace it once it is evaluated in full."""
        key = layout.problem, layout.found.positions.tobytes()
        self._layouts[key] = layout

    @property
    def layouts(self) -> list[RankedLayout]:
        """Layouts that support the plate: fully evaluated ones by contrast, then the others by
        score."""
        supported = [layout for layout in self._layouts.values() if layout.found.is_supported]
        return sorted(supported, key=_rank)

    def summary(self) -> dict[str, Any]:
        """The layouts for JSON."""
        layouts = self.layouts
        evaluated = [layout for layout in layouts if layout.judged is not None]
        rows = _ranked_rows(layouts)
        for row, layout in zip(rows, layouts, strict=False):
            row["layout"] = _unique_name(layout)
        return {
            "incomplete": True,
            "layout_count": len(layouts),
            "judged": len(evaluated),
            "layouts": rows,
        }

    def write(self, path: Path) -> None:
        """Write the best layouts as a file for the `layouts` argument of `design`.

        Raises OSError if it cannot be written.
        """
        positions = {}
        for rank, layout in enumerate(self.layouts[:MAX_SHOWN], start=1):
            new_positions = layout.found.positions[len(layout.problem.kept) :]
            positions[f"{rank}: {_unique_name(layout)}"] = new_positions.tolist()
        comment = "# Layouts of an interrupted design, best first.\n"
        with whole_or_nothing(path) as stream:
            stream.write((comment + data_text({"layouts": positions})).encode())


def _unique_name(layout: RankedLayout) -> str:
    """Return the name of a layout, unique across numbers of ERAs."""
    return f"{layout.name}, {counted(layout.count, 'ERA')}"


def _rank(layout: RankedLayout) -> tuple[bool, float]:
    """Return a key that sorts evaluated layouts by contrast, then the others by score."""
    if layout.judged is None:
        return True, -layout.found.score_db
    return False, -layout.mean_db
