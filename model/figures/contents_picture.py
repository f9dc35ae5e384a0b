"""Where each of several contents is felt, as a table predicts it: each has a colour of its own."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from model.answer.answer import OWN_CONTRAST_DB, Layer, Sensation, verdict_shown
from model.arrays import FloatArray, lattice
from model.figures.drawing import label_plate, raster
from model.finger import FINGERTIP_RADIUS, sensation_level
from model.table.table import LocalizationTable

COLORS = ("#35e07a", "#4f9dff", "#ffa62b", "#ff5fa2")
"""Of contents, in order."""

BRIGHTEST_DB_SL = 30.0
"""Level from which a colour is at its brightest; the threshold of feeling is black."""

_GREY = 0.62
_RADIUS = 100 * FINGERTIP_RADIUS  # cm


def contents_figure(
    table: LocalizationTable, contents: Sequence[Layer], fingers: Sequence[Sensation]
) -> Figure:
    """Draw a panel with all contents, and one for each, as the table predicts them.

    Beside every finger its verdict, and level and contrast as they are given.
    """
    count = len(contents)
    levels = np.array([_levels(table, each) for each in contents])
    width = 8.4 * (1 + 1 / count)
    height = 8.4 * table.plate.width / table.plate.length + 1.0
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplot_mosaic(
        [["all", f"{number}"] for number in range(count)], width_ratios=[count, 1]
    )
    _draw(panels["all"], table, levels, COLORS, fingers)
    panels["all"].set_title(
        "Coloured where a finger feels its own content, grey where contents mix", fontsize=13
    )
    for finger in fingers:
        _label_finger(panels["all"], finger, contents)
    for number, layer in enumerate(contents):
        axes = panels[f"{number}"]
        _draw(axes, table, levels[[number]], [COLORS[number % len(COLORS)]], fingers)
        axes.set_title(f"{_frequency(layer)} alone", fontsize=11)
        axes.set_axis_off()
    return figure


def _frequency(layer: Layer) -> str:
    """The frequency of a content, which has one where there are several."""
    return "several frequencies" if layer.frequency is None else f"{layer.frequency:g} Hz"


def _levels(table: LocalizationTable, content: Layer) -> FloatArray:
    """Level [dB SL] of a content over the raster of the plate."""
    plate = table.plate
    nx, ny = raster(plate)
    points = lattice(np.linspace(0, plate.length, nx), np.linspace(0, plate.width, ny))
    amplitudes = table.amplitudes(content.excitation, points)
    return sensation_level(*amplitudes, table.threshold).reshape(ny, nx)


def _draw(
    axes: Axes,
    table: LocalizationTable,
    levels: FloatArray,
    colors: Sequence[str],
    fingers: Sequence[Sensation],
) -> None:
    """Draw fingers, and the loudest content in its colour, paler the less it is above others."""
    plate = table.plate
    powers = 10 ** (levels / 10)
    own = powers.max(axis=0)
    with np.errstate(divide="ignore"):
        contrast = 10 * np.log10(own / (powers.sum(axis=0) - own))
    purity = np.clip(contrast / OWN_CONTRAST_DB, 0, 1)[:, :, None]
    light = np.clip(10 * np.log10(own) / BRIGHTEST_DB_SL, 0, 1)[:, :, None]
    color = np.array([to_rgb(each) for each in colors])[powers.argmax(axis=0) % len(colors)]
    axes.imshow(
        light * (purity * color + (1 - purity) * _GREY),
        origin="lower",
        extent=(0.0, 100 * plate.length, 0.0, 100 * plate.width),
        interpolation="bilinear",
    )
    places = [(100 * era.x, 100 * era.y) for era in table.eras]
    axes.plot(*zip(*places, strict=True), "o", ms=8, color="0.9", mec="black", clip_on=False)
    label_plate(axes)
    for finger in fingers:
        place = 100 * finger.finger.at[0], 100 * finger.finger.at[1]
        for width, hue in ((5.5, "white"), (2.6, _color_of(finger))):
            axes.add_patch(Circle(place, _RADIUS, fill=False, ec=hue, lw=width, clip_on=False))


def _label_finger(axes: Axes, finger: Sensation, contents: Sequence[Layer]) -> None:
    """Write verdict, level and contrast beside a finger, on the side towards the middle."""
    words = verdict_shown(finger.verdict, is_foreign_felt=finger.is_foreign_felt)
    lines = [str(words)]
    if finger.layer is not None:
        lines = [f"{_frequency(contents[finger.layer])}, {words}"]
        figures = {"SL": finger.level_db_sl, "above the others": finger.contrast_db}
        lines += [
            f"{each:.0f} dB {what}"
            for what, each in figures.items()
            if each is not None and math.isfinite(each)
        ]
    x, y = (100 * value for value in finger.finger.at)
    is_high = y > sum(axes.get_ylim()) / 2
    axes.annotate(
        "\n".join(lines),
        (x, y - _RADIUS if is_high else y + _RADIUS),
        xytext=(0, -10 if is_high else 10),
        textcoords="offset points",
        ha="center",
        va="top" if is_high else "bottom",
        fontsize=11,
        color=_color_of(finger),
        bbox={"fc": "black", "ec": "none", "alpha": 0.75, "boxstyle": "round"},
    )


def _color_of(finger: Sensation) -> str:
    """Of its content, white without one."""
    return "white" if finger.layer is None else COLORS[finger.layer % len(COLORS)]
