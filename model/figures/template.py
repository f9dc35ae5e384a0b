"""Templates: full-scale drawings of a board that mark where each part is glued.

Lengths are in millimeters. A template of the underside is mirrored left to right, but its letters
are not.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from model.arrays import Point
from model.config.units import LENGTH, quantity
from model.figures.style import save_figure
from model.files.array_file import whole_or_nothing
from model.rig.rig import Rig

MM_PER_INCH = 25.4
POINT = MM_PER_INCH / 72
BORDER = 12.0
"""Width of the paper around the board [mm]."""

STRIP = 22.0
"""Height of the strip below the board [mm], with a ruler."""

RULER = 100  # mm
A4 = (210.0, 297.0), (297.0, 210.0)  # mm; portrait and landscape
NOT_PRINTED = 8.0  # mm; edges of a page that printers leave white
CROSS = 6.0  # mm; half its size
LABEL = 8.0  # pt; font size on A4, larger on larger sheets
LETTER, LINE = 1.8, 3.6  # mm; width of a letter and height of a line of this size
GRAIN = 40.0  # mm; length of the arrow

Box = tuple[float, float, float, float]
"""Smallest and largest x, smallest and largest y [mm]."""


@dataclass(frozen=True)
class GluedPart:
    """A part that is glued to a board, as a template marks it."""

    name: str
    at: Point
    """Position [mm]."""
    radius: float
    """Radius of its contact disc [mm], 0 for a point."""
    style: str
    """Line style of the circle: solid if driven, dashed if passive, dotted for a sensor."""


@dataclass(frozen=True)
class Template:
    """A board to be drawn full-scale."""

    rig: Rig
    sensors: Mapping[str, Point]
    """Positions of the sensors [m] by name."""
    is_below: bool = True
    """Whether the drawing shows the underside, where actuators are glued."""

    @property
    def board(self) -> tuple[float, float]:
        """Length and width [mm]."""
        return 1000 * self.rig.plate.length, 1000 * self.rig.plate.width

    @property
    def paper(self) -> Box:
        """Bounds of the board with its border."""
        length, width = self.board
        return -BORDER, max(length, RULER) + BORDER, -BORDER, width + BORDER

    @property
    def grain(self) -> tuple[float, float] | None:
        """Direction of the grain; None for a material without grain."""
        if self.rig.plate.material.orthotropy is None:
            return None
        return (0.0, 1.0) if self.rig.grain == "width" else (1.0, 0.0)

    @property
    def title(self) -> str:
        """Description of the view."""
        length, width = self.board
        side = "below, for the underside" if self.is_below else "above, for the touched side"
        return f"{length:g} x {width:g} mm, seen from {side}; positions x, y in mm"

    def label(self, part: GluedPart) -> list[str]:
        """Return the lines next to a part: name, output of an actuator, and coordinates."""
        channel = self.rig.wiring.get(part.name)
        output = f", output {channel.number + 1}" if channel else ""
        return [f"{part.name}{output}", f"{part.at[0]:.1f}, {part.at[1]:.1f}"]

    def parts(self) -> Iterator[GluedPart]:
        """Yield all glued parts: actuators, passive parts, sensors."""
        for era in self.rig.eras:
            yield GluedPart(era.name, (1000 * era.x, 1000 * era.y), 1000 * era.foot, "solid")
        yield from self._passive_parts()
        for name, (x, y) in self.sensors.items():
            yield GluedPart(name, (1000 * x, 1000 * y), 0.0, "dotted")

    def _passive_parts(self) -> Iterator[GluedPart]:
        """Yield masses and supports at a point, including ERAs without an amplifier."""
        data: Mapping[str, Any] = self.rig.document.data if self.rig.document else {}
        driven = {era.name for era in self.rig.eras}
        for kind in ("eras", "masses", "supports"):
            for name, keys in data.get(kind, {}).items():
                if "at" in keys and name not in driven:
                    x, y = (1000 * quantity(coordinate, LENGTH) for coordinate in keys["at"])
                    radius = 1000 * quantity(keys.get("foot", 0), LENGTH)
                    yield GluedPart(name, (x, y), radius, "dashed")


def write_template(path: Path, template: Template) -> int:
    """Write one full-scale sheet, or a PDF of A4 pages to be joined; return the number of pages.

    Raises InputError for an ending of another file type, and OSError.
    """
    if path.suffix.lower() != ".pdf":
        left, right, _, _ = template.paper
        scale = max(1.0, (right - left) / A4[0][0])
        save_figure(_page(template, template.paper, name="", edge=0.0, scale=scale), path)
        return 1
    pages = [*template_pages(template)]
    # Without a date, so that equal rigs give identical files.
    with whole_or_nothing(path) as stream, PdfPages(stream, metadata={"CreationDate": None}) as pdf:
        for page in pages:
            pdf.savefig(page)
    return len(pages)


def template_pages(template: Template) -> Iterator[Figure]:
    """Yield A4 pages from the top left, in portrait or landscape format (fewer pages win)."""
    low, high, bottom, top = template.paper
    layouts = []
    for page_width, page_height in A4:
        width, height = page_width - 2 * NOT_PRINTED, page_height - NOT_PRINTED - STRIP
        columns = math.ceil((high - low) / width)
        rows = math.ceil((top - bottom) / height)
        layouts.append((columns, rows, width, height))
    columns, rows, width, height = min(layouts, key=_page_count)
    for row, column in product(range(rows), range(columns)):
        upper = top - row * height
        # Columns are counted from the left of the paper, for either direction of x.
        left = high - (column + 1) * width if template.is_below else low + column * width
        name = f"; row {row + 1} of {rows}, column {column + 1} of {columns}: join at the frame"
        box = left, left + width, upper - height, upper
        yield _page(template, box, name=name, edge=NOT_PRINTED)


def _page_count(layout: tuple[int, int, float, float]) -> int:
    columns, rows, _, _ = layout
    return columns * rows


def _page(template: Template, box: Box, *, name: str, edge: float, scale: float = 1.0) -> Figure:
    """Draw a box of the board and the strip below it, within a white edge [mm].

    scale: of the text, larger on a large sheet, which is often viewed on a screen.
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
    for part in template.parts():
        _draw_part(axes, part, template, box, scale=scale)
    if template.grain:
        _draw_grain(axes, template, box, scale=scale)
    _draw_origin(axes, scale=scale)


def _draw_part(axes: Axes, part: GluedPart, template: Template, box: Box, *, scale: float) -> None:
    """Draw the mark, the contact disc and the label of a part."""
    mark, size = ("x", 6.0) if part.style == "dotted" else ("+", 2 * CROSS / POINT)
    axes.plot(*part.at, mark, c="black", ms=size, mew=0.4)
    if part.radius:
        circle = Circle(part.at, part.radius, fill=False, lw=0.7, ls=part.style, gid=part.name)
        axes.add_patch(circle)
    lines = template.label(part)
    distance = 2 + 0.75 * part.radius  # mm, beyond the circle
    right, up = _label_direction(part, distance, lines, template, box, scale=scale)
    axes.annotate(
        "\n".join(lines),
        part.at,
        (right * distance / POINT, up * distance / POINT),
        textcoords="offset points",
        size=LABEL * scale,
        ha="left" if right > 0 else "right",
        va="bottom" if up > 0 else "top",
        annotation_clip=True,
    )


def _draw_origin(axes: Axes, *, scale: float) -> None:
    """Draw the origin, with arrows along x and y."""
    axes.text(-5, -8, "0, 0", size=LABEL * scale, ha="center", va="center", clip_on=True)
    arrow = {"arrowstyle": "<-", "lw": 0.5}
    for name, start, end in (("x", (0, -4), (16, -4)), ("y", (-4, 0), (-4, 16))):
        axes.annotate(
            name,
            start,
            end,
            size=LABEL * scale,
            va="center",
            ha="center",
            annotation_clip=True,
            arrowprops=arrow,
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


def _label_direction(
    part: GluedPart,
    distance: float,
    lines: Sequence[str],
    template: Template,
    box: Box,
    *,
    scale: float,
) -> tuple[int, int]:
    """Return the direction of a part's label, rightwards and upwards on paper (1 or -1).

    The label is on the side of the board's middle, unless the frame is there. distance [mm]: from
    the part to its label.
    """
    x, y = part.at
    low, high, bottom, top = box
    x_sign = -1 if template.is_below else 1  # direction of x on paper
    reach_x = distance + scale * LETTER * max(map(len, lines))
    reach_y = distance + scale * LINE * len(lines)
    inwards = x_sign if x < template.board[0] / 2 else -x_sign
    for right, up in product((inwards, -inwards), (1, -1)):
        end_x = x + x_sign * right * reach_x
        end_y = y + up * reach_y
        if low < end_x < high and bottom < end_y < top:
            return right, up
    return inwards, 1
