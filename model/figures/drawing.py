"""Fields over the plate with marks for ERAs and nulls."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from model.rig.rig import Rig
from model.structure.attachments import Source
from model.structure.plate import Plate
from model.vibration import G, PlateMap

COLORS = "viridis"
ACTIVE_COLOR = "#d62728"
RESTING_COLOR = "#2ca02c"

POINTS_ALONG = 97


def raster(plate: Plate) -> tuple[int, int]:
    """Numbers of evenly spaced points along x and y for drawing a field.

    POINTS_ALONG the longer side: on the paper's plate 60 per shortest wave of its figures.
    """
    step = max(plate.length, plate.width) / (POINTS_ALONG - 1)
    return max(2, round(plate.length / step) + 1), max(2, round(plate.width / step) + 1)


def draw_eras(
    axes: Axes, eras: Sequence[Source], *, active: Collection[str], size: float = 9
) -> None:
    """Mark ERAs, red if driven and green if not; axes in centimetres, size in points."""
    for era in eras:
        color = ACTIVE_COLOR if era.name in active else RESTING_COLOR
        place = (100 * era.x, 100 * era.y)
        axes.plot(*place, "o", ms=size, color=color, mec="white", mew=1.5, clip_on=False)


@dataclass(frozen=True)
class MapPanel:
    """One map of a figure with its title and the names of driven ERAs."""

    title: str
    plate_map: PlateMap
    eras: Sequence[Source]
    active: Collection[str]


def maps_figure(panels: Sequence[MapPanel], *, columns: int, caption: str | None = None) -> Figure:
    """Maps side by side on one colour scale in g (1 g = 9.8 m/s²), with ERAs and nulls marked."""
    rows = -(-len(panels) // columns)
    width = 7.0 if columns == 1 else 3.6 * columns + 1
    ratio = panels[0].plate_map.y[-1] / panels[0].plate_map.x[-1]
    height = rows * (0.8 * width / columns * ratio + 0.8) + (0.5 if caption else 0.1)
    # A constrained layout would leave gaps between maps of fixed aspect.
    figure = Figure(figsize=(width, height), layout="compressed")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    maximum = max(float(panel.plate_map.peak.max()) for panel in panels) / G
    for axes, panel in zip(grid.flat, panels, strict=True):
        solved = panel.plate_map
        colours = {"cmap": COLORS, "shading": "gouraud", "vmin": 0, "vmax": maximum}
        image = axes.pcolormesh(100 * solved.x, 100 * solved.y, solved.peak / G, **colours)
        label_plate(axes)
        axes.plot(*(100 * solved.nulls.T), "x", color="red", ms=5, mew=1.2, clip_on=False)
        draw_eras(axes, panel.eras, active=panel.active)
        axes.set_title(panel.title)
        axes.label_outer()
    figure.colorbar(image, ax=grid, label="peak acceleration / g")
    if caption:
        figure.suptitle(caption)
    return figure


def map_figure(rig: Rig, plate_map: PlateMap, *, active: Collection[str], title: str) -> Figure:
    """One map with its ERAs, nulls as red crosses and a colour bar in g."""
    return maps_figure([MapPanel(title, plate_map, rig.eras, active)], columns=1)


def label_plate(axes: Axes) -> None:
    """Label axes in centimetres, of equal scale."""
    axes.set_aspect("equal")
    axes.set_xlabel("x / cm")
    axes.set_ylabel("y / cm")
