"""Pictures of a table: weak cells, levels, contrast, and a pattern with its fingertips."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from model.answer.answer import Answer, Layer
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray, Point, lattice
from model.errors import InputError
from model.figures.drawing import COLORS, draw_eras, label_plate
from model.finger import FELT_DB_SL, FINGERTIP_RADIUS, Grid, sensation_level
from model.study.contrast_map import ContrastMap
from model.study.overview import Overview
from model.study.weak_cells import WANTED_CONTRAST_DB, WeakCells
from model.table.table import LocalizationTable
from model.vibration import Excitation

_CONTRAST = "promised felt contrast / dB"

# Fingers of the example, in shares of the plate.
_EXAMPLE = ((0.3, 0.35), (0.8, 0.6), (0.45, 0.85))


def table_figures(table: LocalizationTable, overview: Overview) -> Iterator[tuple[str, Figure]]:
    """Draw all pictures, with names."""
    yield "weak_cells", weak_cells_figure(table, overview.cells)
    yield "levels", levels_figure(table)
    yield "contrast", contrast_figure(table, overview)
    yield "answer", answer_figure(table)


def weak_cells_figure(table: LocalizationTable, weak: WeakCells) -> Figure:
    """Draw contrast from each cell to the median other finger and to one in ten."""
    panels = {
        "median other finger": weak.median_db,
        "one other finger in ten (tenth percentile)": weak.tenth_db,
    }
    figure = _cells_figure(
        table, weak.grid, panels, label=_CONTRAST, crossed=(~weak.feasible, weak.weak)
    )
    figure.suptitle(
        f"Mode {table.drive_mode}: felt contrast from each cell to one other finger\n"
        f"(crosses: below {WANTED_CONTRAST_DB:g} dB; dots: ERAs)"
    )
    return figure


def levels_figure(table: LocalizationTable) -> Figure:
    """Draw the highest level of any pattern of one or two ERAs at each cell."""
    levels = table.available_level_db_sl
    title = (
        f"Highest level of one or two ERAs at full stroke\n(crosses: dead, below {FELT_DB_SL:g} "
        "dB SL)"
    )
    dead = levels < FELT_DB_SL
    return _cells_figure(table, table.grid, {title: levels}, label="level / dB SL", crossed=(dead,))


def contrast_figure(table: LocalizationTable, overview: Overview) -> Figure:
    """Draw the distribution of contrast over contact sets of 1, 2 and 3 other fingers."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for others, (promised, _) in enumerate(overview.contrasts, start=1):
        contrasts = np.sort(promised)
        share = 1 - np.arange(len(contrasts)) / max(1, len(contrasts))
        label = f"{others} other{'s' if others > 1 else ''}"
        if len(contrasts):
            label += f": median {np.median(contrasts):.1f} dB"
        axes.step(contrasts, 100 * share, where="pre", label=label)
    axes.axvline(WANTED_CONTRAST_DB, color="0.5", ls=":", lw=1)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 100)
    axes.set_xlabel(_CONTRAST)
    axes.set_ylabel("contact sets with at least this contrast / %")
    axes.grid(color="0.9")
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    axes.set_title(f"Mode {table.drive_mode}: contact sets at least 5 cm apart")
    return figure


def contrast_map_figure(table: LocalizationTable, found: ContrastMap) -> Figure:
    """Draw promised contrast of every place to quiet fingers, drive modes side by side."""
    grid = Grid(len(found.x), len(found.y))
    figure = _cells_figure(table, grid, found.promised_db, label=_CONTRAST)
    for axes in figure.axes[: len(found.promised_db)]:
        for finger in found.quiet:
            draw_fingertip(axes, finger, felt=False)
    return figure


def _cells_figure(
    table: LocalizationTable,
    grid: Grid,
    panels: Mapping[str, FloatArray],
    *,
    label: str,
    crossed: Sequence[NDArray[np.bool_]] = (),
) -> Figure:
    """Draw values of cells, panels side by side on one scale; white without a value, and ERAs.

    crossed: of each panel the cells with crosses.
    """
    count = len(panels)
    figure = Figure(figsize=(5.2 * count + 1.5, 4.8), layout="compressed")
    known = np.concatenate([values[np.isfinite(values)] for values in panels.values()])
    limits = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    x = np.linspace(0, 100 * table.plate.length, grid.nx + 1)
    y = np.linspace(0, 100 * table.plate.width, grid.ny + 1)
    drawn = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    for axes, (title, values) in zip(drawn, panels.items(), strict=True):
        shown = np.ma.masked_invalid(values.reshape(grid.ny, grid.nx))
        image = axes.pcolormesh(x, y, shown, cmap=COLORS, vmin=limits[0], vmax=limits[1])
        axes.add_patch(Rectangle((0, 0), x[-1], y[-1], fill=False, ec="0.4", clip_on=False))
        draw_eras(axes, table.eras, active=[era.name for era in table.eras])
        label_plate(axes)
        axes.set_title(title)
        axes.label_outer()
    for axes, cells in zip(drawn, crossed, strict=False):
        marked = 100 * grid.centres(table.plate)[cells]
        axes.plot(*marked.T, "x", color="white", ms=6, mew=1.5)
    figure.colorbar(image, ax=list(drawn), label=label)
    return figure


def answer_figure(table: LocalizationTable) -> Figure:
    """Draw sensation levels and fingers for an example query."""
    plate = table.plate
    target, *quiet = ((u * plate.length, v * plate.width) for u, v in _EXAMPLE)
    answer = None
    with suppress(InputError):  # small plate
        answer = query(table, Placement((target,), tuple(quiet)))
    if answer is None or not answer.is_reached:  # weak rig
        figure = Figure(figsize=(6.6, 5))
        figure.suptitle("The table has no answer to the three fingers of this picture")
        return figure
    figure, felt = layer_figure(table, answer, 0), answer.fingers[0]
    figure.axes[0].set_title(
        f"Felt contrast {felt.promised_contrast_db:.0f} dB promised, "
        f"{felt.contrast_db:.0f} dB nominal\n"
        f"{_in_words(table, answer.layers[0])}",
        fontsize=10,
        pad=20,
    )
    return figure


def layer_figure(table: LocalizationTable, answer: Answer, number: int) -> Figure:
    """Draw the level of a layer of an answer over the plate, the fingers and what is promised."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes, layer = figure.subplots(), answer.layers[number]
    axes.set_axis_off()
    draw_levels(axes, table, layer.excitation)
    for finger, each in enumerate(answer.fingers):
        is_felt = finger in layer.fingers
        level = each.level_db_sl if is_felt else None
        draw_fingertip(axes, each.finger.at, felt=is_felt, level_db_sl=level)
    promised = answer.fingers[layer.fingers[0]].promised_contrast_db
    if promised is not None:
        axes.set_title(
            f"contrast at least {promised:.0f} dB on nine of ten plates", fontsize=11, pad=20
        )
    draw_level_scale(figure, [axes], shrink=0.8)
    return figure


def _in_words(table: LocalizationTable, layer: Layer) -> str:
    """Format up to twelve tones, two per line."""
    tones = [
        f"{name} {tone['frequency_hz']:g} Hz, level {tone['level']:.3f} at {tone['phase_deg']:.0f}°"
        for name, tone in table.drive_of(layer.excitation).items()
    ]
    return "\n".join("; ".join(tones[start : start + 2]) for start in range(0, 12, 2)).strip()


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
                path_effects=[withStroke(linewidth=2.5, foreground="white", alpha=0.75)],
            )
    if len(frequencies) == 1:
        axes.text(
            *(0.5, -0.02, f"{frequencies.pop():g} Hz"),  # between the names of corner ERAs
            transform=axes.transAxes,
            ha="center",
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
