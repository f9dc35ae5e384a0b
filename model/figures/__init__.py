"""Pictures of the plate as matplotlib figures."""

from model.figures.drawing import draw_eras, draw_field, map_figure, save_figure

__all__ = ["draw_eras", "draw_field", "map_figure", "save_figure"]
