"""Templates: the board in real size with the places of what is glued to it, to print and stick on.

Lengths are millimetres. A template of the underside is mirrored left to right, its letters are not.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product
from math import ceil, prod
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from model.config.fields import LENGTH, quantity
from model.figures import save_figure
from model.files.array_file import whole_or_nothing
from model.rig.rig import Rig

MM_PER_INCH = 25.4
POINT = MM_PER_INCH / 72
BORDER, STRIP = 12.0, 22.0
"""Paper around the board [mm], and below it, with a ruler."""
RULER = 100  # mm
A4 = (210.0, 297.0), (297.0, 210.0)  # mm; upright and across
NOT_PRINTED = 8.0  # mm; edges of a page that printers leave white
CROSS = 6.0  # mm; half of it
LETTER, LINE = 1.6, 3.2  # mm, of labels
GRAIN = 40.0  # mm; length of the arrow

Box = tuple[float, float, float, float]
"""Least and greatest x, least and greatest y [mm]."""


@dataclass(frozen=True)
class Template:
    """A board to be drawn in real size.

    sensors: places [m] by name; is_below: as seen from below, where actuators are glued.
    """

    rig: Rig
    sensors: Mapping[str, tuple[float, float]]
    is_below: bool = True

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
        """Its direction, of a board that has one."""
        if self.rig.plate.material.orthotropy is None:
            return None
        return (0.0, 1.0) if self.rig.grain == "width" else (1.0, 0.0)

    @property
    def title(self) -> str:
        """What is seen."""
        length, width = self.board
        side = "below, for the underside" if self.is_below else "above, for the touched side"
        return f"{length:g} x {width:g} mm, seen from {side}; places x, y in mm"

    def label(self, name: str, at: tuple[float, float]) -> list[str]:
        """Lines beside a place: its name, of an actuator its output, and where it is."""
        channel = self.rig.wiring.get(name)
        output = f", output {channel.number + 1}" if channel else ""
        return [f"{name}{output}", f"{at[0]:.1f}, {at[1]:.1f}"]

    def places(self) -> Iterator[tuple[str, tuple[float, float], float, str]]:
        """Yield name, place and radius [mm], and the style of the circle, of all that is glued."""
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
        save_figure(_page(template, template.paper, name="", edge=0.0), path)
        return 1
    pages = [*_pages(template)]
    # The same bytes for the same rig.
    with whole_or_nothing(path) as stream, PdfPages(stream, metadata={"CreationDate": None}) as pdf:
        for page in pages:
            pdf.savefig(page)
    return len(pages)


def _pages(template: Template) -> Iterator[Figure]:
    """Yield A4 pages of the way round that takes fewer of them, from the top left on."""
    low, high, bottom, top = template.paper
    sizes = [(width - 2 * NOT_PRINTED, height - NOT_PRINTED - STRIP) for width, height in A4]
    counts = [
        (ceil((high - low) / width), ceil((top - bottom) / height)) for width, height in sizes
    ]
    pages, (across, down) = min(zip(counts, sizes, strict=True), key=lambda each: prod(each[0]))
    columns, rows = pages
    for row, column in product(range(rows), range(columns)):
        upper = top - row * down
        # Columns are counted as they lie, whichever way x runs.
        left = high - (column + 1) * across if template.is_below else low + column * across
        name = f"; row {row + 1} of {rows}, column {column + 1} of {columns}: join at the frame"
        box = left, left + across, upper - down, upper
        yield _page(template, box, name=name, edge=NOT_PRINTED)


def _page(template: Template, box: Box, *, name: str, edge: float) -> Figure:
    """Draw a box of the board and the strip below it, within a white edge [mm]."""
    low, high, bottom, top = box
    width, height = high - low + 2 * edge, top - bottom + edge + STRIP
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    area = edge / width, STRIP / height, (high - low) / width, (top - bottom) / height
    axes = figure.add_axes(area)
    _draw(axes, template, box)
    if name:
        axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, fill=False, lw=0.3))
    strip = figure.add_axes((0, 0, 1, STRIP / height), xlim=(0, width), ylim=(0, STRIP))
    strip.set_axis_off()
    for tick in range(0, RULER + 1, 10):
        strip.plot([BORDER + tick] * 2, [12, 17 if tick % 50 == 0 else 15], c="black", lw=0.5)
    strip.plot([BORDER, BORDER + RULER], [12, 12], c="black", lw=0.5, gid="ruler")
    strip.text(BORDER, 7, template.title, size=8)
    strip.text(BORDER, 3, f"{RULER} mm on paper, or print again at 100 %{name}", size=8)
    return figure


def _draw(axes: Axes, template: Template, box: Box) -> None:
    """Draw what of the board lies in a box, which fills the axes."""
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
        (right, up), away = _beside((x, y), radius, lines, template, box)
        axes.annotate(
            "\n".join(lines),
            (x, y),
            (right * away / POINT, up * away / POINT),
            textcoords="offset points",
            size=7,
            ha="left" if right > 0 else "right",
            va="bottom" if up > 0 else "top",
            annotation_clip=True,
        )
    if template.grain:  # an arrow at the lower end of what is seen of the board
        dx, dy = (GRAIN / 2 * each for each in template.grain)
        x, y = (max(low, 0) + min(high, length)) / 2, max(bottom, 0) + CROSS + dy
        arrow = {"arrowstyle": "<->", "lw": 0.7, "color": "0.6"}
        axes.annotate("", (x - dx, y - dy), (x + dx, y + dy), arrowprops=arrow)
        axes.annotate("grain", (x, y), (3, 3), textcoords="offset points", size=8, color="0.6")
    axes.text(-5, -8, "0, 0", size=8, ha="center", clip_on=True)
    pointing: dict[str, Any] = {"arrowprops": {"arrowstyle": "<-", "lw": 0.5}}
    for name, start, end in (("x", (0, -4), (16, -4)), ("y", (-4, 0), (-4, 16))):
        axes.annotate(
            name, start, end, size=8, va="center", ha="center", annotation_clip=True, **pointing
        )


def _beside(
    at: tuple[float, float], radius: float, lines: Sequence[str], template: Template, box: Box
) -> tuple[tuple[int, int], float]:
    """Where a label is: rightwards and upwards on paper, 1 or -1; its distance [mm].

    On the side of the board's middle, unless a frame is there.
    """
    (x, y), (low, high, bottom, top) = at, box
    across = -1 if template.is_below else 1
    wide, tall = LETTER * max(map(len, lines)), LINE * len(lines)
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
