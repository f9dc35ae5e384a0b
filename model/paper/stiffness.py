"""The parametric study of ERA stiffness that the paper announces with its Figure 13."""

import numpy as np
from matplotlib.figure import Figure

from model.arrays import FloatArray
from model.files.csv_file import Columns
from model.paper.figure import PaperFigure
from model.paper.pattern_maps import MapSolver, correlation, full_stroke, with_stiffness
from model.paper.printed import FIGURE_13_FREQUENCY, FIGURE_13_STIFFNESS, PAPER_STIFFNESS
from model.reduction.free_plate import FreePlate
from model.rig.layouts import diagonal_pair
from model.rig.rig import Rig
from model.vibration.peak import G

STIFFNESSES = 500.0 * 2 ** (np.arange(61) / 6)
"""Stiffness [N/m], 0.5 to 512 kN/m, six per octave: from nearly free to nearly pinned."""


def stiffness_study_figure(rig: Rig, free_plate: FreePlate) -> PaperFigure:
    """Largest and median peak acceleration against ERA stiffness, diagonal pair at 250 Hz.

    Also the correlation of the map with that at 17 kN/m.
    """
    solve = MapSolver(rig, free_plate)
    drive = full_stroke(rig.eras, diagonal_pair(rig.eras), (FIGURE_13_FREQUENCY,) * 2)

    def peak(stiffness: float) -> FloatArray:
        return solve(with_stiffness(rig.eras, stiffness), drive).peak

    reference = peak(PAPER_STIFFNESS)
    peaks = [peak(stiffness) for stiffness in STIFFNESSES]
    study = {
        "stiffness_n_m": STIFFNESSES,
        "maximum_m_s2": np.array([values.max() for values in peaks]),
        "median_m_s2": np.array([np.median(values) for values in peaks]),
        "correlation": np.array([correlation(values, reference) for values in peaks]),
    }
    alike = STIFFNESSES[study["correlation"] > 0.95]
    shown = [(f"{STIFFNESSES[k] / 1000:g}", k) for k in range(6, 61, 12)]  # every second octave
    return PaperFigure(
        "figure_13_stiffness",
        _draw(study),
        {"": study},
        {
            "maximum_g_by_kn_m": {
                stiffness: float(study["maximum_m_s2"][k] / G) for stiffness, k in shown
            },
            "median_g_by_kn_m": {
                stiffness: float(study["median_m_s2"][k] / G) for stiffness, k in shown
            },
            "correlation_above_0.95_stiffness_n_m": [float(alike.min()), float(alike.max())],
        },
    )


def _draw(study: Columns) -> Figure:
    figure = Figure(figsize=(8, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    stiffness = np.asarray(study["stiffness_n_m"]) / 1000
    upper.plot(stiffness, np.asarray(study["maximum_m_s2"]) / G, label="largest on the plate")
    upper.plot(stiffness, np.asarray(study["median_m_s2"]) / G, label="median over the plate")
    upper.set_ylabel("peak acceleration / g")
    upper.set_yscale("log")
    upper.yaxis.set_major_formatter("{x:g}")
    upper.legend()
    upper.set_title(f"Diagonal pair at {FIGURE_13_FREQUENCY:g} Hz")
    lower.plot(stiffness, np.asarray(study["correlation"]), color="tab:green")
    lower.set_ylabel(f"correlation with\n{PAPER_STIFFNESS / 1000:g} kN/m")
    lower.set_xlabel("ERA stiffness $k_b$ / (kN/m)")
    lower.set_xscale("log")
    lower.xaxis.set_major_formatter("{x:g}")
    for axes in (upper, lower):
        axes.grid(color="0.9")
        for marked in FIGURE_13_STIFFNESS:
            axes.axvline(marked / 1000, color="0.5", linestyle="--", linewidth=1)
    return figure
