"""Box plots, each with its layout above it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from model.arrays import FloatArray
from model.figures.drawing import ACTIVE_COLOR, RESTING_COLOR
from model.structure.plate import Plate

BOX_COLOR = "#9ecae1"


@dataclass(frozen=True)
class LayoutBox:
    """One box: label, positions of the ERAs (n, 2) [m], and indices of the active ones.

    five: minimum, quartiles and maximum.
    """

    label: str
    positions: FloatArray
    active: Collection[int]
    five: FloatArray


def layout_boxes_figure(
    plate: Plate, boxes: Sequence[LayoutBox], *, title: str, label: str, over: str
) -> Figure:
    """Boxes side by side, whiskers to minimum and maximum; red ERAs are active.

    label: of the axis; over: what the distribution is over, such as the plate.
    """
    figure = Figure(figsize=(max(6, 1.4 * len(boxes)), 6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1, 4), squeeze=False)[:, 0]
    for axes, box in zip(upper.subplots(1, len(boxes), squeeze=False)[0], boxes, strict=True):
        _draw_layout(axes, plate, box)
    axes = lower.subplots()
    _draw_boxes(axes, boxes)
    axes.set_ylabel(label)
    axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
    axes.set_title(f"boxes: quartiles over {over}; whiskers: minimum and maximum", fontsize=10)
    figure.suptitle(title)
    return figure


def _draw_layout(axes: Axes, plate: Plate, box: LayoutBox) -> None:
    """Draw a small plate with its ERAs."""
    axes.add_patch(Rectangle((0, 0), plate.length, plate.width, fc="0.93", ec="0.4"))
    for era, (x, y) in enumerate(box.positions):
        color = ACTIVE_COLOR if era in box.active else RESTING_COLOR
        axes.plot(x, y, "o", ms=7, color=color, mec="white", mew=1, clip_on=False)
    axes.set_aspect("equal")
    axes.set_xlim(-0.05 * plate.length, 1.05 * plate.length)
    axes.set_ylim(-0.05 * plate.width, 1.05 * plate.width)
    axes.axis("off")


def _draw_boxes(axes: Axes, boxes: Sequence[LayoutBox]) -> None:
    keys = ("whislo", "q1", "med", "q3", "whishi")
    axes.bxp(
        [
            {"label": box.label, "fliers": [], **dict(zip(keys, box.five, strict=True))}
            for box in boxes
        ],
        widths=0.6,
        patch_artist=True,
        showfliers=False,
        boxprops={"facecolor": BOX_COLOR},
        medianprops={"color": "black", "linewidth": 1.5},
    )
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
