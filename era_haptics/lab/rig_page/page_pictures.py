"""Pictures of a rig's page, except for the drawing of its plate."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from era_haptics.lab.rig_page.page_style import ACCENT, BAND, CURVE, FILL, INK, SKIN, SKIN_EDGE
from era_haptics.lab.rig_page.rig_report import RigReport
from model.answer.answer import OWN_CONTRAST_DB
from model.arrays import FloatArray, lattice
from model.figures.contents import contents_figure
from model.figures.plate_maps import raster
from model.finger import FELT_DB_SL, FINGERTIP_RADIUS, STRONG_DB_SL, decibels
from model.rig.rig import Uncertainty

_WIDTH = 7.3  # in; printed width of a page
_HIGHEST = 4.3  # in; leaves room for the drawing on the same page
_CONTRAST_BANDS = ListedColormap(
    ["#f7f4ec", "#e9ead3", "#c9dfbb", "#8cc79b", "#3fa08a", "#1c6f7d", "#123f63"]
)
_BAND_EDGES = np.arange(0, 31, 6)  # dB
_MODES = 6


def fingers_picture(report: RigReport) -> Figure | None:
    """Draw three fingers with three vibrations and their promises; None if there is no answer."""
    if report.answer is None:
        return None
    answer = report.answer
    figure = contents_figure(
        report.table, answer.layers, answer.promised_fingers, are_promised=True
    )
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
        axes.contour(x, y, to_edges, [OWN_CONTRAST_DB], colors=INK, linewidths=0.9)
        _draw_plate(axes, report)
        for at in contrast_map.quiet:
            position = 1000 * at[0], 1000 * at[1]
            axes.add_patch(Circle(position, 1000 * FINGERTIP_RADIUS, fc=SKIN, ec=SKIN_EDGE))
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
    axes.add_patch(Rectangle((0, 0), length, width, fill=False, ec=INK, lw=0.8, clip_on=False))
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
        axes.axvspan(left, right, fc=FILL, ec="none", zorder=0)
    for level, words in ((FELT_DB_SL, "clearly felt"), (STRONG_DB_SL, "strong")):
        axes.axhline(level, color=ACCENT, lw=0.9, ls=(0, (4, 3)))
        axes.text(start, level + 1.5, f" {words}: {level:g}", color=ACCENT)
    bottom = min(0.0, float(levels.min()))
    natural = report.modes.natural_frequencies
    natural = natural[natural >= start]
    axes.plot(natural, np.full(len(natural), bottom), "|", c=INK, ms=9, clip_on=False)
    axes.set(xlim=(start, end), xlabel="frequency / Hz", ylabel="level / dB SL")
    axes.set_ylim(bottom=bottom)
    return figure


def _draw_levels(axes: Axes, frequencies: FloatArray, levels: FloatArray) -> None:
    """Draw levels (f, p) [dB SL] over frequency at the best, the median and the worst position."""
    worst, median, best = np.percentile(levels, [0, 50, 100], axis=1)
    axes.fill_between(frequencies, worst, best, color=BAND, lw=0)
    curves = ((best, 0.6, 4, "best"), (median, 1.8, 0, "median"), (worst, 0.9, -4, "worst"))
    for curve, line_width, rise, words in curves:
        axes.plot(frequencies, curve, color=CURVE, lw=line_width)
        axes.annotate(
            f"{words} position",
            (frequencies[-1], curve[-1]),
            (4, rise),
            textcoords="offset points",
            va="center",
            color=CURVE,
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
    bars = axes.barh(names, costs, color=[ACCENT, *[CURVE] * (len(costs) - 1)], height=0.62)
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
