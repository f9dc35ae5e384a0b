"""The picture of a demonstration: the plate and the fingers during some of the touches."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.demo.touch_row import TouchRow
from model.choice import ranked_by
from model.figures.table_pictures import draw_fingertip, draw_level_scale, draw_levels
from model.table.table import LocalizationTable

MAX_PANELS = 6


def choose_rows(rows: Sequence[TouchRow]) -> list[TouchRow]:
    """Choose the measured touches of highest contrast, evenly over the number of other fingers.

    One finger alone is shown at most once.
    """
    by_count: dict[int, list[TouchRow]] = {}
    for row in ranked_by(rows, _contrast):
        if row.measured_level_db_sl is not None:
            by_count.setdefault(len(row.quiet), []).append(row)
    chosen = by_count.pop(0, [])[:1]
    while by_count and len(chosen) < MAX_PANELS:
        for count in sorted(by_count):
            chosen.append(by_count[count].pop(0))
            if not by_count[count]:
                del by_count[count]
    return sorted(chosen[:MAX_PANELS], key=lambda row: len(row.quiet))


def touches_figure(table: LocalizationTable, rows: Sequence[TouchRow]) -> Figure:
    """Draw a panel per touch: level over the plate, fingers and driven ERAs."""
    columns = min(3, len(rows))
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(4.4 * columns + 0.8, 4.1 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, row in zip(panels, rows, strict=False):
        _draw_touch(axes, table, row)
    draw_level_scale(figure, panels, shrink=0.7)
    return figure


def _contrast(row: TouchRow) -> float:
    contrast = row.measured_felt_contrast_db
    return -math.inf if contrast is None else contrast


def _draw_touch(axes: Axes, table: LocalizationTable, row: TouchRow) -> None:
    if row.pattern is not None:
        draw_levels(axes, table, row.pattern.excitation)
    level = row.levels_db_sl.get(row.target_id)
    draw_fingertip(axes, row.targets_m[0], felt=True, level_db_sl=level)
    for id, position in row.quiet.items():
        draw_fingertip(axes, position, felt=False, level_db_sl=row.levels_db_sl.get(id))
    contrast, promised = row.measured_felt_contrast_db, row.robust_felt_contrast_db
    title = "one finger alone" if contrast is None else f"felt contrast {contrast:.1f} dB"
    if promised is not None:
        title += f", promised {promised:.1f}"
    axes.set_title(title, fontsize=11, pad=20)
