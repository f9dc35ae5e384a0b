"""Maps of a plate's acceleration, with its ERAs and nulls."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from model.figures.style import COLORS, PAGE_WIDTH, SMALL_TEXT, TITLE_TEXT, draw_eras, label_plate
from model.rig.rig import Rig
from model.structure.plate import Plate
from model.structure.sources import Source
from model.vibration import NULL_SHARE, Excitation, G, PlateMap

POINTS_ALONG = 97
"""Points of a sampling grid along the longer side: on the paper's plate 60 per shortest wave."""

_MARKS = "Squares: ERAs (orange: driven). White lines: a tenth of the map's maximum."

_MAX_NAMED = 4  # ERAs named in a title


def raster(plate: Plate) -> tuple[int, int]:
    """Return the numbers of evenly spaced points along x and y for drawing a field."""
    step = max(plate.length, plate.width) / (POINTS_ALONG - 1)
    return max(2, round(plate.length / step) + 1), max(2, round(plate.width / step) + 1)


@dataclass(frozen=True)
class MapPanel:
    """A map of a figure, with its title and the names of driven ERAs."""

    title: str
    plate_map: PlateMap
    eras: Sequence[Source]
    active: Collection[str]


def maps_figure(panels: Sequence[MapPanel], *, columns: int, caption: str | None = None) -> Figure:
    """Draw maps side by side on one color scale in g (1 g = 9.8 m/s²), with ERAs.

    White lines surround nulls: on them, the plate moves a tenth of the map's maximum.
    """
    rows = math.ceil(len(panels) / columns)
    width = 6.6 if columns == 1 else PAGE_WIDTH
    panel_width = (width - 1.6) / columns
    ratio = panels[0].plate_map.y[-1] / panels[0].plate_map.x[-1]
    height = rows * (panel_width * ratio + 0.32) + (0.9 if caption else 0.8)
    # A constrained layout would leave gaps between maps of fixed aspect.
    figure = Figure(figsize=(width, height), layout="compressed")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    maximum = max(float(panel.plate_map.peak.max()) for panel in panels) / G
    for axes, panel in zip(grid.flat, panels, strict=True):
        solved = panel.plate_map
        image = axes.pcolormesh(
            100 * solved.x,
            100 * solved.y,
            solved.peak / G,
            cmap=COLORS,
            shading="gouraud",
            vmin=0,
            vmax=maximum,
        )
        label_plate(axes)
        _draw_nulls(axes, solved)
        draw_eras(axes, panel.eras, active=panel.active)
        axes.set_title(panel.title, fontsize=TITLE_TEXT, wrap=True)
        axes.label_outer()
    figure.colorbar(image, ax=grid, label="peak acceleration / g")
    figure.supxlabel(_MARKS, fontsize=SMALL_TEXT, wrap=True)
    if caption:
        figure.suptitle(caption)
    return figure


def _draw_nulls(axes: Axes, solved: PlateMap) -> None:
    """Draw a white contour around the nulls, where the plate moves a tenth of its maximum."""
    level = NULL_SHARE * float(solved.peak.max())
    if not float(solved.peak.min()) < level:
        return
    axes.contour(
        100 * solved.x, 100 * solved.y, solved.peak, levels=[level], colors="white", linewidths=1
    )


def map_figure(rig: Rig, plate_map: PlateMap, *, active: Collection[str], title: str) -> Figure:
    """Draw one map with its ERAs, a white contour around nulls and a color bar in g."""
    return maps_figure([MapPanel(title, plate_map, rig.eras, active)], columns=1)


def drive_title(excitation: Excitation, rig: Rig) -> str:
    """Describe the tones of up to four ERAs, or the number of ERAs and their frequencies.

    Full amplitude and phase zero are not mentioned.
    """
    frequencies = sorted({tone.frequency for tone in excitation.values()})
    if len(excitation) > _MAX_NAMED:
        band = " to ".join(f"{end:g}" for end in dict.fromkeys((frequencies[0], frequencies[-1])))
        return f"{len(excitation)} ERAs at {band} Hz"
    full_levels = {era.name: era.full_level for era in rig.eras}
    tones = []
    for name, tone in excitation.items():
        words = f"{name} at {tone.frequency:g} Hz"
        level = tone.amplitude / full_levels[name]
        if not math.isclose(level, 1.0, rel_tol=1e-6):
            words += f", {100 * level:.3g} % amplitude"
        if tone.phase:
            words += f", phase {math.degrees(tone.phase):.3g}°"
        tones.append(words)
    return "; ".join(tones)
