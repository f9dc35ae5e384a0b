"""Pictures of a demonstration: some of the touches, and where each of several contents is felt.

Of several contents each has a colour of its own.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from controller.demo.touch_row import FingerRow, TouchRow
from model.answer.answer import OWN_CONTRAST_DB, Layer
from model.arrays import FloatArray, lattice
from model.choice import ranked_by
from model.figures import save_figure
from model.figures.drawing import label_plate, raster
from model.figures.table_pictures import draw_fingertip, draw_level_scale, draw_levels
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import sensation_level
from model.table.table import LocalizationTable

MAX_PANELS = 6

COLORS = ("#35e07a", "#4f9dff", "#ffa62b", "#ff5fa2")
"""Of contents, in order."""

BRIGHTEST_DB_SL = 30.0
"""Level from which a colour is at its brightest; the threshold of feeling is black."""

_GREY = 0.62
_RADIUS = 100 * FINGERTIP_RADIUS  # cm


def write_pictures(table: LocalizationTable, rows: list[TouchRow], folder: Path) -> list[Path]:
    """Draw some of the touches into a folder, and several contents; return what was written."""
    figures = {}
    if chosen := choose_rows([row for row in rows if not row.fingers]):
        figures["touches"] = touches_figure(table, chosen)
    several = [row for row in rows if row.measured_level_db_sl is not None and row.fingers]
    if several:
        figures["contents"] = contents_figure(
            table, max(several, key=lambda row: len(row.contents))
        )
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
    title = "Coloured where a finger feels its own content, grey where contents mix"
    _draw(panels["all"], table, levels, colors, row.fingers)
    panels["all"].set_title(title, fontsize=13)
    for finger in row.fingers:
        _label_finger(panels["all"], finger, colors)
    for number, (frequency, level) in enumerate(levels.items()):
        axes = panels[f"{number}"]
        _draw(axes, table, {frequency: level}, colors, row.fingers)
        axes.set_title(f"{frequency:g} Hz alone", fontsize=11)
        axes.set_axis_off()
    return figure


def _frequency(content: Layer) -> float:
    """The frequency [Hz] of a content, which has one where there are several."""
    return next(iter(content.excitation.values())).frequency


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
    levels: Mapping[float, FloatArray],
    colors: Mapping[float, str],
    fingers: Sequence[FingerRow],
) -> None:
    """Draw fingers, and the loudest content in its colour, paler the less it is above others."""
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
    for finger in fingers:
        place = 100 * finger.at_m[0], 100 * finger.at_m[1]
        for width, hue in ((5.5, "white"), (2.6, _color_of(finger, colors))):
            axes.add_patch(Circle(place, _RADIUS, fill=False, ec=hue, lw=width, clip_on=False))


def _label_finger(axes: Axes, finger: FingerRow, colors: Mapping[float, str]) -> None:
    """Write verdict, level and contrast beside a finger, on the side towards the middle."""
    lines = (
        ("{:g} Hz, " + finger.verdict, finger.frequency_hz),
        (finger.verdict, finger.frequency_hz is None or None),
        ("{:.0f} dB SL", finger.measured_level_db_sl),
        ("{:.0f} dB above the others", finger.measured_contrast_db),
    )
    x, y = (100 * value for value in finger.at_m)
    is_high = y > sum(axes.get_ylim()) / 2
    axes.annotate(
        "\n".join(text.format(value) for text, value in lines if value is not None),
        (x, y - _RADIUS if is_high else y + _RADIUS),
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
