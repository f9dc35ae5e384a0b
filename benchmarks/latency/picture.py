"""Picture of the latencies: histograms and exceedance."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.latency.run import Found

OURS, PLAIN, TERMINAL = "#d62728", "#1f77b4", "#2ca02c"
MIN_SHOWN, MAX_SHOWN = 0.03, 100.0  # ms
SHARES = (0.5, 0.01, 0.001)  # of longer latencies, for the three targets


def draw(found: Sequence[Found], file: Path, *, targets: Sequence[float]) -> None:
    """Left histograms of the loaded cases over TCP; right the share of longer ones, all cases.

    targets [ms]: median, 99th percentile, 99.9th.
    """
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    edges = np.geomspace(MIN_SHOWN, MAX_SHOWN, 100)
    for one in found:
        color = PLAIN if one.own is None else OURS if one.case.wire == "tcp" else TERMINAL
        times = np.sort(1e3 * one.matched.newest)
        share = 1 / max(1, len(times))
        if one.case.is_loaded and one.case.wire == "tcp":
            weights = np.full(len(times), 100 * share)
            kept = np.clip(times, MIN_SHOWN, MAX_SHOWN)
            left.hist(kept, edges, weights=weights, color=color, alpha=0.6, label=one.case.name)
        style = "-" if one.case.is_loaded else ":"
        longer = 1 - share * np.arange(len(times))
        right.plot(times, longer, style, color=color, lw=1.5, label=one.case.name)
    right.plot(targets, SHARES, "kv", ms=6, label="targets")
    left.set(xscale="log", xlim=(MIN_SHOWN, MAX_SHOWN), ylabel="share of commands / %")
    right.set(
        xscale="log", yscale="log", xlim=(MIN_SHOWN, MAX_SHOWN), ylabel="share that is longer"
    )
    for axes in (left, right):
        axes.set_xlabel("touch sent to last byte on the wire / ms")
        axes.grid(alpha=0.3)
        axes.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    left.legend(fontsize=8)
    named = right.get_legend_handles_labels()
    figure.legend(*named, loc="outside lower right", ncols=3, fontsize=8)  # off the curves
    file.parent.mkdir(exist_ok=True)
    figure.savefig(file, dpi=110)
