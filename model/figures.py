"""Pictures as matplotlib figures.

- Maps of the plate's acceleration, with marks for ERAs and nulls.
- Measurements compared with a calibration, and with promises.
- Templates: full-scale drawings of a board that mark where each part is glued. Lengths are in
  millimeters. A template of the underside is mirrored left to right, but its letters are not.
- Contents: where each content is felt according to a table, each in its own color.
- Tables: weak cells, levels, contrast, and an answer with its fingertips.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy import ndimage

from model.answer.answer import OWN_CONTRAST_DB, Answer, Layer, Sensation, verdict_shown
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray, Point, lattice
from model.config.units import LENGTH, quantity
from model.errors import InputError
from model.estimate.calibrate import Calibration
from model.files.array_file import whole_or_nothing
from model.files.output_paths import check_picture_name
from model.finger import (
    FELT_DB_SL,
    FINGERTIP_RADIUS,
    Grid,
    sensation_level,
)
from model.rig.rig import Rig
from model.structure.attachments import Source
from model.structure.plate import Plate
from model.study.contrast_maps import ContrastMap
from model.study.overview import Overview
from model.study.weak_cells import WANTED_CONTRAST_DB, WeakCells
from model.table.table import LocalizationTable
from model.vibration import NULL_SHARE, Excitation, G, PlateMap

COLORS = "viridis"
ACTIVE_COLOR = "#d55e00"
RESTING_COLOR = "white"
"""Colors of ERAs that are driven and of others, which differ in brightness, too."""

PAGE_WIDTH = 8.0
"""Width of figures with several panels [in]. A page shows it in 700 pixels: 8 pt are 10 pixels."""

SMALL_TEXT, TITLE_TEXT = 8.0, 10.0
"""Font sizes [pt] of labels and of panel titles."""

POINTS_ALONG = 97
"""Points of a raster along the longer side: on the paper's plate 60 per shortest wave."""


def raster(plate: Plate) -> tuple[int, int]:
    """Return the numbers of evenly spaced points along x and y for drawing a field."""
    step = max(plate.length, plate.width) / (POINTS_ALONG - 1)
    return max(2, round(plate.length / step) + 1), max(2, round(plate.width / step) + 1)


def draw_eras(
    axes: Axes, eras: Sequence[Source], *, active: Collection[str], size: float = 8
) -> None:
    """Mark ERAs by squares: orange with a white rim if driven, white with a black rim if not.

    The axes are in centimeters, the size is in points.
    """
    for era in eras:
        is_active = era.name in active
        color = ACTIVE_COLOR if is_active else RESTING_COLOR
        rim = "white" if is_active else "black"
        position = (100 * era.x, 100 * era.y)
        axes.plot(*position, "s", ms=size, color=color, mec=rim, mew=1.2, clip_on=False)


@dataclass(frozen=True)
class MapPanel:
    """A map of a figure, with its title and the names of driven ERAs."""

    title: str
    plate_map: PlateMap
    eras: Sequence[Source]
    active: Collection[str]


_MARKS = "Squares: ERAs (orange: driven). White lines: a tenth of the map's maximum."


def maps_figure(panels: Sequence[MapPanel], *, columns: int, caption: str | None = None) -> Figure:
    """Draw maps side by side on one color scale in g (1 g = 9.8 m/s²), with ERAs.

    White lines surround nulls: there the plate moves a tenth of the map's maximum.
    """
    rows = -(-len(panels) // columns)
    width = 6.6 if columns == 1 else PAGE_WIDTH
    panel_width = (width - 1.6) / columns
    ratio = panels[0].plate_map.y[-1] / panels[0].plate_map.x[-1]
    height = rows * (panel_width * ratio + 0.32) + (0.9 if caption else 0.8)
    # A constrained layout would leave gaps between maps of fixed aspect.
    figure = Figure(figsize=(width, height), layout="compressed")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    maximum = max(float(panel.plate_map.peak.max()) for panel in panels) / G
    for axes, panel in zip(grid.flat, panels, strict=True):
        solved = panel.plate_map
        colours = {"cmap": COLORS, "shading": "gouraud", "vmin": 0, "vmax": maximum}
        image = axes.pcolormesh(100 * solved.x, 100 * solved.y, solved.peak / G, **colours)
        label_plate(axes)
        _draw_nulls(axes, solved)
        draw_eras(axes, panel.eras, active=panel.active)
        axes.set_title(panel.title, fontsize=TITLE_TEXT, wrap=True)
        axes.label_outer()
    figure.colorbar(image, ax=grid, label="peak acceleration / g")
    figure.supxlabel(_MARKS, fontsize=SMALL_TEXT, wrap=True)
    if caption:
        figure.suptitle(caption)
    return figure


def _draw_nulls(axes: Axes, solved: PlateMap) -> None:
    """Draw a white contour around the nulls, where the plate moves a tenth of its maximum."""
    level = NULL_SHARE * float(solved.peak.max())
    if not float(solved.peak.min()) < level:
        return
    axes.contour(
        100 * solved.x, 100 * solved.y, solved.peak, levels=[level], colors="white", linewidths=1
    )


def map_figure(rig: Rig, plate_map: PlateMap, *, active: Collection[str], title: str) -> Figure:
    """Draw one map with its ERAs, a white contour around nulls and a color bar in g."""
    return maps_figure([MapPanel(title, plate_map, rig.eras, active)], columns=1)


_MAX_NAMED = 4  # ERAs named in a title


def drive_title(excitation: Excitation, rig: Rig) -> str:
    """Describe the tones of up to four ERAs, or the number of ERAs and their frequencies.

    Full amplitude and phase zero are not mentioned.
    """
    frequencies = sorted({tone.frequency for tone in excitation.values()})
    if len(excitation) > _MAX_NAMED:
        band = " to ".join(f"{end:g}" for end in dict.fromkeys((frequencies[0], frequencies[-1])))
        return f"{len(excitation)} ERAs at {band} Hz"
    full_levels = {era.name: era.full_level for era in rig.eras}
    tones = []
    for name, tone in excitation.items():
        words = f"{name} at {tone.frequency:g} Hz"
        level = tone.amplitude / full_levels[name]
        if not math.isclose(level, 1.0, rel_tol=1e-6):
            words += f", {100 * level:.3g} % amplitude"
        if tone.phase:
            words += f", phase {math.degrees(tone.phase):.3g}°"
        tones.append(words)
    return "; ".join(tones)


def label_plate(axes: Axes) -> None:
    """Label axes in centimeters, of equal scale."""
    axes.set_aspect("equal")
    axes.tick_params(labelsize=SMALL_TEXT)
    axes.set_xlabel("x / cm", fontsize=SMALL_TEXT)
    axes.set_ylabel("y / cm", fontsize=SMALL_TEXT)


DPI = 150
_UNDATED = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Metadata with which equal figures are equal bytes."""


def save_figure(figure: Figure, path: Path, *, inches: tuple[float, float] | None = None) -> None:
    """Write a figure in the format of the name's ending, without a display.

    inches: width and height, the figure's own for None. Raises InputError for an ending that is not
    in PICTURE_ENDINGS, and OSError.
    """
    check_picture_name(path)
    FigureCanvasAgg(figure)
    if inches is not None:
        figure.set_size_inches(inches)
    ending = path.suffix.lower()
    options: dict[str, Any] = {"metadata": _UNDATED.get(ending)}
    if ending == ".png":
        options["pil_kwargs"] = {"optimize": True}  # smaller files
    with whole_or_nothing(path) as stream, rc_context({"svg.hashsalt": "era"}):
        figure.savefig(stream, dpi=DPI, format=ending[1:], **options)


_ROWS, _MAX_COLUMNS = 2, 4  # of panels: sensors and ERAs


def calibration_figure(calibration: Calibration) -> Figure:
    """Draw magnitudes over frequency, a panel for each of up to eight pairs of ERA and sensor."""
    measured_eras = [
        number
        for number, era in enumerate(calibration.rig.eras)
        if era.name not in calibration.dead_eras
        and np.isfinite(calibration.measured[:, :, number]).any()
    ]
    eras = measured_eras[:_MAX_COLUMNS]
    last_sensor = len(calibration.measurement.names) - 1
    sensors = np.linspace(0, last_sensor, _ROWS).round().astype(int)
    width = max(PAGE_WIDTH * len(eras) / _MAX_COLUMNS, PAGE_WIDTH / 2)
    figure = Figure(figsize=(width, 4.4), layout="constrained")
    grid = figure.subplots(_ROWS, len(eras), sharex=True, sharey=True, squeeze=False)
    for row, sensor in enumerate(sensors):
        for column, era in enumerate(eras):
            _draw_responses(grid[row, column], calibration, sensor=sensor, era=era)
    figure.supxlabel("frequency / Hz", fontsize=TITLE_TEXT)
    figure.supylabel("response / (m/s² per µm)", fontsize=TITLE_TEXT)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=9)
    return figure


def _draw_responses(axes: Axes, calibration: Calibration, *, sensor: int, era: int) -> None:
    """Draw the responses of one sensor to one ERA: rig file, calibrated rig and measurement."""
    base_displacement = 1e-6  # m
    curves: tuple[tuple[str, NDArray[Any], dict[str, Any]], ...] = (
        ("rig file", calibration.before, {"color": "0.55", "lw": 1.0, "ls": "--"}),
        ("calibrated rig", calibration.after, {"color": "#0072b2", "lw": 1.2}),
        ("measured", calibration.measured, {"color": "#d55e00", "marker": ".", "ls": "none"}),
    )
    frequencies = calibration.measurement.frequencies
    for label, responses, style in curves:
        magnitude = base_displacement * np.abs(responses[:, sensor, era])
        axes.semilogy(frequencies, magnitude, label=label, ms=4, **style)
    era_name = calibration.rig.eras[era].name
    sensor_name = calibration.measurement.names[sensor]
    axes.set_title(f"ERA {era_name}, sensor {sensor_name}", fontsize=9)
    axes.tick_params(labelsize=SMALL_TEXT)
    axes.grid(True, which="both", alpha=0.2)


MM_PER_INCH = 25.4
POINT = MM_PER_INCH / 72
BORDER, STRIP = 12.0, 22.0
"""Width of the paper around the board [mm], and of the strip below it, with a ruler."""
RULER = 100  # mm
A4 = (210.0, 297.0), (297.0, 210.0)  # mm; upright and across
NOT_PRINTED = 8.0  # mm; edges of a page that printers leave white
CROSS = 6.0  # mm; half its size
LABEL = 8.0  # pt; font size on A4, larger on larger sheets
LETTER, LINE = 1.8, 3.6  # mm; width of a letter and height of a line of this size
GRAIN = 40.0  # mm; length of the arrow

Box = tuple[float, float, float, float]
"""Least and greatest x, least and greatest y [mm]."""


@dataclass(frozen=True)
class Template:
    """A board to be drawn in real size."""

    rig: Rig
    sensors: Mapping[str, tuple[float, float]]
    """Places of the sensors [m] by name."""
    is_below: bool = True
    """Whether it is seen from below, where actuators are glued."""

    @property
    def board(self) -> tuple[float, float]:
        """Length and width [mm]."""
        return 1000 * self.rig.plate.length, 1000 * self.rig.plate.width

    @property
    def paper(self) -> Box:
        """The board with its border."""
        length, width = self.board
        return -BORDER, max(length, RULER) + BORDER, -BORDER, width + BORDER

    @property
    def grain(self) -> tuple[float, float] | None:
        """Direction of the grain, None for a board without."""
        if self.rig.plate.material.orthotropy is None:
            return None
        return (0.0, 1.0) if self.rig.grain == "width" else (1.0, 0.0)

    @property
    def title(self) -> str:
        """Description of the view."""
        length, width = self.board
        side = "below, for the underside" if self.is_below else "above, for the touched side"
        return f"{length:g} x {width:g} mm, seen from {side}; positions x, y in mm"

    def label(self, name: str, at: tuple[float, float]) -> list[str]:
        """Return the lines next to a position: name, output of an actuator, and coordinates."""
        channel = self.rig.wiring.get(name)
        output = f", output {channel.number + 1}" if channel else ""
        return [f"{name}{output}", f"{at[0]:.1f}, {at[1]:.1f}"]

    def places(self) -> Iterator[tuple[str, tuple[float, float], float, str]]:
        """Yield name, position and radius [mm], and style of the circle, for all glued parts."""
        for era in self.rig.eras:
            yield era.name, (1000 * era.x, 1000 * era.y), 1000 * era.foot, "solid"
        data: Mapping[str, Any] = self.rig.document.data if self.rig.document else {}
        driven = {era.name for era in self.rig.eras}
        others = [data.get(kind, {}).items() for kind in ("eras", "masses", "supports")]
        for name, keys in chain(*others):
            if "at" in keys and name not in driven:
                x, y, foot = (
                    1000 * quantity(k, LENGTH) for k in (*keys["at"], keys.get("foot", 0))
                )
                yield name, (x, y), foot, "dashed"
        for name, (x, y) in self.sensors.items():
            yield name, (1000 * x, 1000 * y), 0.0, "dotted"


def write_template(path: Path, template: Template) -> int:
    """Write one sheet in real size, or A4 pages to be joined in a PDF; return their number.

    Raises InputError for an ending that no picture has, and OSError.
    """
    if path.suffix.lower() != ".pdf":
        left, right, _, _ = template.paper
        scale = max(1.0, (right - left) / A4[0][0])
        save_figure(_page(template, template.paper, name="", edge=0.0, scale=scale), path)
        return 1
    pages = [*template_pages(template)]
    # Without a date, so that equal rigs make equal bytes.
    with whole_or_nothing(path) as stream, PdfPages(stream, metadata={"CreationDate": None}) as pdf:
        for page in pages:
            pdf.savefig(page)
    return len(pages)


def template_pages(template: Template) -> Iterator[Figure]:
    """Yield A4 pages from the top left, in portrait or landscape format (fewer pages win)."""
    low, high, bottom, top = template.paper
    sizes = [(width - 2 * NOT_PRINTED, height - NOT_PRINTED - STRIP) for width, height in A4]
    counts = [
        (math.ceil((high - low) / width), math.ceil((top - bottom) / height))
        for width, height in sizes
    ]
    pages, (across, down) = min(
        zip(counts, sizes, strict=True), key=lambda each: math.prod(each[0])
    )
    columns, rows = pages
    for row, column in product(range(rows), range(columns)):
        upper = top - row * down
        # Columns are counted from the left of the paper, for either direction of x.
        left = high - (column + 1) * across if template.is_below else low + column * across
        name = f"; row {row + 1} of {rows}, column {column + 1} of {columns}: join at the frame"
        box = left, left + across, upper - down, upper
        yield _page(template, box, name=name, edge=NOT_PRINTED)


def _page(template: Template, box: Box, *, name: str, edge: float, scale: float = 1.0) -> Figure:
    """Draw a box of the board and the strip below it, within a white edge [mm].

    scale: of the text; that of a large sheet is also read on a screen.
    """
    low, high, bottom, top = box
    strip_height = STRIP * scale
    width, height = high - low + 2 * edge, top - bottom + edge + strip_height
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    area = edge / width, strip_height / height, (high - low) / width, (top - bottom) / height
    axes = figure.add_axes(area)
    _draw(axes, template, box, scale=scale)
    if name:
        axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, fill=False, lw=0.3))
    _draw_strip(figure, template, (width, height), name=name, scale=scale)
    return figure


def _draw_strip(
    figure: Figure, template: Template, size: tuple[float, float], *, name: str, scale: float
) -> None:
    """Draw the ruler and two lines of text below the board; size: of the paper [mm]."""
    width, height = size
    strip_height = STRIP * scale
    strip = figure.add_axes(
        (0, 0, 1, strip_height / height), xlim=(0, width), ylim=(0, strip_height)
    )
    strip.set_axis_off()
    ruler = 12 * scale
    for tick in range(0, RULER + 1, 10):
        length = 5 if tick % 50 == 0 else 3
        strip.plot([BORDER + tick] * 2, [ruler, ruler + length], c="black", lw=0.5)
    strip.plot([BORDER, BORDER + RULER], [ruler, ruler], c="black", lw=0.5, gid="ruler")
    strip.text(BORDER, 7 * scale, template.title, size=LABEL * scale)
    print_again = f"{RULER} mm on paper, or print again at 100 %{name}"
    strip.text(BORDER, 3 * scale, print_again, size=LABEL * scale)


def _draw(axes: Axes, template: Template, box: Box, *, scale: float) -> None:
    """Draw the part of the board in a box, which fills the axes; scale: of the text."""
    low, high, bottom, top = box
    length, width = template.board
    axes.set(xlim=(high, low) if template.is_below else (low, high), ylim=(bottom, top))
    axes.set_axis_off()
    axes.add_patch(Rectangle((0, 0), length, width, fill=False, lw=0.7, gid="board"))
    axes.plot([0, length], [width / 2] * 2, [length / 2] * 2, [0, width], c="0.8", lw=0.3, ls="-.")
    for name, (x, y), radius, style in template.places():
        mark, size = ("x", 6.0) if style == "dotted" else ("+", 2 * CROSS / POINT)
        axes.plot(x, y, mark, c="black", ms=size, mew=0.4)
        if radius:
            axes.add_patch(Circle((x, y), radius, fill=False, lw=0.7, ls=style, gid=name))
        lines = template.label(name, (x, y))
        (right, up), away = _beside((x, y), radius, lines, template, box, scale=scale)
        axes.annotate(
            "\n".join(lines),
            (x, y),
            (right * away / POINT, up * away / POINT),
            textcoords="offset points",
            size=LABEL * scale,
            ha="left" if right > 0 else "right",
            va="bottom" if up > 0 else "top",
            annotation_clip=True,
        )
    if template.grain:
        _draw_grain(axes, template, box, scale=scale)
    axes.text(-5, -8, "0, 0", size=LABEL * scale, ha="center", va="center", clip_on=True)
    pointing: dict[str, Any] = {"arrowprops": {"arrowstyle": "<-", "lw": 0.5}}
    for name, start, end in (("x", (0, -4), (16, -4)), ("y", (-4, 0), (-4, 16))):
        axes.annotate(
            name,
            start,
            end,
            size=LABEL * scale,
            va="center",
            ha="center",
            annotation_clip=True,
            **pointing,
        )


def _draw_grain(axes: Axes, template: Template, box: Box, *, scale: float) -> None:
    """Draw an arrow along the grain at the lower end of the visible part of the board."""
    assert template.grain is not None  # noqa: S101  the caller has checked
    low, high, bottom, _ = box
    dx, dy = (GRAIN / 2 * direction for direction in template.grain)
    x = (max(low, 0) + min(high, template.board[0])) / 2
    y = max(bottom, 0) + CROSS + dy
    arrow = {"arrowstyle": "<->", "lw": 0.7, "color": "0.4"}
    axes.annotate("", (x - dx, y - dy), (x + dx, y + dy), arrowprops=arrow)
    axes.annotate(
        "grain", (x, y), (3, 3), textcoords="offset points", size=LABEL * scale, color="0.4"
    )


def _beside(
    at: tuple[float, float],
    radius: float,
    lines: Sequence[str],
    template: Template,
    box: Box,
    *,
    scale: float,
) -> tuple[tuple[int, int], float]:
    """Return a label's direction, rightwards and upwards on paper (1 or -1), and distance [mm].

    The label is on the side of the board's middle, unless a frame is there.
    """
    (x, y), (low, high, bottom, top) = at, box
    across = -1 if template.is_below else 1
    wide, tall = scale * LETTER * max(map(len, lines)), scale * LINE * len(lines)
    away = 2 + 0.75 * radius  # mm, beyond the circle
    right = across if x < template.board[0] / 2 else -across
    ways = [*product((right, -right), (1, -1))]
    free = [
        (to_right, up)
        for to_right, up in ways
        if low < x + across * to_right * (away + wide) < high
        and bottom < y + up * (away + tall) < top
    ]
    return (free or ways)[0], away


CONTENT_COLORS = ("#ffa62b", "#4f9dff", "#35e07a", "#ff5fa2")
"""Colors of contents, in order; the first two differ most to color-blind readers."""

BRIGHTEST_DB_SL = 30.0
"""Level from which a color is at its brightest; the detection threshold is black."""

_GREY = 0.62
_RADIUS = 100 * FINGERTIP_RADIUS  # cm
_MIN_PATCH_SHARE = 0.015  # of the plate; smaller patches have no label


def contents_figure(
    table: LocalizationTable, contents: Sequence[Layer], fingers: Sequence[Sensation]
) -> Figure:
    """Draw a panel with all contents and one for each, as the table predicts them.

    Verdict, level and contrast are printed next to every finger, and frequencies in every large
    patch without its own finger, since colors alone are not enough for every reader.
    """
    count = len(contents)
    levels = np.array([_levels(table, layer) for layer in contents])
    main_width = PAGE_WIDTH / (1 + 1 / count) - 0.4
    height = main_width * table.plate.width / table.plate.length + 1.1
    figure = Figure(figsize=(PAGE_WIDTH, height), layout="constrained")
    panels = figure.subplot_mosaic(
        [["all", f"{number}"] for number in range(count)], width_ratios=[count, 1]
    )
    main = panels["all"]
    _draw_contents(main, table, levels, CONTENT_COLORS, fingers)
    main.set_title(
        "Color: a finger feels its own content. Gray: contents mix.", fontsize=TITLE_TEXT
    )
    for finger in fingers:
        _label_finger(main, finger, contents)
    _label_patches(main, table, levels, contents, fingers)
    for number, layer in enumerate(contents):
        axes = panels[f"{number}"]
        color = CONTENT_COLORS[number % len(CONTENT_COLORS)]
        _draw_contents(axes, table, levels[[number]], [color], fingers)
        axes.set_title(f"{_frequency(layer)} alone", fontsize=TITLE_TEXT)
        axes.set_axis_off()
    figure.supxlabel(
        f"Dotted outlines: {OWN_CONTRAST_DB:g} dB above the others. Black: below the detection "
        "threshold. Squares: ERAs.",
        fontsize=SMALL_TEXT,
    )
    return figure


def _frequency(layer: Layer) -> str:
    """Return the frequency of a content in words."""
    return "several frequencies" if layer.frequency is None else f"{layer.frequency:g} Hz"


def _levels(table: LocalizationTable, content: Layer) -> FloatArray:
    """Return the level [dB SL] of a content over the raster of the plate."""
    plate = table.plate
    nx, ny = raster(plate)
    points = lattice(np.linspace(0, plate.length, nx), np.linspace(0, plate.width, ny))
    amplitudes = table.amplitudes(content.excitation, points)
    return sensation_level(*amplitudes, table.threshold).reshape(ny, nx)


def _contrasts(levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the loudest content's level [dB SL] and its contrast to all others [dB] (ny, nx)."""
    powers = 10 ** (levels / 10)
    loudest = powers.max(axis=0)
    with np.errstate(divide="ignore"):
        contrast = 10 * np.log10(loudest / (powers.sum(axis=0) - loudest))
    return 10 * np.log10(loudest), contrast


def _draw_contents(
    axes: Axes,
    table: LocalizationTable,
    levels: FloatArray,
    colors: Sequence[str],
    fingers: Sequence[Sensation],
) -> None:
    """Draw fingers, and the loudest content in its color, which fades to gray near others."""
    plate = table.plate
    loudest, contrast = _contrasts(levels)
    purity = np.clip(contrast / OWN_CONTRAST_DB, 0, 1)[:, :, None]
    light = np.clip(loudest / BRIGHTEST_DB_SL, 0, 1)[:, :, None]
    palette = np.array([to_rgb(color) for color in colors])
    color = palette[levels.argmax(axis=0) % len(colors)]
    axes.imshow(
        light * (purity * color + (1 - purity) * _GREY),
        origin="lower",
        extent=(0.0, 100 * plate.length, 0.0, 100 * plate.width),
        interpolation="bilinear",
    )
    label_plate(axes)
    draw_eras(axes, table.eras, active=(), size=6)
    for finger in fingers:
        position = _centimetres(finger)
        for width, hue in ((5.5, "white"), (2.6, _color_of(finger))):
            axes.add_patch(Circle(position, _RADIUS, fill=False, ec=hue, lw=width, clip_on=False))


def _label_patches(
    axes: Axes,
    table: LocalizationTable,
    levels: FloatArray,
    contents: Sequence[Layer],
    fingers: Sequence[Sensation],
) -> None:
    """Outline the patches that feel like one content, and write frequencies into large ones.

    A patch with its own finger is not labeled again.
    """
    _, rows, columns = levels.shape
    step_x = 100 * table.plate.length / (columns - 1)
    step_y = 100 * table.plate.width / (rows - 1)
    loudest, contrast = _contrasts(levels)
    extent = (0.0, 100 * table.plate.length, 0.0, 100 * table.plate.width)
    margin = np.minimum(contrast - OWN_CONTRAST_DB, loudest - FELT_DB_SL)
    axes.contour(margin, [0.0], extent=extent, colors="white", linewidths=0.9, linestyles=":")
    is_own = margin >= 0
    for number, layer in enumerate(contents):
        patches, count = ndimage.label(is_own & (levels.argmax(axis=0) == number))
        labelled = {
            int(patches[round(y / step_y), round(x / step_x)])
            for x, y in (_centimetres(finger) for finger in fingers if finger.layer == number)
        }
        for patch in range(1, count + 1):
            inside = patches == patch
            if patch in labelled or inside.mean() < _MIN_PATCH_SHARE:
                continue
            # The edge of the plate counts as an edge of the patch.
            depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
            row, column = np.unravel_index(depth.argmax(), depth.shape)
            axes.text(
                column * step_x,
                row * step_y,
                _frequency(layer),
                ha="center",
                va="center",
                fontsize=SMALL_TEXT,
                color="white",
                path_effects=[withStroke(linewidth=2, foreground="black")],
            )


def _centimetres(finger: Sensation) -> tuple[float, float]:
    """Return a finger's position in centimeters."""
    x, y = finger.finger.at
    return 100 * x, 100 * y


def _label_finger(axes: Axes, finger: Sensation, contents: Sequence[Layer]) -> None:
    """Write verdict, level and contrast next to a finger, toward the middle of the plate."""
    words = verdict_shown(finger.verdict, is_foreign_felt=finger.is_foreign_felt)
    lines = [str(words)]
    if finger.layer is not None:
        lines = [f"{_frequency(contents[finger.layer])}, {words}"]
        figures = {"SL": finger.level_db_sl, "above the others": finger.contrast_db}
        lines += [
            f"{level:.0f} dB {reference}"
            for reference, level in figures.items()
            if level is not None and math.isfinite(level)
        ]
    x, y = _centimetres(finger)
    is_high = y > sum(axes.get_ylim()) / 2
    axes.annotate(
        "\n".join(lines),
        (x, y - _RADIUS if is_high else y + _RADIUS),
        xytext=(0, -8 if is_high else 8),
        textcoords="offset points",
        ha="center",
        va="top" if is_high else "bottom",
        fontsize=SMALL_TEXT,
        color=_color_of(finger),
        bbox={"fc": "black", "ec": "none", "alpha": 0.75, "boxstyle": "round"},
    )


def _color_of(finger: Sensation) -> str:
    """Return the color of a finger's content, white without one."""
    return "white" if finger.layer is None else CONTENT_COLORS[finger.layer % len(CONTENT_COLORS)]


_CONTRAST = "promised felt contrast / dB"

# Fingers of the example answer, in shares of the plate.
_EXAMPLE = ((0.3, 0.35), (0.8, 0.6), (0.45, 0.85))


def table_figures(table: LocalizationTable, overview: Overview) -> Iterator[tuple[str, Figure]]:
    """Yield all pictures of a table with their names."""
    yield "weak_cells", weak_cells_figure(table, overview.cells)
    yield "levels", levels_figure(table)
    yield "contrast", contrast_figure(table, overview)
    yield "answer", answer_figure(table)


def weak_cells_figure(table: LocalizationTable, weak: WeakCells) -> Figure:
    """Draw the contrast from each cell to the median other finger, and the tenth percentile."""
    panels = {
        "other finger: median position": weak.median_db,
        "other finger: 10th percentile": weak.tenth_db,
    }
    figure = _cells_figure(
        table, weak.grid, panels, label=_CONTRAST, crossed=(~weak.feasible, weak.weak)
    )
    figure.suptitle(
        f"Drive mode {table.drive_mode}: contrast of a target in each cell to one other finger\n"
        f"(crosses: below {WANTED_CONTRAST_DB:g} dB; squares: ERAs)",
        fontsize=TITLE_TEXT,
    )
    return figure


def levels_figure(table: LocalizationTable) -> Figure:
    """Draw the highest level at each cell that one or two ERAs can reach."""
    levels = table.available_level_db_sl
    title = (
        "Highest level of one or two ERAs at full amplitude\n"
        f"(crosses: below {FELT_DB_SL:g} dB SL; squares: ERAs)"
    )
    dead = levels < FELT_DB_SL
    label = level_label(table.threshold)
    return _cells_figure(table, table.grid, {title: levels}, label=label, crossed=(dead,))


_LINE_STYLES = ("-", "--", "-.")


def contrast_figure(table: LocalizationTable, overview: Overview) -> Figure:
    """Draw the distribution of contrast over contact sets of 1, 2 and 3 other fingers."""
    figure = Figure(figsize=(6.0, 3.9), layout="constrained")
    axes = figure.subplots()
    for others, (promised, _) in enumerate(overview.contrasts, start=1):
        contrasts = np.sort(promised)
        share = 1 - np.arange(len(contrasts)) / max(1, len(contrasts))
        label = f"{others}"
        if len(contrasts):
            label += f": median {np.median(contrasts):.1f} dB"
        style = _LINE_STYLES[(others - 1) % len(_LINE_STYLES)]
        axes.step(contrasts, 100 * share, where="pre", ls=style, lw=1.8, label=label)
    wanted = f"{WANTED_CONTRAST_DB:g} dB"
    axes.axvline(WANTED_CONTRAST_DB, color="0.4", ls=":", lw=1.2, label=wanted)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 100)
    axes.set_xlabel(_CONTRAST)
    axes.set_ylabel("contact sets with at least this contrast / %")
    axes.grid(color="0.9")
    axes.legend(loc="upper right", fontsize=9, title="other fingers")
    axes.set_title(f"Drive mode {table.drive_mode}: contacts at least 5 cm apart", fontsize=11)
    return figure


def contrast_map_figure(table: LocalizationTable, found: ContrastMap) -> Figure:
    """Draw promised contrast of every place to quiet fingers, drive modes side by side."""
    grid = Grid(len(found.x), len(found.y))
    figure = _cells_figure(table, grid, found.promised_db, label=_CONTRAST)
    for axes in figure.axes[: len(found.promised_db)]:
        for finger in found.quiet:
            draw_fingertip(axes, finger, felt=False)
    return figure


def _cells_figure(
    table: LocalizationTable,
    grid: Grid,
    panels: Mapping[str, FloatArray],
    *,
    label: str,
    crossed: Sequence[NDArray[np.bool_]] = (),
) -> Figure:
    """Draw values of cells, panels side by side on one scale; white without a value, and ERAs.

    crossed: of each panel the cells with crosses.
    """
    count = len(panels)
    width = 6.2 if count == 1 else 7.2
    ratio = table.plate.width / table.plate.length
    figure = Figure(figsize=(width, (width - 1.6) / count * ratio + 1.2), layout="compressed")
    known = np.concatenate([values[np.isfinite(values)] for values in panels.values()])
    limits = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    x = np.linspace(0, 100 * table.plate.length, grid.nx + 1)
    y = np.linspace(0, 100 * table.plate.width, grid.ny + 1)
    drawn = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    for axes, (title, values) in zip(drawn, panels.items(), strict=True):
        shown = np.ma.masked_invalid(values.reshape(grid.ny, grid.nx))
        image = axes.pcolormesh(x, y, shown, cmap=COLORS, vmin=limits[0], vmax=limits[1])
        axes.add_patch(Rectangle((0, 0), x[-1], y[-1], fill=False, ec="0.4", clip_on=False))
        draw_eras(axes, table.eras, active=[era.name for era in table.eras])
        label_plate(axes)
        axes.set_title(title, fontsize=TITLE_TEXT)
        axes.label_outer()
    rim = [withStroke(linewidth=3, foreground="black")]  # white alone is lost on yellow
    for axes, cells in zip(drawn, crossed, strict=False):
        marked = 100 * grid.centres(table.plate)[cells]
        axes.plot(*marked.T, "x", color="white", ms=6, mew=1.5, path_effects=rim)
    figure.colorbar(image, ax=list(drawn), label=label)
    return figure


def answer_figure(table: LocalizationTable) -> Figure:
    """Draw sensation levels and fingers for an example query."""
    plate = table.plate
    target, *quiet = ((u * plate.length, v * plate.width) for u, v in _EXAMPLE)
    answer = None
    with suppress(InputError):  # small plate
        answer = query(table, Placement((target,), tuple(quiet)))
    if answer is None or not answer.is_reached:  # weak rig
        figure = Figure(figsize=(6.6, 5))
        figure.suptitle("The table has no answer for the three fingers of this picture")
        return figure
    figure, felt = layer_figure(table, answer, 0), answer.fingers[0]
    figure.axes[0].set_title(
        f"Felt contrast {felt.promised_contrast_db:.0f} dB promised, "
        f"{felt.contrast_db:.0f} dB nominal\n"
        f"{_in_words(table, answer.layers[0])}",
        fontsize=10,
        pad=20,
    )
    return figure


def layer_figure(table: LocalizationTable, answer: Answer, layer_number: int) -> Figure:
    """Draw the level of an answer's layer over the plate, the fingers and the promises."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    layer = answer.layers[layer_number]
    axes.set_axis_off()
    draw_levels(axes, table, layer.excitation)
    positions = [sensation.finger.at for sensation in answer.fingers]
    for number, sensation in enumerate(answer.fingers):
        is_felt = number in layer.fingers
        level = sensation.level_db_sl if is_felt else None
        others = [*positions[:number], *positions[number + 1 :]]
        draw_fingertip(axes, positions[number], felt=is_felt, level_db_sl=level, others=others)
    promised = answer.fingers[layer.fingers[0]].promised_contrast_db
    if promised is not None:
        axes.set_title(
            f"contrast of at least {promised:.0f} dB on 90 % of plates", fontsize=11, pad=20
        )
    draw_level_scale(figure, [axes], table.threshold, shrink=0.8)
    return figure


def _in_words(table: LocalizationTable, layer: Layer) -> str:
    """Format up to twelve tones, two per line."""
    tones = [
        f"{name} {tone['frequency_hz']:g} Hz, level {tone['level']:.3f}, {tone['phase_deg']:.0f}°"
        for name, tone in table.drive_of(layer.excitation).items()
    ]
    return "\n".join("; ".join(tones[start : start + 2]) for start in range(0, 12, 2)).strip()


_LEVEL_COLORS = "magma"
_SCALE = Normalize(-10.0, 30.0)
"""Levels [dB SL] from barely perceptible to more than strong."""

FELT_COLOR, QUIET_COLOR = "#6dff9c", "#9fdcff"

_SIDE = 121  # points along a side; nulls are narrow


def draw_levels(axes: Axes, table: LocalizationTable, excitation: Excitation) -> None:
    """Draw the sensation level [dB SL] over the plate, and the ERAs; axes in centimeters."""
    x, y = (np.linspace(0, side, _SIDE) for side in (table.plate.length, table.plate.width))
    amplitudes = table.amplitudes(excitation, lattice(x, y))
    level = sensation_level(*amplitudes, table.threshold).reshape(_SIDE, _SIDE)
    axes.pcolormesh(100 * x, 100 * y, level, cmap=_LEVEL_COLORS, shading="gouraud", norm=_SCALE)
    axes.set_aspect("equal")
    draw_eras(axes, table.eras, active=excitation.keys())
    frequencies = {tone.frequency for tone in excitation.values()}
    for era in table.eras:
        if tone := excitation.get(era.name):
            axes.annotate(
                era.name if len(frequencies) == 1 else f"{era.name} {tone.frequency:g} Hz",
                (100 * era.x, 100 * era.y),
                xytext=(0, 9 if era.y > table.plate.width / 2 else -16),
                textcoords="offset points",
                ha="left" if era.x < table.plate.length / 2 else "right",
                fontsize=9,
                path_effects=[withStroke(linewidth=2.5, foreground="white", alpha=0.75)],
            )
    if len(frequencies) == 1:
        axes.text(
            *(0.5, -0.02, f"{frequencies.pop():g} Hz"),  # between the names of corner ERAs
            transform=axes.transAxes,
            ha="center",
            va="top",
            fontsize=9,
        )


def level_label(threshold: str) -> str:
    """Return the label of a scale of levels, with the threshold set that they are relative to."""
    return f"level / dB SL (thresholds: {threshold})"


def draw_level_scale(
    figure: Figure, axes: Iterable[Axes], threshold: str, *, shrink: float
) -> None:
    """Draw the color scale of `draw_levels` next to axes, shrunk to a share of their height.

    threshold: name of the set that levels are relative to.
    """
    figure.colorbar(
        ScalarMappable(_SCALE, _LEVEL_COLORS),
        ax=list(axes),
        label=level_label(threshold),
        extend="both",
        shrink=shrink,
    )


def draw_fingertip(
    axes: Axes,
    place: Point,
    *,
    felt: bool,
    level_db_sl: float | None = None,
    others: Sequence[Point] = (),
) -> None:
    """Draw a fingertip at x, y [m], with its level [dB SL]: solid if felt, dashed if quiet.

    others [m]: further fingertips, which the label avoids.
    """
    x, y = 100 * place[0], 100 * place[1]
    outline = [withStroke(linewidth=2.5, foreground="black", alpha=0.75)]
    color = FELT_COLOR if felt else QUIET_COLOR
    circle = Circle(
        (x, y),
        100 * FINGERTIP_RADIUS,
        fill=False,
        color=color,
        lw=2.4 if felt else 1.6,
        ls="-" if felt else "--",
        path_effects=outline,
    )
    axes.add_patch(circle)
    text = "felt" if felt else "quiet"
    if level_db_sl is not None:
        text += f"\n{round(level_db_sl)} dB SL"
    side = _label_side(axes, place, others)
    axes.annotate(
        text,
        (x, y + side * 100 * FINGERTIP_RADIUS),
        xytext=(0, 2 * side),
        textcoords="offset points",
        ha="center",
        va="bottom" if side > 0 else "top",
        fontsize=SMALL_TEXT,
        color=color,
        fontweight="bold" if felt else "normal",
        path_effects=outline,
    )


_LABEL_SHARE = 0.3  # of the plate's width; room for a label


def _label_side(axes: Axes, place: Point, others: Sequence[Point]) -> int:
    """Return whether a fingertip's label is above (1) or below (-1) it.

    Away from the nearest other fingertip, but on the plate.
    """
    low, high = axes.get_ylim()  # cm
    height = (100 * place[1] - low) / (high - low)
    if height < _LABEL_SHARE:
        return 1
    if height > 1 - _LABEL_SHARE:
        return -1
    nearest = min(others, key=lambda other: math.dist(place, other), default=None)
    return 1 if nearest is not None and nearest[1] < place[1] else -1
