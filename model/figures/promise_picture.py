"""A picture of what a table promised to accelerometers, and what they measured."""

import numpy as np
from matplotlib.figure import Figure

from model.figures.drawing import ACTIVE_COLOR
from model.table.promise_at_sensors import MeasuredVerification


def promise_figure(found: MeasuredVerification) -> Figure:
    """Draw measured over promised felt contrast; what is below the line breaks its promise."""
    promised = np.array([each.promise.contrast_db for each in found.measured])
    measured = np.array([each.contrast_db for each in found.measured])
    quiet = np.array([len(each.promise.sensors) - 1 for each in found.measured])
    figure = Figure(figsize=(5, 4.6), layout="constrained")
    axes = figure.subplots()
    both = np.concatenate([promised, measured])
    ends = [float(both.min()) - 1, float(both.max()) + 1]
    axes.plot(ends, ends, color="grey", linewidth=1)
    for count, marker in zip(np.unique(quiet), "os^Dv", strict=False):
        chosen = quiet == count
        colors = np.where(measured[chosen] < promised[chosen], ACTIVE_COLOR, "black")
        axes.scatter(
            promised[chosen],
            measured[chosen],
            c=colors,
            marker=marker,
            s=18,
            label=f"{count} quiet",
        )
    axes.legend(loc="upper left")
    axes.set_xlabel("promised felt contrast, dB (nine of ten plates)")
    axes.set_ylabel("measured, dB")
    axes.set_title(f"{100 * found.kept_share:.0f} % of {len(promised)} promises kept")
    return figure
