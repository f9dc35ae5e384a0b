"""Pictures of a demonstration: some of the touches, and where each of several contents is felt."""

import math
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.demo.touch_row import TouchRow
from model.answer.answer import Sensation
from model.answer.stimulus import Finger
from model.arrays import ranked_by
from model.figures import (
    contents_figure,
    draw_fingertip,
    draw_level_scale,
    draw_levels,
    save_figure,
)
from model.table.table import LocalizationTable

MAX_PANELS = 6


def write_pictures(table: LocalizationTable, rows: list[TouchRow], folder: Path) -> list[Path]:
    """Draw some of the touches into a folder, and several contents; return what was written."""
    figures = {}
    if chosen := choose_rows([row for row in rows if not row.fingers]):
        figures["touches"] = touches_figure(table, chosen)
    several = [row for row in rows if row.measured_level_db_sl is not None and row.fingers]
    if several:
        row = max(several, key=lambda row: len(row.contents))
        frequencies = [layer.frequency for layer in row.contents]
        fingers = [
            Sensation(
                Finger(each.at_m),
                each.verdict,
                frequencies.index(each.frequency_hz) if each.frequency_hz in frequencies else None,
                -math.inf if each.measured_level_db_sl is None else each.measured_level_db_sl,
                contrast_db=each.measured_contrast_db,
            )
            for each in row.fingers
        ]
        figures["contents"] = contents_figure(table, row.contents, fingers)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        save_figure(figure, path)
    return paths


def choose_rows(rows: Sequence[TouchRow]) -> list[TouchRow]:
    """Choose the measured touches of highest contrast, evenly over the number of other fingers.

    One finger alone is shown at most once.
    """
    by_count: dict[int, list[TouchRow]] = {}
    for row in ranked_by(rows, _contrast):
        if row.measured_level_db_sl is not None:
            by_count.setdefault(len(row.quiet), []).append(row)
    by_count[0] = by_count.get(0, [])[:1]
    in_turn = zip_longest(*(by_count[count] for count in sorted(by_count)))
    chosen = [row for each in in_turn for row in each if row is not None]
    return sorted(chosen[:MAX_PANELS], key=lambda row: len(row.quiet))


def touches_figure(table: LocalizationTable, rows: Sequence[TouchRow]) -> Figure:
    """Draw a panel per touch: level over the plate, fingers and driven ERAs."""
    columns = min(3, len(rows))
    lines = -(-len(rows) // columns)
    height = 4.4 * table.plate.width / table.plate.length + 0.8
    figure = Figure(figsize=(4.4 * columns + 0.8, height * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, row in zip(panels, rows, strict=False):
        _draw_touch(axes, table, row)
    draw_level_scale(figure, panels, shrink=0.7)
    figure.supxlabel(
        "felt: mean over the fingertip; quiet: its loudest point; "
        "felt contrast: the first less the loudest of the second",
        fontsize=10,
    )
    return figure


def _contrast(row: TouchRow) -> float:
    contrast = row.measured_contrast_db
    return -math.inf if contrast is None else contrast


def _draw_touch(axes: Axes, table: LocalizationTable, row: TouchRow) -> None:
    if row.pattern is not None:
        draw_levels(axes, table, row.pattern.excitation)
    level = row.levels_db_sl.get(row.target_id)
    draw_fingertip(axes, row.targets_m[0], felt=True, level_db_sl=level)
    for id, position in row.quiet.items():
        draw_fingertip(axes, position, felt=False, level_db_sl=row.levels_db_sl.get(id))
    contrast, promised = row.measured_contrast_db, row.promised_contrast_db
    title = "one finger alone" if contrast is None else f"felt contrast {contrast:.1f} dB"
    if promised is not None:
        title += f", promised {promised:.1f}"
    axes.set_title(title, fontsize=11, pad=20)
