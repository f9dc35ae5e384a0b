"""Pictures of a table: weak cells, levels, contrast, and an answer with its fingertips."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.figures.answers import answer_figure, draw_fingertip, level_label
from model.figures.style import COLORS, TITLE_TEXT, draw_eras, label_plate
from model.finger import FELT_DB_SL, Grid
from model.study.contrast_maps import ContrastMap
from model.study.overview import Overview
from model.study.weak_cells import WANTED_CONTRAST_DB, WeakCells
from model.table.table import LocalizationTable

_CONTRAST = "promised felt contrast / dB"

_LINE_STYLES = ("-", "--", "-.")


def table_figures(table: LocalizationTable, overview: Overview) -> Iterator[tuple[str, Figure]]:
    """Yield all pictures of a table with their names."""
    yield "weak_cells", weak_cells_figure(table, overview.cells)
    yield "levels", levels_figure(table)
    yield "contrast", contrast_figure(table, overview)
    yield "answer", answer_figure(table)


def weak_cells_figure(table: LocalizationTable, weak: WeakCells) -> Figure:
    """Draw the contrast from each cell to the median other finger, and the tenth percentile."""
    panels = {
        "other finger: median position": weak.median_db,
        "other finger: 10th percentile": weak.tenth_db,
    }
    figure = _cells_figure(
        table, weak.grid, panels, label=_CONTRAST, crossed=(~weak.feasible, weak.weak)
    )
    figure.suptitle(
        f"Drive mode {table.drive_mode}: contrast of a target in each cell to one other finger\n"
        f"(crosses: below {WANTED_CONTRAST_DB:g} dB; squares: ERAs)",
        fontsize=TITLE_TEXT,
    )
    return figure


def levels_figure(table: LocalizationTable) -> Figure:
    """Draw the highest level at each cell that one or two ERAs can reach."""
    levels = table.available_level_db_sl
    title = (
        "Maximum level with one or two ERAs at full amplitude\n"
        f"(crosses: below {FELT_DB_SL:g} dB SL; squares: ERAs)"
    )
    dead = levels < FELT_DB_SL
    label = level_label(table.threshold)
    return _cells_figure(table, table.grid, {title: levels}, label=label, crossed=(dead,))


def contrast_figure(table: LocalizationTable, overview: Overview) -> Figure:
    """Draw the distribution of contrast over contact sets of 1, 2 and 3 other fingers."""
    figure = Figure(figsize=(6.0, 3.9), layout="constrained")
    axes = figure.subplots()
    for quiet_count, (promised, _) in enumerate(overview.contrasts, start=1):
        contrasts = np.sort(promised)
        share = 1 - np.arange(len(contrasts)) / max(1, len(contrasts))
        label = f"{quiet_count}"
        if len(contrasts):
            label += f": median {np.median(contrasts):.1f} dB"
        style = _LINE_STYLES[(quiet_count - 1) % len(_LINE_STYLES)]
        axes.step(contrasts, 100 * share, where="pre", ls=style, lw=1.8, label=label)
    wanted = f"{WANTED_CONTRAST_DB:g} dB"
    axes.axvline(WANTED_CONTRAST_DB, color="0.4", ls=":", lw=1.2, label=wanted)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 100)
    axes.set_xlabel(_CONTRAST)
    axes.set_ylabel("contact sets with at least this contrast / %")
    axes.grid(color="0.9")
    axes.legend(loc="upper right", fontsize=9, title="other fingers")
    axes.set_title(f"Drive mode {table.drive_mode}: contacts at least 5 cm apart", fontsize=11)
    return figure


def contrast_map_figure(table: LocalizationTable, contrast_map: ContrastMap) -> Figure:
    """Draw promised contrast of every position to quiet fingers, drive modes side by side."""
    grid = Grid(len(contrast_map.x), len(contrast_map.y))
    promised = contrast_map.promised_db
    figure = _cells_figure(table, grid, promised, label=_CONTRAST)
    for axes in figure.axes[: len(promised)]:
        for finger in contrast_map.quiet:
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
    """Draw the values of cells, panels side by side on one scale, and ERAs.

    Cells without a value are white. crossed: cells with crosses, by panel.
    """
    count = len(panels)
    width = 6.2 if count == 1 else 7.2
    ratio = table.plate.width / table.plate.length
    figure = Figure(figsize=(width, (width - 1.6) / count * ratio + 1.2), layout="compressed")
    finite = np.concatenate([values[np.isfinite(values)] for values in panels.values()])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    x = np.linspace(0, 100 * table.plate.length, grid.nx + 1)
    y = np.linspace(0, 100 * table.plate.width, grid.ny + 1)
    all_axes = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    for axes, (title, values) in zip(all_axes, panels.items(), strict=True):
        masked = np.ma.masked_invalid(values.reshape(grid.ny, grid.nx))
        image = axes.pcolormesh(x, y, masked, cmap=COLORS, vmin=low, vmax=high)
        axes.add_patch(Rectangle((0, 0), x[-1], y[-1], fill=False, ec="0.4", clip_on=False))
        draw_eras(axes, table.eras, active=[era.name for era in table.eras])
        label_plate(axes)
        axes.set_title(title, fontsize=TITLE_TEXT)
        axes.label_outer()
    rim = [withStroke(linewidth=3, foreground="black")]  # white alone is lost on yellow
    for axes, cells in zip(all_axes, crossed, strict=False):
        centers = 100 * grid.centers(table.plate)[cells]
        axes.plot(*centers.T, "x", color="white", ms=6, mew=1.5, path_effects=rim)
    figure.colorbar(image, ax=list(all_axes), label=label)
    return figure
