"""Contents: where each content is felt according to a table, each in its own color."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from scipy import ndimage

from model.answer.answer import OWN_CONTRAST_DB, Layer, Sensation, verdict_shown
from model.arrays import FloatArray, Point, lattice
from model.figures.plate_maps import raster
from model.figures.style import PAGE_WIDTH, SMALL_TEXT, TITLE_TEXT, draw_eras, label_plate
from model.finger import FELT_DB_SL, FINGERTIP_RADIUS, sensation_level
from model.table.table import LocalizationTable

CONTENT_COLORS = ("#ffa62b", "#4f9dff", "#35e07a", "#ff5fa2")
"""Colors of contents, in order; the first two differ most to color-blind readers."""

BRIGHTEST_DB_SL = 30.0
"""Level from which a color is at its brightest; the detection threshold is black."""

_GRAY = 0.62
_RADIUS = 100 * FINGERTIP_RADIUS  # cm
_LABEL_GAP = 8  # pt; from a finger's edge to its label
_LABEL_PADDING = 4.0  # pixels; of a label's background
_LABEL_PASSES = 3  # a moved label can cover another one
_OUTSIDE_WEIGHT = 4.0  # text off the plate is cut
_SIDES = {
    "below": (0, -1, "center", "top"),
    "above": (0, 1, "center", "bottom"),
    "right": (1, 0, "left", "center"),
    "left": (-1, 0, "right", "center"),
}
"""Direction along x and y, horizontal and vertical alignment of a label on a side of a finger."""
_MIN_PATCH_SHARE = 0.015  # of the plate; smaller patches have no label


def contents_figure(
    table: LocalizationTable,
    contents: Sequence[Layer],
    fingers: Sequence[Sensation],
    *,
    are_promised: bool = False,
) -> Figure:
    """Draw a panel with all contents and one for each, as the table predicts them.

    Verdict, level and contrast are printed next to every finger, and frequencies in every large
    patch without its own finger, since colors alone are not enough for every reader. are_promised:
    whether levels and contrasts are lower bounds.
    """
    count = len(contents)
    levels = np.array([_levels(table, layer) for layer in contents])
    main_share = max(count, 2)  # width of the main panel, relative to the others
    main_width = PAGE_WIDTH / (1 + 1 / main_share) - 0.4
    height = main_width * table.plate.width / table.plate.length + 1.1
    figure = Figure(figsize=(PAGE_WIDTH, height), layout="constrained")
    panels = figure.subplot_mosaic(
        [["all", f"{number}"] for number in range(count)], width_ratios=[main_share, 1]
    )
    main = panels["all"]
    _draw_contents(main, table, levels, CONTENT_COLORS, fingers)
    main.set_title(
        "Color: a finger feels its own content. Gray: contents mix.", fontsize=TITLE_TEXT
    )
    bound = "≥ " if are_promised else ""
    labels = [_label_finger(main, finger, contents, bound) for finger in fingers]
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
    figure.draw_without_rendering()  # computes the layout, and with it the extents of labels
    _separate(labels, main)
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
    content_color = palette[levels.argmax(axis=0) % len(colors)]
    axes.imshow(
        light * (purity * content_color + (1 - purity) * _GRAY),
        origin="lower",
        extent=(0.0, 100 * plate.length, 0.0, 100 * plate.width),
        interpolation="bilinear",
    )
    label_plate(axes)
    draw_eras(axes, table.eras, active=(), size=6)
    for finger in fingers:
        position = _centimeters(finger)
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
    length, width = 100 * table.plate.length, 100 * table.plate.width
    steps = length / (columns - 1), width / (rows - 1)
    loudest, contrast = _contrasts(levels)
    margin = np.minimum(contrast - OWN_CONTRAST_DB, loudest - FELT_DB_SL)
    axes.contour(
        margin,
        [0.0],
        extent=(0.0, length, 0.0, width),
        colors="white",
        linewidths=0.9,
        linestyles=":",
    )
    content_numbers = levels.argmax(axis=0)
    for number, layer in enumerate(contents):
        own_fingers = [finger for finger in fingers if finger.layer == number]
        is_own = (margin >= 0) & (content_numbers == number)
        for x, y in _patch_centers(is_own, steps, own_fingers):
            axes.text(
                x,
                y,
                _frequency(layer),
                ha="center",
                va="center",
                fontsize=SMALL_TEXT,
                color="white",
                path_effects=[withStroke(linewidth=2, foreground="black")],
            )


def _patch_centers(
    is_own: NDArray[np.bool_], steps: Point, fingers: Sequence[Sensation]
) -> list[Point]:
    """Return the innermost point [cm] of every large patch without a finger.

    is_own (ny, nx): points at which one content is felt on its own; steps [cm]: spacing along x and
    y; fingers: the fingers that feel the content.
    """
    step_x, step_y = steps
    patches, count = ndimage.label(is_own)
    touched = set()
    for finger in fingers:
        x, y = _centimeters(finger)
        touched.add(int(patches[round(y / step_y), round(x / step_x)]))
    centers: list[Point] = []
    for patch in range(1, count + 1):
        inside = patches == patch
        if patch in touched or inside.mean() < _MIN_PATCH_SHARE:
            continue
        # The edge of the plate counts as an edge of the patch.
        depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
        row, column = np.unravel_index(depth.argmax(), depth.shape)
        centers.append((column * step_x, row * step_y))
    return centers


def _centimeters(finger: Sensation) -> tuple[float, float]:
    """Return a finger's position in centimeters."""
    x, y = finger.finger.at
    return 100 * x, 100 * y


class _FingerLabel(Annotation):
    """Verdict, level and contrast next to a finger, toward the middle of the plate."""

    def __init__(self, axes: Axes, finger: Sensation, lines: Sequence[str]) -> None:
        self.finger_position = _centimeters(finger)
        super().__init__(
            "\n".join(lines),
            self.finger_position,
            xytext=(0, 0),
            textcoords="offset points",
            fontsize=SMALL_TEXT,
            color=_color_of(finger),
            bbox={"fc": "black", "ec": "none", "alpha": 0.75, "boxstyle": "round"},
        )
        is_high = self.finger_position[1] > sum(axes.get_ylim()) / 2
        self.place("below" if is_high else "above")

    def place(self, side: str) -> None:
        """Move the label to a side of the finger."""
        x, y = self.finger_position
        right, up, horizontal, vertical = _SIDES[side]
        self.xy = x + right * _RADIUS, y + up * _RADIUS
        self.set_position((right * _LABEL_GAP, up * _LABEL_GAP))
        self.set(horizontalalignment=horizontal, verticalalignment=vertical)

    def extent(self) -> Bbox:
        """Return the label's extent with its background, in pixels."""
        return self.get_window_extent().padded(_LABEL_PADDING)

    def finger_extent(self, axes: Axes) -> Bbox:
        """Return the extent of the label's finger, in pixels."""
        center = np.array(self.finger_position)
        corners = axes.transData.transform([center - _RADIUS, center + _RADIUS])
        return Bbox(corners)


def _label_finger(
    axes: Axes, finger: Sensation, contents: Sequence[Layer], bound: str
) -> _FingerLabel:
    """Write verdict, level and contrast next to a finger; bound: sign before both figures."""
    words = verdict_shown(finger.verdict, is_foreign_felt=finger.is_foreign_felt)
    lines = [str(words)]
    if finger.layer is not None:
        lines = [f"{_frequency(contents[finger.layer])}, {words}"]
        levels = {"SL": finger.level_db_sl, "above the others": finger.contrast_db}
        for reference, level in levels.items():
            if level is not None and math.isfinite(level):
                lines.append(f"{bound}{level:.0f} dB {reference}")
    label = _FingerLabel(axes, finger, lines)
    axes.add_artist(label)
    return label


def _separate(labels: Sequence[_FingerLabel], axes: Axes) -> None:
    """Move labels that cover other labels or fingers to the sides with most room."""
    plate = Bbox(axes.bbox.get_points()).padded(0, _LABEL_GAP)
    for _ in range(_LABEL_PASSES):
        for label in labels:
            others = [other for other in labels if other is not label]
            obstacles = [other.extent() for other in others]
            obstacles += [other.finger_extent(axes) for other in others]
            if not label.extent().count_overlaps(obstacles):
                continue
            covered_areas = []
            for side in _SIDES:
                label.place(side)
                covered_areas.append(_covered_area(label.extent(), obstacles, plate))
            least = covered_areas.index(min(covered_areas))
            label.place([*_SIDES][least])


def _covered_area(extent: Bbox, obstacles: Sequence[Bbox], plate: Bbox) -> float:
    """Return the area of obstacles that an extent covers; area off the plate counts more."""
    covered = [_common_area(extent, obstacle) for obstacle in obstacles]
    outside = extent.width * extent.height - _common_area(extent, plate)
    return sum(covered) + _OUTSIDE_WEIGHT * outside


def _common_area(extent: Bbox, other: Bbox) -> float:
    """Return the area of the intersection of two boxes, 0 without one."""
    common = Bbox.intersection(extent, other)
    return 0.0 if common is None else float(common.width * common.height)


def _color_of(finger: Sensation) -> str:
    """Return the color of a finger's content, white without one."""
    return "white" if finger.layer is None else CONTENT_COLORS[finger.layer % len(CONTENT_COLORS)]
