"""Style of all pictures: colors, sizes, ERA marks, axis labels, and file formats."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from model.files.array_file import whole_or_nothing
from model.files.output_paths import check_picture_name
from model.structure.sources import Source

COLORS = "viridis"

ACTIVE_COLOR = "#d55e00"
RESTING_COLOR = "white"
"""Colors of driven and of resting ERAs, which also differ in brightness."""

PAGE_WIDTH = 8.0
"""Width of figures with several panels [in]. A page shows it in 700 pixels: 8 pt are 10 pixels."""

SMALL_TEXT, TITLE_TEXT = 8.0, 10.0
"""Font sizes [pt] of labels and of panel titles."""

DPI = 150

_UNDATED = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Metadata that make files of equal figures identical."""


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


def label_plate(axes: Axes) -> None:
    """Label axes in centimeters, of equal scale."""
    axes.set_aspect("equal")
    axes.tick_params(labelsize=SMALL_TEXT)
    axes.set_xlabel("x / cm", fontsize=SMALL_TEXT)
    axes.set_ylabel("y / cm", fontsize=SMALL_TEXT)


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
