"""The picture of several contents: where each is felt, in a colour of its own, and all together."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from controller.demo.touch_row import FingerRow, TouchRow
from model.arrays import FloatArray, lattice
from model.figures.drawing import label_plate, raster
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import sensation_level
from model.table.pattern import Pattern
from model.table.request import OWN_CONTRAST_DB
from model.table.table import LocalizationTable

COLORS = ("#35e07a", "#4f9dff", "#ffa62b", "#ff5fa2")
"""Of contents, in order."""

BRIGHTEST_DB_SL = 30.0
"""Level from which a colour is at its brightest; the threshold of feeling is black."""

_GREY = 0.62


def contents_figure(table: LocalizationTable, row: TouchRow) -> Figure:
    """Draw a panel with all contents of a touch, and one for each, as the table predicts them.

    Beside every finger is what was measured there.
    """
    count = len(row.contents)
    colors = {_frequency(each): COLORS[at % len(COLORS)] for at, each in enumerate(row.contents)}
    levels = {_frequency(each): _levels(table, each) for each in row.contents}
    width = 8.4 * (1 + 1 / count)
    height = 8.4 * table.plate.width / table.plate.length + 1.0
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplot_mosaic(
        [["all", f"{number}"] for number in range(count)], width_ratios=[count, 1]
    )
    _draw(panels["all"], table, levels, colors)
    for finger in row.fingers:
        _draw_finger(panels["all"], finger, colors)
        _label_finger(panels["all"], finger, colors)
    panels["all"].set_title(
        "Coloured where a finger feels its own content, grey where contents mix", fontsize=13
    )
    for number, (frequency, level) in enumerate(levels.items()):
        axes = panels[f"{number}"]
        _draw(axes, table, {frequency: level}, colors)
        for finger in row.fingers:
            _draw_finger(axes, finger, colors)
        axes.set_title(f"{frequency:g} Hz alone", fontsize=11)
        axes.set_axis_off()
    return figure


def _frequency(content: Pattern) -> float:
    """The frequency [Hz] of a content, which has one where there are several."""
    return next(iter(content.excitation.values())).frequency


def _levels(table: LocalizationTable, content: Pattern) -> FloatArray:
    """Level [dB SL] of a content over the raster of the plate."""
    plate = table.plate
    nx, ny = raster(plate)
    points = lattice(np.linspace(0, plate.length, nx), np.linspace(0, plate.width, ny))
    amplitudes = table.amplitudes(content.excitation, points)
    return sensation_level(*amplitudes, table.threshold).reshape(ny, nx)


def _draw(
    axes: Axes,
    table: LocalizationTable,
    levels: Mapping[float, FloatArray],
    colors: Mapping[float, str],
) -> None:
    """Draw the loudest content in its colour, paler the less it is above all others."""
    plate = table.plate
    powers = np.array([10 ** (level / 10) for level in levels.values()])
    loudest = powers.argmax(axis=0)
    own = powers.max(axis=0)
    with np.errstate(divide="ignore"):
        contrast = 10 * np.log10(own / (powers.sum(axis=0) - own))
    purity = np.clip(contrast / OWN_CONTRAST_DB, 0, 1)[:, :, None]
    light = np.clip(10 * np.log10(own) / BRIGHTEST_DB_SL, 0, 1)[:, :, None]
    color = np.array([to_rgb(colors[frequency]) for frequency in levels])[loudest]
    axes.imshow(
        light * (purity * color + (1 - purity) * _GREY),
        origin="lower",
        extent=(0.0, 100 * plate.length, 0.0, 100 * plate.width),
        interpolation="bilinear",
    )
    places = [(100 * era.x, 100 * era.y) for era in table.eras]
    axes.plot(*zip(*places, strict=True), "o", ms=8, color="0.9", mec="black", clip_on=False)
    label_plate(axes)


def _draw_finger(axes: Axes, finger: FingerRow, colors: Mapping[float, str]) -> None:
    place = 100 * finger.at_m[0], 100 * finger.at_m[1]
    for width, color in ((5.5, "white"), (2.6, _color_of(finger, colors))):
        radius = 100 * FINGERTIP_RADIUS
        axes.add_patch(Circle(place, radius, fill=False, ec=color, lw=width, clip_on=False))


def _label_finger(axes: Axes, finger: FingerRow, colors: Mapping[float, str]) -> None:
    """Write verdict, level and contrast beside a finger, on the side towards the middle."""
    lines = [finger.verdict]
    if finger.frequency_hz is not None:
        lines = [f"{finger.frequency_hz:g} Hz, {finger.verdict}"]
    if finger.measured_level_db_sl is not None:
        lines.append(f"{finger.measured_level_db_sl:.0f} dB SL")
    if finger.measured_contrast_db is not None:
        lines.append(f"{finger.measured_contrast_db:.0f} dB above the others")
    x, y = (100 * value for value in finger.at_m)
    is_high = y > sum(axes.get_ylim()) / 2
    radius = 100 * FINGERTIP_RADIUS
    axes.annotate(
        "\n".join(lines),
        (x, y - radius if is_high else y + radius),
        xytext=(0, -10 if is_high else 10),
        textcoords="offset points",
        ha="center",
        va="top" if is_high else "bottom",
        fontsize=11,
        color=_color_of(finger, colors),
        bbox={"fc": "black", "ec": "none", "alpha": 0.75, "boxstyle": "round"},
    )


def _color_of(finger: FingerRow, colors: Mapping[float, str]) -> str:
    return colors.get(finger.frequency_hz or 0.0, "white")
