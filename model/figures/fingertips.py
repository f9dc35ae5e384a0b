"""Sensation level over the plate, and the fingertips on it."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from model.arrays import lattice
from model.figures.drawing import draw_eras
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import sensation_level
from model.table.question import Point
from model.table.table import LocalizationTable
from model.vibration.excitation import Excitation

_COLORS = "magma"
_SCALE = Normalize(-10.0, 30.0)
"""From barely perceptible to more than strong [dB SL]."""

FELT_COLOR, QUIET_COLOR = "#6dff9c", "#9fdcff"

_SIDE = 121  # points along a side; nulls are narrow


def draw_levels(axes: Axes, table: LocalizationTable, excitation: Excitation) -> None:
    """Draw the sensation level [dB SL] over the plate, and the ERAs; axes in centimetres."""
    x, y = (np.linspace(0, side, _SIDE) for side in (table.plate.length, table.plate.width))
    amplitudes = table.amplitudes(excitation, lattice(x, y))
    level = sensation_level(*amplitudes, table.threshold).reshape(_SIDE, _SIDE)
    axes.pcolormesh(100 * x, 100 * y, level, cmap=_COLORS, shading="gouraud", norm=_SCALE)
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
            )
    if len(frequencies) == 1:
        axes.text(
            *(1, -0.02, f"{frequencies.pop():g} Hz"),
            transform=axes.transAxes,
            ha="right",
            va="top",
            fontsize=9,
        )


def draw_level_scale(figure: Figure, axes: Iterable[Axes], *, shrink: float) -> None:
    """Draw the colour scale of `draw_levels` beside axes, shrunk to a share of their height."""
    figure.colorbar(
        ScalarMappable(_SCALE, _COLORS),
        ax=list(axes),
        label="level above detection threshold / dB SL",
        extend="both",
        shrink=shrink,
    )


def draw_fingertip(
    axes: Axes, place: Point, *, felt: bool, level_db_sl: float | None = None
) -> None:
    """Draw a target or quiet fingertip at x, y [m], with its level [dB SL]."""
    x, y = 100 * place[0], 100 * place[1]
    outline = [withStroke(linewidth=2.5, foreground="black", alpha=0.75)]
    color = FELT_COLOR if felt else QUIET_COLOR
    axes.add_patch(
        Circle(
            (x, y),
            100 * FINGERTIP_RADIUS,
            fill=False,
            color=color,
            lw=2.4 if felt else 1.6,
            path_effects=outline,
        )
    )
    text = "felt" if felt else "quiet"
    if level_db_sl is not None:
        text += f"\n{round(level_db_sl)} dB SL"
    axes.annotate(
        text,
        (x, y),
        xytext=(0, -25 if y > 5 else 25),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=8.5,
        color=color,
        fontweight="bold" if felt else "normal",
        path_effects=outline,
    )
