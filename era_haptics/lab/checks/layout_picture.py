"""Pictures of a checked layout: touches of each region, and simultaneous fingers."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline
from matplotlib.patheffects import withStroke

from controller.effects.layout import SurfaceLayout
from era_haptics.lab.checks.checked_effect import CheckedEffect
from era_haptics.lab.checks.joint_touches import JointTouch, matrix_of
from era_haptics.lab.checks.touch_simulator import SimulatedTouch
from model.answer.answer import OWN_CONTRAST_DB
from model.arrays import FloatArray, Point
from model.figures.style import PAGE_WIDTH, SMALL_TEXT, TITLE_TEXT, draw_eras, label_plate
from model.table.table import LocalizationTable

_LEVEL_TOLERANCE_DB = 2.0
_LEVEL_EDGES = [-12.0, -6.0, -4.0, -2.0, 2.0, 4.0, 6.0, 12.0]  # dB
_MAX_CONTRAST = 30.0  # dB
_FREQUENCY_TICKS = (40, 60, 100, 150, 250, 400, 600)  # Hz
_NO_PROMISE = "#bbbbbb"
_CONTRAST_COLORS = colormaps["viridis"]
_MAX_JOINED = 12  # simultaneous fingers drawn connected, for each count
_BRIGHT = 0.6  # position on a color scale above which black text is readable
_NAME_HEIGHT = 1.4  # cm
_SIZES = (44.0, 16.0, 5.0)  # of marks; smaller marks are a region's further effects


@dataclass(frozen=True)
class _TouchPanel:
    """A panel with one mark for each touch."""

    title: str
    label: str
    """Of the color bar."""
    value: Callable[[CheckedEffect, SimulatedTouch], float | None]
    """Value shown by a mark's color; None without a value."""
    norm: Normalize
    colors: str
    marker: Callable[[float], str] = lambda _: "o"
    """Shape of a value's mark."""

    def color(self, value: float) -> tuple[float, float, float, float]:
        """Return the color of a value on the panel's scale."""
        return colormaps[self.colors](self.norm(value))


def _level_marker(difference_db: float) -> str:
    """Return a triangle that points up above the promised level and down below it."""
    if abs(difference_db) <= _LEVEL_TOLERANCE_DB:
        return "o"
    return "^" if difference_db > 0 else "v"


def _touch_panels(frequencies: FloatArray) -> list[_TouchPanel]:
    """Return the panels for a table with these frequencies [Hz]."""
    low, high = float(frequencies[0]), float(frequencies[-1])
    return [
        _TouchPanel(
            "level: felt minus promised",
            "felt minus promised level / dB\n(triangles: outside ±2 dB)",
            _level_difference,
            BoundaryNorm(_LEVEL_EDGES, 256, extend="both"),
            "RdBu_r",
            _level_marker,
        ),
        _TouchPanel(
            "frequency",
            "frequency / Hz",
            lambda _, touch: touch.frequencies[0] if touch.frequencies else None,
            LogNorm(low, max(high, 1.01 * low)),
            "viridis",
        ),
        _TouchPanel(
            "contrast with a resting second finger",
            "promised contrast / dB",
            lambda _, touch: touch.promised_contrast_db,
            Normalize(0.0, _MAX_CONTRAST),
            "viridis",
        ),
    ]


def check_figure(
    layout: SurfaceLayout,
    table: LocalizationTable,
    checked: Sequence[CheckedEffect],
    together: Sequence[JointTouch] = (),
) -> Figure:
    """Draw three panels with one mark per touch, and a cross for each silent position.

    The panels show the felt minus the promised level (the worse of alone and with a resting
    finger), the frequency, and the promised contrast with the resting finger. Then simultaneous
    fingers in two and three regions at their worst positions, and the promised contrast of the
    worst finger.
    """
    panels = _touch_panels(table.frequencies)
    rows = 3 if together else 2
    panel_height = (PAGE_WIDTH / 2 - 1.1) * table.plate.width / table.plate.length + 0.8
    figure = Figure(figsize=(PAGE_WIDTH, rows * panel_height + 0.3), layout="constrained")
    subplots = figure.subplots(rows, 2).ravel()
    for axes, panel in zip(subplots, panels, strict=False):
        _draw_touch_panel(figure, axes, panel, layout, table, checked)
    if together:
        _draw_together(figure, [*subplots[len(panels) :]], layout, table, together)
    else:
        subplots[-1].set_axis_off()
    figure.supxlabel(
        "Crosses: nothing is felt. Gray marks: no promise. Small marks: a region's other effects. "
        "Squares at the edges: ERAs.",
        fontsize=SMALL_TEXT,
        wrap=True,
    )
    return figure


def _draw_touch_panel(
    figure: Figure,
    axes: Axes,
    panel: _TouchPanel,
    layout: SurfaceLayout,
    table: LocalizationTable,
    checked: Sequence[CheckedEffect],
) -> None:
    """Draw the layout, the values of all touches, and their scale."""
    axes.set_title(panel.title, fontsize=TITLE_TEXT)
    _draw_layout(axes, layout, table)
    _draw_touches(axes, checked, panel)
    scale = ScalarMappable(panel.norm, panel.colors)
    bar = figure.colorbar(scale, ax=axes, shrink=0.85)
    bar.set_label(panel.label, fontsize=SMALL_TEXT)
    if isinstance(panel.norm, LogNorm):
        low, high = panel.norm.vmin or 0.0, panel.norm.vmax or 0.0
        ticks = [hertz for hertz in _FREQUENCY_TICKS if low <= hertz <= high]
        bar.set_ticks(ticks, labels=[str(hertz) for hertz in ticks], minor=False)
        bar.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL_TEXT)


def _draw_together(
    figure: Figure,
    panels: Sequence[Axes],
    layout: SurfaceLayout,
    table: LocalizationTable,
    together: Sequence[JointTouch],
) -> None:
    """Draw simultaneous fingers at their worst positions, connected by lines, and the matrix."""
    norm = Normalize(0.0, 2 * OWN_CONTRAST_DB)
    for axes, count in zip(panels, (2, 3), strict=False):
        _draw_layout(axes, layout, table)
        of_count = [touch for touch in together if len(touch.regions) == count]
        _draw_joint_touches(axes, of_count, norm, f"worst positions of fingers in {count} regions")
    axes = panels[-1]
    _draw_matrix(axes, together, norm)
    bar = figure.colorbar(ScalarMappable(norm, _CONTRAST_COLORS), ax=axes, shrink=0.85)
    label = "promised contrast of the worst finger / dB\n(also colors the lines)"
    bar.set_label(label, fontsize=SMALL_TEXT)
    bar.ax.tick_params(labelsize=SMALL_TEXT)


def _draw_joint_touches(
    axes: Axes, touches: Sequence[JointTouch], norm: Normalize, title: str
) -> None:
    """Draw the joint touches with the lowest contrasts."""
    worst = sorted(touches, key=lambda touch: touch.worst_db)[:_MAX_JOINED]
    if len(worst) < len(touches):
        title += f"\n(the worst {len(worst)} of {len(touches)})"
    axes.set_title(title, fontsize=TITLE_TEXT)
    for touch in reversed(worst):
        x, y = _columns([*touch.at, touch.at[0]])
        color = _CONTRAST_COLORS(norm(touch.worst_db))
        axes.plot(x, y, "o-", color=color, lw=1.2, ms=4)


def _draw_matrix(axes: Axes, together: Sequence[JointTouch], norm: Normalize) -> None:
    """Draw the promised contrasts of all pairs and triples of regions."""
    names, promised = matrix_of(together)
    axes.imshow(promised, cmap=_CONTRAST_COLORS, norm=norm)
    for (row, column), value in np.ndenumerate(promised):
        if not math.isnan(value):
            ink = "black" if norm(value) > _BRIGHT else "white"
            axes.text(column, row, f"{value:.0f}", ha="center", va="center", color=ink, fontsize=8)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=SMALL_TEXT)
    axes.set_yticks(range(len(names)), names, fontsize=SMALL_TEXT)
    axes.set_title("pairs below the diagonal, triples above", fontsize=TITLE_TEXT)


def _level_difference(effect: CheckedEffect, touch: SimulatedTouch) -> float | None:
    if touch.felt_db_sl is None or effect.promised_db_sl is None:
        return None
    return touch.felt_db_sl - effect.promised_db_sl


def _draw_layout(axes: Axes, layout: SurfaceLayout, table: LocalizationTable) -> None:
    """Draw the plate, its ERAs, and the regions with their names."""
    length, width = 100 * table.plate.length, 100 * table.plate.width
    axes.add_patch(Outline([(0, 0), (length, 0), (length, width), (0, width)], fill=False))
    axes.set_xlim(-0.5, length + 0.5)
    axes.set_ylim(-0.5, width + 0.5)
    for region in layout.regions:
        corners = 100 * np.array(region.shape.corners())
        axes.add_patch(Outline(corners, facecolor="#f2f2f2", edgecolor="#555555", lw=1))
        _label_region(axes, region.name, corners)
    label_plate(axes)
    draw_eras(axes, table.eras, active=(), size=6)


def _label_region(axes: Axes, name: str, corners: FloatArray) -> None:
    """Write the name above a region, or below it if there is no room on the plate.

    The name of a region that is much taller than wide is rotated and next to it.
    """
    x, y = corners.T
    length, width = np.ptp(corners, axis=0)
    is_tall = width > 2 * length
    has_room_above = y.max() + _NAME_HEIGHT <= axes.get_ylim()[1]
    if is_tall:
        on_edge = np.isclose(x, x.max(), atol=1e-6)
        offset, horizontal, vertical = (2, 0), "left", "center"
    elif has_room_above:
        on_edge = np.isclose(y, y.max(), atol=1e-6)
        offset, horizontal, vertical = (0, 2), "center", "baseline"
    else:
        on_edge = np.isclose(y, y.min(), atol=1e-6)
        offset, horizontal, vertical = (0, -2), "center", "top"
    axes.annotate(
        name,
        corners[on_edge].mean(axis=0),
        xytext=offset,
        textcoords="offset points",
        ha=horizontal,
        va=vertical,
        rotation=90 if is_tall else 0,
        fontsize=SMALL_TEXT,
        path_effects=[withStroke(linewidth=2, foreground="white")],
        zorder=3,
    )


def _draw_touches(axes: Axes, checked: Sequence[CheckedEffect], panel: _TouchPanel) -> None:
    """Draw for every touch the value farthest from zero, or the lowest contrast."""
    drawn: dict[str, int] = {}  # effects per region
    for effect in checked:
        number = drawn.get(effect.region, 0)
        drawn[effect.region] = number + 1
        silent = {touch.at for touch in effect.touches if touch.felt_db_sl is None}
        axes.plot(*_columns(silent), "x", color="black", ms=5)
        size = _SIZES[min(number, len(_SIZES) - 1)]
        for at, value in _extreme_values(effect, panel).items():
            if at in silent:
                continue
            x, y = 100 * at[0], 100 * at[1]
            color = _NO_PROMISE if value is None else panel.color(value)
            marker = "o" if value is None else panel.marker(value)
            axes.scatter(
                x, y, size, marker=marker, facecolors=[color], edgecolors="#555555", lw=0.5
            )


def _extreme_values(effect: CheckedEffect, panel: _TouchPanel) -> dict[Point, float | None]:
    """Return the value farthest from zero at each position; None without a value."""
    values: dict[Point, float | None] = {}
    for touch in effect.touches:
        value = panel.value(effect, touch)
        extreme = values.get(touch.at)
        if extreme is None or (value is not None and abs(value) > abs(extreme)):
            values[touch.at] = value
    return values


def _columns(positions: Iterable[Point]) -> FloatArray:
    """Return positions [m] as rows x and y [cm], (2, n)."""
    return 100 * np.array([*positions], dtype=float).reshape(-1, 2).T
