"""Pictures of a design: contrast over the plate, and by the number of ERAs."""

import numpy as np
from matplotlib.figure import Figure

from model.design.run import Design
from model.figures.drawing import COLORS, draw_eras, label_plate


def contrast_figure(design: Design) -> Figure:
    """Robust felt contrast of fresh contact sets at their contents, a panel by quiet fingers."""
    contents = design.problem.contacts.contents
    plate, judged = design.problem.rig.plate, design.best.answers
    eras = design.problem.eras(design.best.found.positions)
    ratio = plate.width / plate.length
    kinds = judged.kinds
    figure = Figure(figsize=(3.4 * len(kinds) + 1, 3.0 * ratio + 1.2), layout="compressed")
    grid = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    places = np.array([contacts[:contents] for contacts in design.sets])  # (sets, contents, 2)
    ends = np.percentile(judged.contrast_db, [2, 98])
    for axes, quiet in zip(grid, kinds, strict=True):
        chosen = judged.quiet == quiet
        image = axes.scatter(
            *(100 * places[chosen].reshape(-1, 2).T),
            c=np.repeat(judged.contrast_db[chosen], contents),
            cmap=COLORS,
            vmin=ends[0],
            vmax=ends[1],
            s=26,
        )
        draw_eras(axes, eras, active=[era.name for era in eras])
        label_plate(axes)
        axes.set_xlim(0, 100 * plate.length)
        axes.set_ylim(0, 100 * plate.width)
        axes.set_title(f"{quiet} quiet: median {judged.median_db(quiet):.1f} dB")
        axes.label_outer()
    figure.colorbar(image, ax=grid, label="contrast of nine of ten plates / dB")
    return figure


def count_figure(design: Design) -> Figure:
    """Contrast against the number of ERAs, with what each buys."""
    counts = list(design.by_count)
    means = [each.mean_db for each in design.by_count.values()]
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(counts, means, "o-", color="black", label="mean")
    for quiet in design.best.answers.kinds:
        medians = [each.answers.median_db(quiet) for each in design.by_count.values()]
        axes.plot(counts, medians, "--", marker=".", label=f"{quiet} quiet, median")
    for count, low, high in zip(counts[1:], means, means[1:], strict=False):
        axes.annotate(f"{high - low:+.1f}", (count, high), (0, 7), textcoords="offset points")
    axes.set_xlabel("ERAs")
    axes.set_ylabel("contrast of nine of ten plates / dB")
    axes.set_xticks(counts)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
