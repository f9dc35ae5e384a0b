"""Pictures of the plate as matplotlib figures."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from model.figures.drawing import map_figure
from model.files.array_file import whole_or_nothing
from model.files.replacing import check_picture_name

__all__ = ["map_figure", "save_figure"]

_DPI = 150


def save_figure(figure: Figure, path: Path, *, inches: tuple[float, float] | None = None) -> None:
    """Write a figure in the format of the name's ending, without a display.

    inches: width and height, the figure's own for None. Raises InputError for an ending that is not
    in PICTURE_ENDINGS, and OSError.
    """
    check_picture_name(path)
    FigureCanvasAgg(figure)
    if inches is not None:
        figure.set_size_inches(inches)
    with whole_or_nothing(path) as stream:
        figure.savefig(stream, dpi=_DPI, format=path.suffix[1:].lower())
