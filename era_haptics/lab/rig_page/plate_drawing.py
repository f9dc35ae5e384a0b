"""Drawing of a rig's plate with its parts, to a round scale."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from era_haptics.lab.rig_page.page_style import ACCENT, CURVE, FAINT, FILL, INK, SKIN, SKIN_EDGE
from era_haptics.lab.rig_page.rig_report import RigReport
from model.arrays import Point
from model.figures.template import MM_PER_INCH, GluedPart, Template
from model.finger import FINGERTIP_RADIUS

_SCALES = (2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40, 50)
_MAX_SIZE = 3.7, 3.0  # in; length and width of a plate on paper
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.42, 0.6, 0.42, 0.1  # in; margins of a plate on paper
_DIMENSION_GAP = 0.25  # in; from a plate's edge to a dimension line
_FINGER_GAP = 0.35  # in; from a plate's edge to the center of the fingertip
_POINTS = 72  # per inch
_NAME_GAP = 7  # pt; from a line or a circle to its name
_NEAR_EDGE = 0.05  # of the length; names of closer parts are moved toward the middle
_MARKS = {"solid": ("s", ACCENT), "dashed": ("o", CURVE), "dotted": ("x", FAINT)}
"""Marker and color of a part by its line in a template: driven, passive, sensor."""


def drawing_picture(report: RigReport) -> Figure:
    """Draw plate, parts, center of mass and a fingertip to a round scale; axes in millimeters."""
    template = Template(report.rig, report.sensors, is_below=False)
    board = template.board
    scale = _round_scale(board)
    unit = scale * MM_PER_INCH  # mm of the plate for an inch of paper
    figure, axes = _sheet(board, unit)
    _draw_outline(axes, report, board)
    for part in template.parts():
        _draw_part(axes, part, board, unit)
    x, y = report.center
    axes.plot(1000 * x, 1000 * y, "P", ms=7, c=INK, mec=FILL)
    finger_x = board[0] + _FINGER_GAP * unit
    _draw_fingertip(axes, finger_x, unit)
    _draw_dimensions(axes, board, unit)
    _write(axes, (finger_x, -_DIMENSION_GAP * unit), f"1 : {scale}", INK, (0, 0))
    return figure


def _round_scale(board: Point) -> int:
    """Return the largest round scale with which a board [mm] has room."""
    length, width = board
    max_length, max_width = _MAX_SIZE
    smallest = max(length / max_length, width / max_width) / MM_PER_INCH
    for scale in _SCALES:
        if scale >= smallest:
            return scale
    return round(smallest + 0.5)


def _sheet(board: Point, unit: float) -> tuple[Figure, Axes]:
    """Return a figure with axes [mm] around a board; unit [mm]: for an inch of paper."""
    length, width = board
    paper_size = length / unit + _LEFT + _RIGHT, width / unit + _BELOW + _ABOVE
    figure = Figure(figsize=paper_size)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-_LEFT * unit, length + _RIGHT * unit)
    axes.set_ylim(-_BELOW * unit, width + _ABOVE * unit)
    axes.set_axis_off()
    return figure, axes


def _draw_outline(axes: Axes, report: RigReport, board: Point) -> None:
    """Draw the outline of a plate, or the rings of a surface [mm]."""
    surface = report.rig.plate.surface
    if surface is None or not surface.outline:
        axes.add_patch(Rectangle((0, 0), *board, fc=FILL, ec=INK, lw=1))
        return
    for ring in surface.outline:
        axes.fill(*(1000 * np.array(ring)).T, fc=FILL, ec=INK, lw=1)


def _draw_part(axes: Axes, part: GluedPart, board: Point, unit: float) -> None:
    """Draw a part of a board [mm] with its contact disc, and its name toward the middle.

    unit [mm]: for an inch of paper.
    """
    marker, color = _MARKS[part.style]
    face = color if marker == "s" else FILL
    axes.add_patch(Circle(part.at, part.radius, fc="none", ec=color, lw=0.8))
    axes.plot(*part.at, marker, ms=4.5, c=color, mfc=face)
    x, y = part.at
    length, width = board
    is_right = x > length / 2
    is_high = y > width / 2
    right = 0
    if min(x, length - x) < _NEAR_EDGE * length:
        right = -_NAME_GAP if is_right else _NAME_GAP
    radius = _POINTS * part.radius / unit
    up = max(10, radius + 6)
    _write(axes, part.at, part.name, color, (right, -up if is_high else up))


def _draw_fingertip(axes: Axes, x: float, unit: float) -> None:
    """Draw a fingertip next to the lower right corner of the board."""
    radius = 1000 * FINGERTIP_RADIUS
    center = x, radius
    axes.add_patch(Circle(center, radius, fc=SKIN, ec=SKIN_EDGE, lw=0.8))
    below = -_POINTS * radius / unit - _NAME_GAP
    _write(axes, center, "fingertip", FAINT, (0, below))


def _draw_dimensions(axes: Axes, board: Point, unit: float) -> None:
    """Draw the dimensions of a board [mm]."""
    length, width = board
    gap = -_DIMENSION_GAP * unit
    _draw_dimension(axes, (0, gap), (length, gap), f"{length:g} mm")
    _draw_dimension(axes, (gap, 0), (gap, width), f"{width:g} mm")


def _draw_dimension(axes: Axes, start: Point, end: Point, words: str) -> None:
    """Draw a dimension line with arrows and a length."""
    arrows = {"arrowstyle": "<|-|>", "lw": 0.7, "color": FAINT, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", start, end, arrowprops=arrows)
    middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    is_upright = start[0] == end[0]
    axes.annotate(
        words,
        middle,
        (-_NAME_GAP, 0) if is_upright else (0, -_NAME_GAP),
        textcoords="offset points",
        rotation=90 if is_upright else 0,
        ha="center",
        va="center",
    )


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
