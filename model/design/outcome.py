"""Files, pictures and summary of a design."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from model.config.document import Value, data_text
from model.design.layout_keys import layout_keys
from model.design.run import Design, RankedLayout
from model.figures import COLORS, Template, draw_eras, label_plate, save_figure, write_template
from model.files.array_file import whole_or_nothing
from model.files.csv_file import Columns, write_columns
from model.structure.attachments import rigid_body_frequencies, static_loads

MAX_SHOWN = 10
"""Layouts in a summary; the CSV file has all."""


def write_design(folder: Path, design: Design, data: Mapping[str, Value]) -> list[Path]:
    """Write rig.yaml, layouts.csv, contrast.png, count.png and template.svg; data: of the file.

    Raises OSError if the folder cannot be written.
    """
    rig, table = folder / "rig.yaml", folder / "layouts.csv"
    with whole_or_nothing(rig) as stream:
        stream.write(rig_text(design, data).encode())
    write_columns(table, _columns(design.layouts))
    pictures = {"contrast.png": contrast_figure, "count.png": count_figure}
    for name, figure in pictures.items():
        save_figure(figure(design), folder / name)
    template = folder / "template.svg"
    write_template(template, Template(replace(design.problem.rig, eras=design.best.eras), {}))
    return [rig, table, *(folder / name for name in pictures), template]


def _columns(layouts: Sequence[RankedLayout]) -> Columns:
    """A row for each layout, in the order of their ranks."""
    rows = [_row(each) for each in layouts]
    at = [" ".join(f"({x:.6g};{y:.6g})" for x, y in row["at_m"].values()) for row in rows]
    columns = {key: ["" if row[key] is None else row[key] for row in rows] for key in rows[0]}
    contrast = [f"{each.mean_db:.6g}" if each.judged else "" for each in layouts]
    return {"rank": range(1, len(rows) + 1), **columns, "at_m": at, "contrast_db": contrast}


def _row(layout: RankedLayout) -> dict[str, Any]:
    """A layout for JSON."""
    eras = layout.eras
    return {
        "layout": layout.name,
        "at_m": {era.name: [era.x, era.y] for era in eras},
        "stiffness_n_m": eras[-1].in_time.stiffness,
        "supported": layout.found.is_supported,
        "expected_contrast_db": layout.expected_contrast,
        "contrast_db": layout.judged.summary if layout.judged else None,
    }


def rig_text(design: Design, data: Mapping[str, Value]) -> str:
    """The text of the rig's file with the ERAs of the best layout, on free channels."""
    keys = layout_keys(design.problem, design.best.found.positions, data)
    added = [name for name in keys["amplifiers"] if name not in design.problem.rig.amplifiers]
    comment = (
        f"# Designed for contrast: {design.problem.count} ERAs, "
        f"{design.best.mean_db:.1f} dB over fresh contact sets.\n"
    )
    if added:
        comment += f"# Give the amplifiers {', '.join(added)} the URLs of real ones.\n"
    return comment + data_text(keys)


def summary(design: Design) -> dict[str, Any]:
    """The design for JSON."""
    problem, best = design.problem, design.best
    eras, rig = best.eras, problem.rig
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    lowest = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    return {
        "eras": {
            era.name: {
                "at_m": [era.x, era.y],
                "sensitivity_db_per_mm": float(sensitivity) / 1000,
                "static_load_n": float(load),
            }
            for era, sensitivity, load in zip(eras, design.sensitivities, loads, strict=False)
        },
        "contrast_db": best.answers.summary,
        "own_contrast_db": None if design.own is None else design.own.summary,
        "reached_share": best.answers.reached_share,
        "starts_db": [each.mean_db for each in design.starts],
        "gap_db": design.gap_db,
        "by_count_db": {str(n): each.mean_db for n, each in design.by_count.items()},
        "by_stiffness_db": {
            f"{stiffness:g}": each.mean_db for stiffness, each in design.by_stiffness.items()
        },
        "layout_count": len(design.layouts),
        "unsupported": sum(not each.found.is_supported for each in design.layouts),
        "layouts": [
            {"rank": rank, **_row(each)}
            for rank, each in enumerate(design.layouts[:MAX_SHOWN], start=1)
        ],
        "lowest_rigid_body_hz": lowest,
        "contents": problem.contacts.contents,
        "sets": len(design.sets),
    }


def contrast_figure(design: Design) -> Figure:
    """Promised felt contrast of fresh contact sets at their contents, a panel by quiet fingers."""
    contents = design.problem.contacts.contents
    plate, judged = design.problem.rig.plate, design.best.answers
    eras = design.best.eras
    ratio = plate.width / plate.length
    kinds = judged.kinds
    figure = Figure(figsize=(3.4 * len(kinds) + 1, 3.0 * ratio + 1.2), layout="compressed")
    grid = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    places = np.array([contacts[:contents] for contacts in design.sets])  # (sets, contents, 2)
    ends = np.percentile(judged.contrast_db, [2, 98])
    for axes, quiet in zip(grid, kinds, strict=True):
        chosen = judged.quiet == quiet
        image = axes.scatter(
            *(100 * places[chosen].reshape(-1, 2).T),
            c=np.repeat(judged.contrast_db[chosen], contents),
            cmap=COLORS,
            vmin=ends[0],
            vmax=ends[1],
            s=26,
        )
        draw_eras(axes, eras, active=[era.name for era in eras])
        label_plate(axes)
        axes.set_xlim(0, 100 * plate.length)
        axes.set_ylim(0, 100 * plate.width)
        axes.set_title(f"{quiet} quiet: median {judged.median_db(quiet):.1f} dB")
        axes.label_outer()
    figure.colorbar(image, ax=grid, label="promised contrast / dB")
    return figure


def count_figure(design: Design) -> Figure:
    """Contrast against the number of ERAs, with what each buys."""
    counts = list(design.by_count)
    means = [each.mean_db for each in design.by_count.values()]
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(counts, means, "o-", color="black", label="mean")
    for quiet in design.best.answers.kinds:
        medians = [each.answers.median_db(quiet) for each in design.by_count.values()]
        axes.plot(counts, medians, "--", marker=".", label=f"{quiet} quiet, median")
    for count, low, high in zip(counts[1:], means, means[1:], strict=False):
        axes.annotate(f"{high - low:+.1f}", (count, high), (0, 7), textcoords="offset points")
    axes.set_xlabel("ERAs")
    axes.set_ylabel("promised contrast / dB")
    axes.set_xticks(counts)
    axes.margins(x=0.1)  # the last figure stands beside its point
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
