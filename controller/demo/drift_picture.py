"""The picture of a drifting hour: contrast over time, and what was said of the plate."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from controller.demo.drift import WAYS, Hour
from model.figures import save_figure

_COLOURS = {"identified": "tab:red", "in service": "tab:blue", "known": "tab:gray"}
_LABELS = {
    "identified": "identified once",
    "in service": "identification in service",
    "known": "plate known",
}
_AROUND = 150.0  # s; of a running median, on each side


def write_drift_picture(hour: Hour, folder: Path) -> Path:
    """Draw an hour into a folder; returns the file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "drift.png"
    save_figure(drift_figure(hour), path)
    return path


def drift_figure(hour: Hour) -> Figure:
    """Draw contrast of each touch as a dot, running medians as lines, events as marks."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.subplots()
    for way in WAYS:
        times, contrasts = np.array(hour.contrasts[way]).reshape(-1, 2).T
        medians = [np.median(contrasts[np.abs(times - at) <= _AROUND]) for at in times]
        axes.plot(times / 60, contrasts, ".", color=_COLOURS[way], alpha=0.25)
        axes.plot(times / 60, medians, color=_COLOURS[way], label=_LABELS[way])
    low, high = axes.get_ylim()
    axes.set_ylim(low - 8, high + 2)  # room for the legend and what was said
    low, high = axes.get_ylim()
    for number, event in enumerate(hour.events):
        is_plate = event.kind == "plate"
        axes.axvline(event.time_s / 60, color="black", lw=1.0 if is_plate else 0.4, ls=":")
        if event.kind != "alarm":
            at = high if is_plate else low + number % 3
            axes.text(
                event.time_s / 60,
                at,
                f" {event.text}",
                fontsize=8,
                va="top" if is_plate else "bottom",
            )
    axes.set_xlim(0, hour.course.duration / 60)
    axes.set_xlabel("time / min")
    axes.set_ylabel("contrast to one quiet finger / dB")
    axes.legend(loc="lower left")
    return figure
