"""Pictures of the plate as matplotlib figures."""

from model.figures.drawing import map_figure, save_figure

__all__ = ["map_figure", "save_figure"]
