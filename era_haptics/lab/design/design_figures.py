"""Pictures of a design: contrast over the plate, and against the number of ERAs."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from era_haptics.lab.design.results import Design
from model.arrays import FloatArray
from model.figures.style import COLORS, PAGE_WIDTH, SMALL_TEXT, draw_eras, label_plate
from model.quantities import counted

_COUNT_STYLES = (("--", "s"), ("-.", "^"), (":", "D"))  # line and marker
_COLORED_SHARE = (2, 98)  # percentiles of the contrasts at the ends of the colour scale


def quiet_fingers_figure(design: Design) -> Figure:
    """Draw the promised felt contrast of new contact sets, a panel per number of quiet fingers."""
    plate, kinds = design.problem.rig.plate, design.best.answers.kinds
    width = PAGE_WIDTH if len(kinds) > 1 else PAGE_WIDTH / 2
    panel_width = (width - 1.4) / len(kinds)
    height = panel_width * plate.width / plate.length + 1.1
    figure = Figure(figsize=(width, height), layout="compressed")
    panels = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    contents = design.problem.contacts.contents
    targets = np.array([contacts[:contents] for contacts in design.sets])  # (sets, contents, 2)
    for axes, quiet in zip(panels, kinds, strict=True):
        image = _draw_contrast(axes, design, targets, quiet)
    figure.colorbar(image, ax=panels, label="promised contrast / dB")
    figure.supxlabel("Circles: target fingers. Squares: ERAs.", fontsize=SMALL_TEXT)
    return figure


def _draw_contrast(axes: Axes, design: Design, targets: FloatArray, quiet: int) -> PathCollection:
    """Draw the target fingers of sets with a number of quiet fingers, coloured by contrast.

    targets: (sets, contents, 2) [m]. Returns the image for the colour bar.
    """
    answers, eras = design.best.answers, design.best.eras
    plate = design.problem.rig.plate
    is_drawn = answers.quiet == quiet
    x, y = 100 * targets[is_drawn].reshape(-1, 2).T
    low, high = np.percentile(answers.contrast_db, _COLORED_SHARE)
    colors = np.repeat(answers.contrast_db[is_drawn], targets.shape[1])
    image = axes.scatter(x, y, c=colors, cmap=COLORS, vmin=low, vmax=high, s=20)
    draw_eras(axes, eras, active=[era.name for era in eras])
    label_plate(axes)
    axes.set_xlim(0, 100 * plate.length)
    axes.set_ylim(0, 100 * plate.width)
    fingers = counted(int(quiet), "quiet finger")
    axes.set_title(f"{fingers}: median {answers.median_db(quiet):.1f} dB", fontsize=9)
    axes.label_outer()
    return image


def count_figure(design: Design) -> Figure:
    """Draw contrast against the number of ERAs, and the gain of each."""
    counts = list(design.by_count)
    layouts = list(design.by_count.values())
    means = [layout.mean_db for layout in layouts]
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(counts, means, "o-", color="black", label="mean")
    for number, quiet in enumerate(design.best.answers.kinds):
        medians = [layout.answers.median_db(quiet) for layout in layouts]
        line, marker = _COUNT_STYLES[number % len(_COUNT_STYLES)]
        label = f"{counted(int(quiet), 'quiet finger')}, median"
        axes.plot(counts, medians, line, marker=marker, ms=4, label=label)
    for count, low, high in zip(counts[1:], means, means[1:], strict=False):
        axes.annotate(f"{high - low:+.1f}", (count, high), (0, 7), textcoords="offset points")
    axes.set_xlabel("number of ERAs")
    axes.set_ylabel("promised contrast / dB")
    axes.set_xticks(counts)
    axes.margins(x=0.1)  # room for the last number next to its point
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
