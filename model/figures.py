"""Pictures of the plate, as matplotlib figures."""

from collections.abc import Collection, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from model.actuator import Era
from model.arrays import FloatArray
from model.maps import PlateMap
from model.rig import Rig
from model.vibration import G

COLORS = "viridis"
ACTIVE_COLOR = "#d62728"
RESTING_COLOR = "#2ca02c"


def draw_field(
    axes: Axes, x: FloatArray, y: FloatArray, peak: FloatArray, *, maximum: float | None = None
) -> ScalarMappable:
    """Draw peak acceleration (len(y), len(x)) [m/s²] over the plate in g; axes in centimetres."""
    image = axes.pcolormesh(
        100 * x, 100 * y, peak / G, cmap=COLORS, shading="gouraud", vmin=0, vmax=maximum
    )
    axes.set_aspect("equal")
    axes.set_xlabel("x / cm")
    axes.set_ylabel("y / cm")
    return image


def draw_eras(axes: Axes, eras: Sequence[Era], *, active: Collection[str]) -> None:
    """Mark where ERAs hold the plate: filled and red where driven, green where only holding."""
    for era in eras:
        color = ACTIVE_COLOR if era.name in active else RESTING_COLOR
        axes.plot(
            100 * era.x, 100 * era.y, "o", ms=9, color=color, mec="white", mew=1.5, clip_on=False
        )


def map_figure(rig: Rig, plate_map: PlateMap, *, active: Collection[str], title: str) -> Figure:
    """A map with its ERAs, nulls as red crosses and a colour bar in g (1 g = 9.8 m/s²)."""
    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.add_subplot()
    image = draw_field(axes, plate_map.x, plate_map.y, plate_map.peak)
    axes.plot(*(100 * plate_map.nulls.T), "x", color="red", ms=5, mew=1.2)
    draw_eras(axes, rig.eras, active=active)
    axes.set_title(title)
    figure.colorbar(image, ax=axes, label="peak acceleration / g")
    return figure


def save_figure(figure: Figure, path: Path, *, dpi: int = 150) -> None:
    """Write a figure as PNG; needs no display."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=dpi)
