"""Pictures of a rig's page, as SVG elements that follow the colors and the font of the page."""

import re
from collections.abc import Sequence
from html import escape
from io import StringIO
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from era_haptics.lab.rig_page.rig_report import RigReport
from model.answer.answer import OWN_CONTRAST_DB
from model.arrays import FloatArray, Point, lattice
from model.figures.contents import contents_figure
from model.figures.plate_maps import raster
from model.figures.template import MM_PER_INCH, GluedPart, Template
from model.finger import FELT_DB_SL, FINGERTIP_RADIUS, STRONG_DB_SL, decibels
from model.rig.rig import Uncertainty

_INK, _FAINT, _ACCENT = "#1b2530", "#6b7885", "#b3400e"
_FILL, _BAND, _CURVE = "#eaf0f5", "#c5dde6", "#1b6b85"
_SKIN, _RIM = "#f3c9a9", "#8a5a33"

_VARIABLES = {
    _INK: "var(--ink)",
    _FAINT: "var(--faint)",
    _ACCENT: "var(--accent)",
    _FILL: "var(--fill)",
    _BAND: "var(--band)",
    _CURVE: "var(--curve)",
}
"""Variables of the page's style sheet, by the color that stands for each in a figure."""

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text can be searched
    "svg.hashsalt": "era",
    "savefig.transparent": True,
    "font.size": 8,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _FAINT,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
}
"""Settings of matplotlib while the figures of a page are drawn."""

_WIDTH = 7.3  # in; printed width of a page
_HIGHEST = 4.3  # in; leaves room for the drawing on the same page
_SCALES = (2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40, 50)
_DRAWING = 3.7, 3.0  # in; space for a plate
_MARGINS = 0.42, 0.6, 0.42, 0.1  # in; left, right, below, above a plate
_MARKS = {"solid": ("s", _ACCENT), "dashed": ("o", _CURVE), "dotted": ("x", _FAINT)}
"""Marker and color of a part by its line in a template: driven, passive, sensor."""

_CONTRAST_BANDS = ListedColormap(
    ["#f7f4ec", "#e9ead3", "#c9dfbb", "#8cc79b", "#3fa08a", "#1c6f7d", "#123f63"]
)
_BAND_EDGES = np.arange(0, 31, 6)  # dB
_MODES = 6


def svg_of(figure: Figure, words: str) -> str:
    """Return a figure as an element of HTML; words: its description for screen readers."""
    stream = StringIO()
    figure.savefig(stream, format="svg", dpi=150, metadata={"Date": None})
    _, start, drawing = stream.getvalue().partition("<svg ")
    drawing = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", drawing, flags=re.DOTALL)
    drawing = re.sub(r'<g id="\w+"', "<g", drawing)  # the same in every figure
    for color, variable in _VARIABLES.items():
        drawing = drawing.replace(color, variable)
    return f'{start}role="img" aria-label="{escape(words)}" {drawing}'


def drawing_picture(report: RigReport) -> Figure:
    """Draw plate, parts, center of mass and a fingertip to a round scale; axes in millimeters."""
    template = Template(report.rig, report.sensors, is_below=False)
    length, width = template.board
    smallest = max(length / _DRAWING[0], width / _DRAWING[1]) / MM_PER_INCH
    scale = next((scale for scale in _SCALES if scale >= smallest), round(smallest + 0.5))
    unit = scale * MM_PER_INCH  # mm of the plate for an inch of paper
    left, right, below, above = (margin * unit for margin in _MARGINS)
    figure = Figure(figsize=((left + length + right) / unit, (below + width + above) / unit))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-left, length + right), ylim=(-below, width + above))
    axes.set_axis_off()
    _draw_outline(axes, report, (length, width))
    for part in template.parts():
        _draw_part(axes, part, (length, width), 72 * part.radius / unit)
    x, y = (1000 * position for position in report.center)
    axes.plot(x, y, "P", ms=7, c=_INK, mec=_FILL)
    tip = 1000 * FINGERTIP_RADIUS
    finger = length + 0.35 * unit, tip
    axes.add_patch(Circle(finger, tip, fc=_SKIN, ec=_RIM, lw=0.8))
    _write(axes, finger, "fingertip", _FAINT, (0, -72 * tip / unit - 7))
    _draw_dimension(axes, (0, -0.25 * unit), (length, -0.25 * unit), f"{length:g} mm")
    _draw_dimension(axes, (-0.25 * unit, 0), (-0.25 * unit, width), f"{width:g} mm")
    _write(axes, (finger[0], -0.25 * unit), f"1 : {scale}", _INK, (0, 0))
    return figure


def _draw_outline(axes: Axes, report: RigReport, board: Point) -> None:
    """Draw the outline of a plate, or the rings of a surface [mm]."""
    surface = report.rig.plate.surface
    if surface is None or not surface.outline:
        axes.add_patch(Rectangle((0, 0), *board, fc=_FILL, ec=_INK, lw=1))
        return
    for ring in surface.outline:
        axes.fill(*(1000 * np.array(ring)).T, fc=_FILL, ec=_INK, lw=1)


def _draw_part(axes: Axes, part: GluedPart, board: Point, radius: float) -> None:
    """Draw a part of a board [mm] with its contact disc, and its name toward the middle.

    radius [pt]: of the disc on paper.
    """
    marker, color = _MARKS[part.style]
    axes.add_patch(Circle(part.at, part.radius, fc="none", ec=color, lw=0.8))
    axes.plot(*part.at, marker, ms=4.5, c=color, mfc=color if marker == "s" else _FILL)
    is_high = part.at[1] > board[1] / 2
    is_right = part.at[0] > board[0] / 2
    aside = 0
    if min(part.at[0], board[0] - part.at[0]) < 0.05 * board[0]:
        aside = -7 if is_right else 7
    away = max(10, radius + 6)
    _write(axes, part.at, part.name, color, (aside, -away if is_high else away))


def _write(axes: Axes, at: Point, words: str, color: str, offset: Point) -> None:
    """Write words in the middle of a position that is offset [pt]."""
    axes.annotate(
        words,
        at,
        offset,
        textcoords="offset points",
        ha="center",
        va="center",
        color=color,
        annotation_clip=False,
    )


def _draw_dimension(axes: Axes, start: Point, end: Point, words: str) -> None:
    """Draw a dimension line with arrows and a length."""
    arrows = {"arrowstyle": "<|-|>", "lw": 0.7, "color": _FAINT, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", start, end, arrowprops=arrows)
    middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    is_upright = start[0] == end[0]
    axes.annotate(
        words,
        middle,
        (-7, 0) if is_upright else (0, -7),
        textcoords="offset points",
        rotation=90 if is_upright else 0,
        ha="center",
        va="center",
    )


def fingers_picture(report: RigReport) -> Figure | None:
    """Draw three fingers with three vibrations and their promises; None if there is no answer."""
    if report.answer is None:
        return None
    answer = report.answer
    figure = contents_figure(report.table, answer.layers, answer.promised_fingers)
    figure.set_figheight(min(figure.get_figheight(), _HIGHEST))
    return figure


def maps_picture(report: RigReport) -> Figure:
    """Draw the contrast promised to a finger anywhere, in bands of 6 dB, with the other fingers."""
    length, width = 1000 * report.rig.plate.length, 1000 * report.rig.plate.width
    height = min(max(3.0 * width / length + 0.7, 1.6), 3.4)
    figure = Figure(figsize=(_WIDTH, height), layout="compressed")
    panels = figure.subplots(1, len(report.maps))
    for axes, contrast_map in zip(panels, report.maps, strict=True):
        # No contrast under another finger, nor where the level is not reached.
        contrasts = np.nan_to_num(contrast_map.promised_db[report.table.drive_mode])
        x, y = (1000 * positions for positions in (contrast_map.x, contrast_map.y))
        to_edges = np.pad(contrasts, 1, mode="edge")
        x, y = np.concatenate([[0], x, [length]]), np.concatenate([[0], y, [width]])
        bands = axes.contourf(x, y, to_edges, _BAND_EDGES, cmap=_CONTRAST_BANDS, extend="both")
        axes.contour(x, y, to_edges, [OWN_CONTRAST_DB], colors=_INK, linewidths=0.9)
        _draw_plate(axes, report)
        for at in contrast_map.quiet:
            position = 1000 * at[0], 1000 * at[1]
            axes.add_patch(Circle(position, 1000 * FINGERTIP_RADIUS, fc=_SKIN, ec=_RIM))
        share = 100 * (contrasts >= OWN_CONTRAST_DB).mean()
        others = "one finger" if len(contrast_map.quiet) == 1 else "two fingers"
        axes.set_title(f"against {others}:\nown on {share:.0f} %")
    figure.colorbar(bands, ax=list(panels), aspect=30, pad=0.02, label="promised contrast / dB")
    return figure


def _draw_plate(axes: Axes, report: RigReport) -> None:
    """Draw a plate's outline and its ERAs in axes of millimeters without ticks."""
    length, width = 1000 * report.rig.plate.length, 1000 * report.rig.plate.width
    axes.set(xlim=(0, length), ylim=(0, width), aspect="equal")
    axes.set_axis_off()
    axes.add_patch(Rectangle((0, 0), length, width, fill=False, ec=_INK, lw=0.8, clip_on=False))
    for era in report.rig.eras:
        position = 1000 * era.x, 1000 * era.y
        axes.plot(*position, "s", ms=3.5, c="white", mec="black", mew=0.8, clip_on=False)


def levels_picture(report: RigReport, levels: FloatArray) -> Figure:
    """Draw reachable levels (f, p) [dB SL] at positions over frequency, with limits and modes."""
    low, high = report.rig.limits.frequency_min, report.rig.limits.frequency_max
    start = max(low - 0.12 * (high - low), 0)
    end = high + 0.16 * (high - low)  # leaves room for the names of the curves
    figure = Figure(figsize=(_WIDTH, 2.4), layout="constrained")
    axes = figure.subplots()
    _draw_levels(axes, report.table.frequencies, levels)
    for left, right in ((start, low), (high, end)):
        axes.axvspan(left, right, fc=_FILL, ec="none", zorder=0)
    for level, words in ((FELT_DB_SL, "clearly felt"), (STRONG_DB_SL, "strong")):
        axes.axhline(level, color=_ACCENT, lw=0.9, ls=(0, (4, 3)))
        axes.text(start, level + 1.5, f" {words}: {level:g}", color=_ACCENT)
    bottom = min(0.0, float(levels.min()))
    natural = report.modes.natural_frequencies
    natural = natural[natural >= start]
    axes.plot(natural, np.full(len(natural), bottom), "|", c=_INK, ms=9, clip_on=False)
    axes.set(xlim=(start, end), xlabel="frequency / Hz", ylabel="level / dB SL")
    axes.set_ylim(bottom=bottom)
    return figure


def _draw_levels(axes: Axes, frequencies: FloatArray, levels: FloatArray) -> None:
    """Draw levels (f, p) [dB SL] over frequency at the best, the median and the worst position."""
    worst, median, best = np.percentile(levels, [0, 50, 100], axis=1)
    axes.fill_between(frequencies, worst, best, color=_BAND, lw=0)
    curves = ((best, 0.6, 4, "best"), (median, 1.8, 0, "median"), (worst, 0.9, -4, "worst"))
    for curve, line_width, rise, words in curves:
        axes.plot(frequencies, curve, color=_CURVE, lw=line_width)
        axes.annotate(
            f"{words} position",
            (frequencies[-1], curve[-1]),
            (4, rise),
            textcoords="offset points",
            va="center",
            color=_CURVE,
        )


def reachable_levels(report: RigReport) -> FloatArray:
    """Return the levels (f, p) [dB SL] of all ERAs at the rig's limit at the cells' centers."""
    limit = decibels(report.rig.limits.level)
    return report.table.reachable_db_sl(report.table.cell_centers) + limit


def costs_picture(report: RigReport) -> Figure:
    """Draw the contrast that each tolerance costs [dB], the most expensive on top."""
    figure = Figure(figsize=(4.0, 0.21 * len(report.costs) + 0.2), layout="constrained")
    axes = figure.subplots()
    names = [tolerance_words(key, report.rig.uncertainty) for key in report.costs]
    costs = [max(cost, 0.0) for cost in report.costs.values()]
    bars = axes.barh(names, costs, color=[_ACCENT, *[_CURVE] * (len(costs) - 1)], height=0.62)
    axes.bar_label(bars, fmt="%.1f dB", padding=3)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.25 * max([*costs, 0.1]))
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(length=0, labelbottom=False)
    return figure


def tolerance_words(key: str, uncertainty: Uncertainty) -> str:
    """Return the name of a tolerance with its value, such as `thickness 2 %`."""
    name = key.removesuffix("_deg").replace("_", " ")
    terms = str(uncertainty).split(", ")
    return next((term for term in terms if term.startswith(name)), name)


def modes_picture(report: RigReport) -> Figure:
    """Draw the shapes of the first six modes: red and full lines up, blue and dashed lines down."""
    plate, modes = report.rig.plate, report.modes
    nx, ny = raster(plate)
    x, y = np.linspace(0, plate.length, nx), np.linspace(0, plate.width, ny)
    shapes = modes.at(lattice(x, y)).T.reshape(-1, ny, nx)[:_MODES]
    height = min(2 * (2.3 * plate.width / plate.length + 0.3), 5.0)
    figure = Figure(figsize=(_WIDTH, height), layout="compressed")
    panels: Sequence[Axes] = [*figure.subplots(2, 3).flat]
    for axes in panels:
        axes.set_axis_off()
    for number, (axes, shape) in enumerate(zip(panels, shapes, strict=False)):
        peak = np.abs(shape).max()
        extent = (0.0, 1000 * plate.length, 0.0, 1000 * plate.width)
        axes.imshow(
            shape,
            origin="lower",
            extent=extent,
            cmap="RdBu_r",
            vmin=-peak,
            vmax=peak,
            interpolation="none",
        )
        lines = [share * peak for share in (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75)]
        axes.contour(shape, lines, extent=extent, colors="black", linewidths=0.5)
        _draw_plate(axes, report)
        axes.set_title(f"{modes.natural_frequencies[number]:.1f} Hz")
    return figure
