"""The picture of a demonstration: the plate under some touches, and what each finger felt."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from controller.demo.rows import Place, PlayedPattern, TouchRow
from model.arrays import lattice
from model.figures import draw_eras
from model.fingertip import FINGERTIP_RADIUS
from model.perception import sensation_level
from model.table import LocalizationTable

PANELS = 6
SIDE = 121  # points along a side; nulls are narrow
COLORS = "magma"
LOWEST_DB_SL, HIGHEST_DB_SL = -10.0, 30.0


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
    scale = Normalize(LOWEST_DB_SL, HIGHEST_DB_SL)
    for axes, row in zip(panels, rows, strict=False):
        if row.played is not None:
            _draw_touch(axes, table, row, row.played, scale=scale)
    figure.colorbar(
        ScalarMappable(scale, COLORS),
        ax=list(panels),
        label="level above detection threshold / dB SL",
        extend="both",
        shrink=0.7,
    )
    return figure


def _contrast(row: TouchRow) -> float:
    contrast = row.played.measured_contrast_db if row.played else None
    return -math.inf if contrast is None else contrast


def _draw_touch(
    axes: Axes, table: LocalizationTable, row: TouchRow, played: PlayedPattern, *, scale: Normalize
) -> None:
    excitation = played.pattern.excitation
    x, y = (np.linspace(0, side, SIDE) for side in (table.plate.length, table.plate.width))
    points = lattice(x, y)
    level = sensation_level(*table.amplitudes(excitation, points)).reshape(SIDE, SIDE)
    axes.pcolormesh(100 * x, 100 * y, level, cmap=COLORS, shading="gouraud", norm=scale)
    axes.set_aspect("equal")
    draw_eras(axes, table.eras, active=excitation.keys())
    for era in table.eras:
        if tone := excitation.get(era.name):
            axes.annotate(
                f"{era.name} {tone.frequency:g} Hz",
                (100 * era.x, 100 * era.y),
                xytext=(0, 9 if era.y > table.plate.width / 2 else -16),
                textcoords="offset points",
                ha="left" if era.x < table.plate.length / 2 else "right",
                fontsize=9,
            )
    _draw_finger(axes, row.target, played.levels.get(row.target_id), felt=True)
    for id, place in row.quiet.items():
        _draw_finger(axes, place, played.levels.get(id), felt=False)
    title = "one finger alone"
    if played.measured_contrast_db is not None:
        title = f"contrast {played.measured_contrast_db:.1f} dB measured"
    axes.set_title(title, fontsize=11, pad=20)


def _draw_finger(axes: Axes, place: Place, level_db_sl: float | None, *, felt: bool) -> None:
    x, y = 100 * place[0], 100 * place[1]
    outline = [withStroke(linewidth=2.5, foreground="black", alpha=0.75)]
    color = "#6dff9c" if felt else "#9fdcff"
    axes.add_patch(
        Circle(
            (x, y),
            100 * FINGERTIP_RADIUS,
            fill=False,
            color=color,
            lw=2.4 if felt else 1.6,
            path_effects=outline,
        )
    )
    text = "felt" if felt else "quiet"
    if level_db_sl is not None:
        text += f"\n{round(level_db_sl)} dB SL"
    axes.annotate(
        text,
        (x, y),
        xytext=(0, -25 if y > 5 else 25),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=8.5,
        color=color,
        fontweight="bold" if felt else "normal",
        path_effects=outline,
    )
