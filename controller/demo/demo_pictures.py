"""Pictures of a demonstration: some of its touches, and several contents that played together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.demo.touch_rows import TouchRow
from model.answer.answer import Sensation
from model.answer.stimulus import Finger
from model.arrays import ranked_by
from model.figures.answers import draw_fingertip, draw_level_scale, draw_levels
from model.figures.contents import contents_figure
from model.figures.style import PAGE_WIDTH, SMALL_TEXT, save_figure
from model.table.table import LocalizationTable

MAX_PANELS = 6


@dataclass(frozen=True)
class Pictures:
    """Files written; omitted: the reason for each missing picture."""

    files: list[Path]
    omitted: list[str]


def write_pictures(table: LocalizationTable, rows: list[TouchRow], folder: Path) -> Pictures:
    """Draw some of the touches into a folder, and several contents that played together."""
    figures: dict[str, Figure] = {}
    omitted = []
    chosen = choose_rows([row for row in rows if not row.fingers])
    if chosen:
        figures["touches"] = touches_figure(table, chosen)
    else:
        omitted.append("no touches.png: no touch with a vibration of one frequency was measured")
    with_several = [row for row in rows if row.fingers]
    measured = [row for row in with_several if row.measured_level_db_sl is not None]
    if measured:
        figures["contents"] = _several_contents_figure(table, measured)
    elif with_several:
        omitted.append("no contents.png: no touch with several vibrations was measured")
    else:
        omitted.append("no contents.png: no two fingers had their own vibrations simultaneously")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, figure in figures.items():
        file = folder / f"{name}.png"
        save_figure(figure, file)
        files.append(file)
    return Pictures(files, omitted)


def _several_contents_figure(table: LocalizationTable, rows: Sequence[TouchRow]) -> Figure:
    """Draw the row with the most contents, with the measurements at its fingers."""
    row = max(rows, key=lambda row: len(row.contents))
    frequencies = [layer.frequency for layer in row.contents]
    sensations = []
    for finger in row.fingers:
        frequency = finger.frequency_hz
        level = finger.measured_level_db_sl
        sensation = Sensation(
            Finger(finger.at_m),
            finger.verdict,
            layer=frequencies.index(frequency) if frequency in frequencies else None,
            level_db_sl=-math.inf if level is None else level,
            contrast_db=finger.measured_contrast_db,
        )
        sensations.append(sensation)
    return contents_figure(table, row.contents, sensations)


def choose_rows(rows: Sequence[TouchRow]) -> list[TouchRow]:
    """Choose the measured touches of highest contrast, evenly over the number of other fingers.

    One finger alone is shown at most once.
    """
    by_count: dict[int, list[TouchRow]] = {}
    for row in ranked_by(rows, _contrast):
        if row.measured_level_db_sl is not None:
            by_count.setdefault(len(row.quiet), []).append(row)
    by_count[0] = by_count.get(0, [])[:1]
    chosen: list[TouchRow] = []
    for next_rows in zip_longest(*(by_count[count] for count in sorted(by_count))):
        chosen += [row for row in next_rows if row is not None]
    return sorted(chosen[:MAX_PANELS], key=lambda row: len(row.quiet))


def touches_figure(table: LocalizationTable, rows: Sequence[TouchRow]) -> Figure:
    """Draw a panel per touch: level over the plate, fingers and driven ERAs."""
    columns = min(3, len(rows))
    lines = -(-len(rows) // columns)
    panel_width = (PAGE_WIDTH - 1.0) / 3
    height = panel_width * table.plate.width / table.plate.length + 0.7
    size = (panel_width * columns + 1.0, height * lines + 0.2)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, row in zip(panels, rows, strict=False):
        _draw_touch(axes, table, row)
    draw_level_scale(figure, panels, table.threshold, shrink=0.7)
    figure.supxlabel(
        "Level: mean over a felt fingertip, loudest point of a quiet one. Contrast: felt minus "
        "highest quiet level. Orange: driven ERAs.",
        fontsize=SMALL_TEXT,
        wrap=True,
    )
    return figure


def _contrast(row: TouchRow) -> float:
    contrast = row.measured_contrast_db
    return -math.inf if contrast is None else contrast


def _draw_touch(axes: Axes, table: LocalizationTable, row: TouchRow) -> None:
    if row.pattern is not None:
        draw_levels(axes, table, row.pattern.excitation)
    target = row.targets_m[0]
    quiet = [*row.quiet.values()]
    level = row.levels_db_sl.get(row.target_id)
    draw_fingertip(axes, target, felt=True, level_db_sl=level, others=quiet)
    for id, position in row.quiet.items():
        neighbors = [target, *(tip for tip in quiet if tip != position)]
        level = row.levels_db_sl.get(id)
        draw_fingertip(axes, position, felt=False, level_db_sl=level, others=neighbors)
    contrast = row.measured_contrast_db
    promised = row.promised_contrast_db
    title = "single finger" if contrast is None else f"contrast {contrast:.1f} dB"
    if promised is not None:
        title += f"\n(promised {promised:.1f} dB)"
    axes.set_title(title, fontsize=9)
