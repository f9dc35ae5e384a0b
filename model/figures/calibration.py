"""Responses of a calibration: measurement, rig file and calibrated rig."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from model.estimate.calibration_result import Calibration
from model.figures.style import PAGE_WIDTH, SMALL_TEXT, TITLE_TEXT

_ROWS = 2  # of panels, one for each sensor

_MAX_COLUMNS = 4  # of panels, one for each ERA


def calibration_figure(calibration: Calibration) -> Figure:
    """Draw magnitudes over frequency, a panel for each of up to eight pairs of ERA and sensor."""
    measured_eras = [
        number
        for number, era in enumerate(calibration.rig.eras)
        if era.name not in calibration.dead_eras
        and np.isfinite(calibration.measured[:, :, number]).any()
    ]
    eras = measured_eras[:_MAX_COLUMNS]
    last_sensor = len(calibration.measurement.names) - 1
    sensors = np.linspace(0, last_sensor, _ROWS).round().astype(int)
    width = max(PAGE_WIDTH * len(eras) / _MAX_COLUMNS, PAGE_WIDTH / 2)
    figure = Figure(figsize=(width, 4.4), layout="constrained")
    grid = figure.subplots(_ROWS, len(eras), sharex=True, sharey=True, squeeze=False)
    for row, sensor in enumerate(sensors):
        for column, era in enumerate(eras):
            _draw_responses(grid[row, column], calibration, sensor=sensor, era=era)
    figure.supxlabel("frequency / Hz", fontsize=TITLE_TEXT)
    figure.supylabel("response / (m/s² per µm)", fontsize=TITLE_TEXT)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=9)
    return figure


def _draw_responses(axes: Axes, calibration: Calibration, *, sensor: int, era: int) -> None:
    """Draw the responses of a sensor to an ERA: rig file, calibrated rig and measurement."""
    base_displacement = 1e-6  # m
    curves: tuple[tuple[str, NDArray[Any], dict[str, Any]], ...] = (
        ("rig file", calibration.before, {"color": "0.55", "lw": 1.0, "ls": "--"}),
        ("calibrated rig", calibration.after, {"color": "#0072b2", "lw": 1.2}),
        ("measured", calibration.measured, {"color": "#d55e00", "marker": ".", "ls": "none"}),
    )
    frequencies = calibration.measurement.frequencies
    for label, responses, style in curves:
        magnitude = base_displacement * np.abs(responses[:, sensor, era])
        axes.semilogy(frequencies, magnitude, label=label, ms=4, **style)
    era_name = calibration.rig.eras[era].name
    sensor_name = calibration.measurement.names[sensor]
    axes.set_title(f"ERA {era_name}, sensor {sensor_name}", fontsize=9)
    axes.tick_params(labelsize=SMALL_TEXT)
    axes.grid(True, which="both", alpha=0.2)
