"""Pictures of the plate as matplotlib figures."""

from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from model.figures.drawing import map_figure
from model.files.array_file import whole_or_nothing
from model.files.replacing import check_picture_name

__all__ = ["map_figure", "save_figure"]

_DPI = 150
_UNDATED = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Metadata with which the same figure is the same bytes."""


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
    with whole_or_nothing(path) as stream, rc_context({"svg.hashsalt": "era"}):
        figure.savefig(stream, dpi=_DPI, format=ending[1:], metadata=_UNDATED.get(ending))
