"""Answers of a table: the level over the plate, and the level and contrast at fingers."""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from model.answer.answer import Answer, Layer
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import Point, lattice
from model.errors import InputError
from model.figures.style import SMALL_TEXT, draw_eras
from model.finger import FINGERTIP_RADIUS, sensation_level
from model.table.table import LocalizationTable
from model.vibration import Excitation

FELT_COLOR, QUIET_COLOR = "#6dff9c", "#9fdcff"

_EXAMPLE = ((0.3, 0.35), (0.8, 0.6), (0.45, 0.85))
"""Fingers of the example answer, as fractions of the plate's length and width."""

_LEVEL_COLORS = "magma"

_SCALE = Normalize(-10.0, 30.0)
"""Levels [dB SL] from barely perceptible to more than strong."""

_SIDE = 121  # points along a side; nulls are narrow

_LABEL_SHARE = 0.3  # of the plate's width; room for a label

_MAX_TONES = 12  # in a title


def answer_figure(table: LocalizationTable) -> Figure:
    """Draw sensation levels and fingers for an example query."""
    plate = table.plate
    target, *quiet = ((u * plate.length, v * plate.width) for u, v in _EXAMPLE)
    answer = None
    with suppress(InputError):  # small plate
        answer = query(table, Placement((target,), tuple(quiet)))
    if answer is None or not answer.is_reached:  # weak rig
        figure = Figure(figsize=(6.6, 5))
        figure.suptitle("The table has no answer for the three fingers of this picture")
        return figure
    figure = layer_figure(table, answer, 0)
    sensation = answer.fingers[0]
    figure.axes[0].set_title(
        f"Felt contrast {sensation.promised_contrast_db:.0f} dB promised, "
        f"{sensation.contrast_db:.0f} dB nominal\n"
        f"{_tones_in_words(table, answer.layers[0])}",
        fontsize=10,
        pad=20,
    )
    return figure


def layer_figure(table: LocalizationTable, answer: Answer, layer_number: int) -> Figure:
    """Draw the level of an answer's layer over the plate, the fingers and the promises."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    layer = answer.layers[layer_number]
    axes.set_axis_off()
    draw_levels(axes, table, layer.excitation)
    positions = [sensation.finger.at for sensation in answer.fingers]
    for number, sensation in enumerate(answer.fingers):
        is_felt = number in layer.fingers
        level = sensation.level_db_sl if is_felt else None
        further = [*positions[:number], *positions[number + 1 :]]
        draw_fingertip(axes, positions[number], felt=is_felt, level_db_sl=level, others=further)
    promised = answer.fingers[layer.fingers[0]].promised_contrast_db
    if promised is not None:
        axes.set_title(
            f"contrast of at least {promised:.0f} dB on 90 % of plates", fontsize=11, pad=20
        )
    draw_level_scale(figure, [axes], table.threshold, shrink=0.8)
    return figure


def _tones_in_words(table: LocalizationTable, layer: Layer) -> str:
    """Format up to twelve tones, two per line."""
    tones = [
        f"{name} {tone['frequency_hz']:g} Hz, level {tone['level']:.3f}, {tone['phase_deg']:.0f}°"
        for name, tone in table.drive_of(layer.excitation).items()
    ]
    lines = ["; ".join(tones[start : start + 2]) for start in range(0, _MAX_TONES, 2)]
    return "\n".join(lines).strip()


def draw_levels(axes: Axes, table: LocalizationTable, excitation: Excitation) -> None:
    """Draw the sensation level [dB SL] over the plate, and the ERAs; axes in centimeters."""
    x = np.linspace(0, table.plate.length, _SIDE)
    y = np.linspace(0, table.plate.width, _SIDE)
    amplitudes = table.amplitudes(excitation, lattice(x, y))
    level = sensation_level(*amplitudes, table.threshold).reshape(_SIDE, _SIDE)
    axes.pcolormesh(100 * x, 100 * y, level, cmap=_LEVEL_COLORS, shading="gouraud", norm=_SCALE)
    axes.set_aspect("equal")
    draw_eras(axes, table.eras, active=excitation.keys())
    frequencies = {tone.frequency for tone in excitation.values()}
    for era in table.eras:
        if era.name not in excitation:
            continue
        is_left = era.x < table.plate.length / 2
        is_high = era.y > table.plate.width / 2
        label = era.name
        if len(frequencies) > 1:
            label += f" {excitation[era.name].frequency:g} Hz"
        axes.annotate(
            label,
            (100 * era.x, 100 * era.y),
            xytext=(0, 9 if is_high else -16),
            textcoords="offset points",
            ha="left" if is_left else "right",
            fontsize=9,
            path_effects=[withStroke(linewidth=2.5, foreground="white", alpha=0.75)],
        )
    if len(frequencies) == 1:
        axes.text(
            0.5,
            -0.02,  # between the names of corner ERAs
            f"{frequencies.pop():g} Hz",
            transform=axes.transAxes,
            ha="center",
            va="top",
            fontsize=9,
        )


def level_label(threshold: str) -> str:
    """Return the label of a scale of levels, with the threshold set to which they are relative."""
    return f"level / dB SL (thresholds: {threshold})"


def draw_level_scale(
    figure: Figure, axes: Iterable[Axes], threshold: str, *, shrink: float
) -> None:
    """Draw the color scale of `draw_levels` next to axes, shrunk to a share of their height.

    threshold: name of the set to which levels are relative.
    """
    figure.colorbar(
        ScalarMappable(_SCALE, _LEVEL_COLORS),
        ax=list(axes),
        label=level_label(threshold),
        extend="both",
        shrink=shrink,
    )


def draw_fingertip(
    axes: Axes,
    position: Point,
    *,
    felt: bool,
    level_db_sl: float | None = None,
    others: Sequence[Point] = (),
) -> None:
    """Draw a fingertip at a position [m], with its level [dB SL]: solid if felt, dashed if quiet.

    others [m]: further fingertips, which the label avoids.
    """
    x, y = 100 * position[0], 100 * position[1]
    outline = [withStroke(linewidth=2.5, foreground="black", alpha=0.75)]
    color = FELT_COLOR if felt else QUIET_COLOR
    circle = Circle(
        (x, y),
        100 * FINGERTIP_RADIUS,
        fill=False,
        color=color,
        lw=2.4 if felt else 1.6,
        ls="-" if felt else "--",
        path_effects=outline,
    )
    axes.add_patch(circle)
    text = "felt" if felt else "quiet"
    if level_db_sl is not None:
        text += f"\n{round(level_db_sl)} dB SL"
    side = _label_side(axes, position, others)
    axes.annotate(
        text,
        (x, y + side * 100 * FINGERTIP_RADIUS),
        xytext=(0, 2 * side),
        textcoords="offset points",
        ha="center",
        va="bottom" if side > 0 else "top",
        fontsize=SMALL_TEXT,
        color=color,
        fontweight="bold" if felt else "normal",
        path_effects=outline,
    )


def _label_side(axes: Axes, position: Point, fingers: Sequence[Point]) -> int:
    """Return whether a fingertip's label is above (1) or below (-1) the fingertip.

    Away from the nearest of the other fingers, but on the plate.
    """
    low, high = axes.get_ylim()  # cm
    height = (100 * position[1] - low) / (high - low)
    if height < _LABEL_SHARE:
        return 1
    if height > 1 - _LABEL_SHARE:
        return -1
    if not fingers:
        return -1
    nearest = min(fingers, key=partial(math.dist, position))
    return 1 if nearest[1] < position[1] else -1
