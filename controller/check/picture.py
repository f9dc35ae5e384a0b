"""Picture of a checked layout: level, frequency and contrast of every touch over the plate."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline

from controller.check.layout_check import CheckedEffect
from controller.check.layout_together import Together, matrix_of
from controller.check.simulated_touch import Position, SimulatedTouch
from controller.effects.layout import SurfaceLayout
from model.answer.answer import OWN_CONTRAST_DB
from model.arrays import FloatArray
from model.figures import draw_eras, label_plate
from model.table.table import LocalizationTable

_LEVEL_EDGES = [-12.0, -6.0, -4.0, -2.0, 2.0, 4.0, 6.0, 12.0]  # dB
_MAX_CONTRAST = 30.0  # dB
_NO_PROMISE = "#bbbbbb"
_MAX_JOINED = 12  # fingers at once that are drawn joined, of each count
_BRIGHT = 0.6  # of a scale of colours, from which black is read better than white
_SIZES = (90.0, 36.0, 10.0)  # of marks; those of a region's further effects lie within


def check_figure(
    layout: SurfaceLayout,
    table: LocalizationTable,
    checked: Sequence[CheckedEffect],
    together: Sequence[Together] = (),
) -> Figure:
    """Draw three panels, with one mark for each touch; crosses where nothing is felt.

    Level: what is felt less what is promised, the worse of alone and beside a resting finger;
    frequency; and how far a resting finger feels less, as promised. Below, fingers in two
    and in three regions at once, at their worst places, and what the worst one is promised.
    """
    ratio = table.plate.width / table.plate.length
    rows = 2 if together else 1
    figure = Figure(figsize=(18.0, rows * (5.0 * ratio + 1.6)), layout="constrained")
    panels: list[tuple[str, Callable[[CheckedEffect, SimulatedTouch], float | None]]] = [
        ("felt minus promised / dB", _off_level),
        ("frequency / Hz", _frequency),
        ("above a resting second finger\npromised / dB", _contrast),
    ]
    low, high = float(table.frequencies[0]), float(table.frequencies[-1])
    scales: list[tuple[Normalize, str]] = [
        (BoundaryNorm(_LEVEL_EDGES, 256, extend="both"), "RdBu_r"),
        (LogNorm(low, max(high, 1.01 * low)), "viridis"),
        (Normalize(0.0, _MAX_CONTRAST), "viridis"),
    ]
    subplots = figure.subplots(rows, len(panels), squeeze=False)
    if together:
        _draw_together(figure, [*subplots[1]], layout, table, together)
    for axes, (label, value), (norm, colors) in zip(subplots[0], panels, scales, strict=True):
        _draw_layout(axes, layout, table)
        _draw_touches(axes, checked, value, norm, colors)
        bar = figure.colorbar(ScalarMappable(norm, colors), ax=axes, label=label, shrink=0.85)
        if isinstance(norm, LogNorm):
            ticks = [each for each in (40, 60, 100, 150, 250, 400, 600) if low <= each <= high]
            bar.set_ticks(ticks, labels=[str(each) for each in ticks], minor=False)
            bar.minorticks_off()
    return figure


def _draw_together(
    figure: Figure,
    panels: Sequence[Axes],
    layout: SurfaceLayout,
    table: LocalizationTable,
    together: Sequence[Together],
) -> None:
    """Draw fingers at once at their worst places, joined by lines, the worst on top; the matrix."""
    colors, norm = colormaps["viridis"], Normalize(0.0, 2 * OWN_CONTRAST_DB)
    for axes, count in zip(panels, (2, 3), strict=False):
        _draw_layout(axes, layout, table)
        of_count = [each for each in together if len(each.regions) == count]
        shown = sorted(of_count, key=lambda each: each.worst_db)[:_MAX_JOINED]
        title = f"fingers in {count} regions at once, at their worst places"
        if len(shown) < len(of_count):
            title += f": the worst {len(shown)} of {len(of_count)}"
        axes.set_title(title, fontsize=9)
        for each in reversed(shown):
            x, y = _columns([*each.at, each.at[0]])
            axes.plot(x, y, "o-", color=colors(norm(each.worst_db)), lw=1.2, ms=4)
    axes, (names, promised) = panels[-1], matrix_of(together)
    axes.imshow(promised, cmap=colors, norm=norm)
    for (row, column), value in np.ndenumerate(promised):
        if not math.isnan(value):
            ink = "black" if norm(value) > _BRIGHT else "white"
            axes.text(column, row, f"{value:.0f}", ha="center", va="center", color=ink, fontsize=8)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_title("two at once below the diagonal, three above", fontsize=9)
    label = "promised contrast of the worst finger / dB"
    figure.colorbar(ScalarMappable(norm, colors), ax=axes, label=label, shrink=0.85)


def _off_level(each: CheckedEffect, touch: SimulatedTouch) -> float | None:
    if touch.felt_db_sl is None or each.promised_db_sl is None:
        return None
    return touch.felt_db_sl - each.promised_db_sl


def _frequency(each: CheckedEffect, touch: SimulatedTouch) -> float | None:
    return touch.frequencies[0] if touch.frequencies else None


def _contrast(each: CheckedEffect, touch: SimulatedTouch) -> float | None:
    return touch.promised_contrast_db


def _draw_layout(axes: Axes, layout: SurfaceLayout, table: LocalizationTable) -> None:
    """Draw the plate, its ERAs, and the regions with their names."""
    length, width = 100 * table.plate.length, 100 * table.plate.width
    axes.add_patch(Outline([(0, 0), (length, 0), (length, width), (0, width)], fill=False))
    for region in layout.regions:
        corners = 100 * np.array(region.shape.corners())
        axes.add_patch(Outline(corners, facecolor="#f2f2f2", edgecolor="#555555", lw=1))
        _label_region(axes, region.name, corners)
    label_plate(axes)
    axes.set_xlim(-0.5, length + 0.5)
    axes.set_ylim(-0.5, width + 0.5)
    draw_eras(axes, table.eras, active=())


def _label_region(axes: Axes, name: str, corners: FloatArray) -> None:
    """Write the name above a region, or upright beside one that is much taller than wide."""
    sides = np.ptp(corners, axis=0)
    if sides[1] > 2 * sides[0]:
        right = corners[corners[:, 0] >= corners[:, 0].max() - 1e-6]
        axes.annotate(
            name,
            (right[0, 0], right[:, 1].mean()),
            xytext=(2, 0),
            textcoords="offset points",
            va="center",
            rotation=90,
            fontsize=8,
        )
        return
    top = corners[corners[:, 1] >= corners[:, 1].max() - 1e-6]
    axes.annotate(
        name,
        (top[:, 0].mean(), top[0, 1]),
        xytext=(0, 2),
        textcoords="offset points",
        ha="center",
        fontsize=8,
    )


def _draw_touches(
    axes: Axes,
    checked: Sequence[CheckedEffect],
    value: Callable[[CheckedEffect, SimulatedTouch], float | None],
    norm: Normalize,
    colors: str,
) -> None:
    """Draw the value of every touch that is farthest from zero or lowest in contrast."""
    drawn: dict[str, int] = {}
    for each in checked:
        size = _SIZES[min(drawn.get(each.region, 0), len(_SIZES) - 1)]
        drawn[each.region] = drawn.get(each.region, 0) + 1
        found: dict[Position, float | None] = {}
        for touch in each.touches:
            new, before = value(each, touch), found.get(touch.at)
            if before is None or (new is not None and abs(new) > abs(before)):
                found[touch.at] = new
        silent = {touch.at for touch in each.touches if touch.felt_db_sl is None}
        unpromised = [at for at, one in found.items() if one is None and at not in silent]
        felt = {at: one for at, one in found.items() if one is not None and at not in silent}
        mark = partial(axes.scatter, s=size, edgecolors="#555555", lw=0.5)
        axes.plot(*_columns(silent), "x", color="black", ms=6)
        mark(*_columns(unpromised), c=_NO_PROMISE)
        mark(*_columns(felt), c=[*felt.values()], cmap=colors, norm=norm)


def _columns(places: Iterable[Position]) -> FloatArray:
    """Return positions [m] as rows x and y [cm], (2, n)."""
    return 100 * np.array([*places], dtype=float).reshape(-1, 2).T
