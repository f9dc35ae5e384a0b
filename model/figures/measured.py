"""What was measured, beside the rig before and after a calibration and beside promises."""

import numpy as np
from matplotlib.figure import Figure

from model.calibration.calibrate import Calibration
from model.figures.drawing import ACTIVE_COLOR
from model.study.promise_at_sensors import MeasuredVerification

_ROWS = 2  # of sensors


def calibration_figure(calibration: Calibration) -> Figure:
    """Draw magnitudes over frequency, a panel for each of up to eight pairs of ERA and sensor."""
    eras = [
        number
        for number, era in enumerate(calibration.rig.eras)
        if era.name not in calibration.dead_eras
        and np.isfinite(calibration.measured[:, number]).any()
    ][:4]
    sensors = np.linspace(0, len(calibration.sensors) - 1, _ROWS).round().astype(int)
    figure = Figure(figsize=(3.2 * len(eras), 2.6 * _ROWS + 0.6), layout="constrained")
    axes = figure.subplots(_ROWS, len(eras), sharex=True, sharey=True, squeeze=False)
    size = 1e-6  # m, base displacement
    for row, sensor in enumerate(sensors):
        for column, era in enumerate(eras):
            axis = axes[row, column]
            for label, values, style in (
                ("rig as it was", calibration.before, {"color": "0.6", "linewidth": 1.2}),
                ("calibrated", calibration.after, {"color": "C0", "linewidth": 1.4}),
                ("measured", calibration.measured, {"color": "C3", "marker": ".", "ls": "none"}),
            ):
                magnitude = size * np.abs(values[:, era, sensor])
                axis.semilogy(calibration.frequencies, magnitude, label=label, **style)
            axis.set_title(
                f"{calibration.rig.eras[era].name} to {calibration.sensors[sensor]}", fontsize=9
            )
            axis.grid(True, which="both", alpha=0.2)
    for axis in axes[-1]:
        axis.set_xlabel("frequency / Hz")
    for axis in axes[:, 0]:
        axis.set_ylabel("m/s² per µm of base")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=9)
    return figure


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
