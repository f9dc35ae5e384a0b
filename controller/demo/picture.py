"""The picture of a demonstration: the plate under some touches, and what each finger felt."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.demo.rows import PlayedPattern, TouchRow
from model.figures.fingertips import draw_fingertip, draw_level_scale, draw_levels
from model.table.table import LocalizationTable

PANELS = 6


def choose_rows(rows: Sequence[TouchRow]) -> list[TouchRow]:
    """A few touches worth a picture: most contrast first, mostly with other fingers about."""
    by_count: dict[int, list[TouchRow]] = {}
    for row in sorted(rows, key=_contrast, reverse=True):
        if row.played is not None and row.played.measured is not None:
            by_count.setdefault(len(row.quiet), []).append(row)
    chosen = by_count.pop(0, [])[:1]
    while by_count and len(chosen) < PANELS:
        for count in sorted(by_count):
            chosen.append(by_count[count].pop(0))
            if not by_count[count]:
                del by_count[count]
    return sorted(chosen[:PANELS], key=lambda row: len(row.quiet))


def touches_figure(table: LocalizationTable, rows: Sequence[TouchRow]) -> Figure:
    """One panel a touch: level above threshold over the plate, fingers and driven ERAs."""
    columns = min(3, len(rows))
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(4.4 * columns + 0.8, 4.1 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, row in zip(panels, rows, strict=False):
        if row.played is not None:
            _draw_touch(axes, table, row, row.played)
    draw_level_scale(figure, panels, shrink=0.7)
    return figure


def _contrast(row: TouchRow) -> float:
    contrast = row.played.measured_contrast_db if row.played else None
    return -math.inf if contrast is None else contrast


def _draw_touch(axes: Axes, table: LocalizationTable, row: TouchRow, played: PlayedPattern) -> None:
    draw_levels(axes, table, played.pattern.excitation)
    draw_fingertip(axes, row.target, felt=True, level_db_sl=played.levels.get(row.target_id))
    for id, place in row.quiet.items():
        draw_fingertip(axes, place, felt=False, level_db_sl=played.levels.get(id))
    title = "one finger alone"
    if played.measured_contrast_db is not None:
        title = f"contrast {played.measured_contrast_db:.1f} dB measured"
    axes.set_title(title, fontsize=11, pad=20)
