"""Figures 10 and 11 (box plots): cumulative peak acceleration of layouts of four ERAs."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from model.arrays import FloatArray
from model.choice import best_of
from model.figures.layout_boxes import LayoutBox, layout_boxes_figure
from model.files.csv_file import Columns
from model.paper.figure import PaperFigure
from model.reduction.free_plate import FreePlate
from model.rig.layouts import FOUR_ERA_LAYOUTS, EraLayout, alike
from model.rig.rig import Rig
from model.structure.plate import Plate
from model.vibration.activation import (
    MEDIAN,
    STATISTICS,
    ActivationSet,
    activation_sets,
    cumulative_statistics,
    equal_area_points,
    felt_acceleration,
)
from model.vibration.peak import G

PAPER_FREQUENCIES = np.arange(60.0, 321.0, 10.0)
"""The 27 excitation frequencies [Hz]: 60 to 320 in steps of 10 holds every one the paper names."""


@dataclass(frozen=True)
class _Drive:
    """A layout with one of its activation sets, and STATISTICS (6,) of its acceleration."""

    layout: EraLayout
    active: ActivationSet
    statistics: FloatArray


def one_era_figure(rig: Rig, free_plate: FreePlate) -> PaperFigure:
    """Figure 10: one active ERA, for each layout that of the highest median."""
    drives = _drives(rig, free_plate, active_count=1)
    best = _best(drives)
    return PaperFigure(
        "figure_10",
        _draw(rig.plate, best, title="One active ERA (red) in seven layouts"),
        {"": _columns(drives)},
        _findings(best),
    )


def two_era_figure(rig: Rig, free_plate: FreePlate) -> PaperFigure:
    """Figure 11, box plots: two active ERAs, for each layout the pair of the highest median."""
    single = _best(_drives(rig, free_plate, active_count=1))
    drives = _drives(rig, free_plate, active_count=2)
    best = _best(drives)
    gain = {
        two.layout.name: float(two.statistics[MEDIAN] / one.statistics[MEDIAN])
        for one, two in zip(single, best, strict=True)
    }
    return PaperFigure(
        "figure_11_boxplots",
        _draw(rig.plate, best, title="Two active ERAs (red) in seven layouts"),
        {"": _columns(drives)},
        _findings(best) | {"median_two_to_one_era_ratio": gain},
    )


def _drives(rig: Rig, free_plate: FreePlate, *, active_count: int) -> list[_Drive]:
    """Activation sets of `active_count` ERAs of each named layout; ERAs like the rig's first."""
    points = equal_area_points(rig.plate, frequency_max=float(PAPER_FREQUENCIES[-1]))
    felt = felt_acceleration(PAPER_FREQUENCIES)
    drives = []
    for layout in FOUR_ERA_LAYOUTS:
        eras = alike(rig.eras[0], layout.positions(rig.plate))
        acceleration = free_plate.acceleration(eras, PAPER_FREQUENCIES, points, loads=rig.masses)
        statistics = cumulative_statistics(acceleration, felt=felt)
        drives += [
            _Drive(layout, active, row)
            for active, row in zip(activation_sets(len(eras)), statistics, strict=True)
            if len(active) == active_count
        ]
    return drives


def _best(drives: list[_Drive]) -> list[_Drive]:
    """The drive of the highest median for each layout."""
    return [
        max(
            (drive for drive in drives if drive.layout == layout),
            # Rounded: of drives equal by symmetry the first.
            key=lambda drive: float(f"{drive.statistics[MEDIAN]:.6g}"),
        )
        for layout in FOUR_ERA_LAYOUTS
    ]


def _findings(best: list[_Drive]) -> dict[str, str | float | dict[str, float]]:
    medians = {drive.layout.name: float(drive.statistics[MEDIAN] / G) for drive in best}
    return {
        "median_g": medians,
        "highest_median_layout": list(medians)[best_of(list(medians.values()))],
        "unfelt_share": {drive.layout.name: float(drive.statistics[-1]) for drive in best},
    }


def _columns(drives: list[_Drive]) -> Columns:
    statistics = np.array([drive.statistics for drive in drives])
    return {
        "layout": [drive.layout.name for drive in drives],
        "active_eras": ["+".join(str(era + 1) for era in drive.active) for drive in drives],
        "era_fractions": [
            " ".join(f"({x:.4g};{y:.4g})" for x, y in drive.layout.places) for drive in drives
        ],
        **{
            f"{name.replace(' ', '_')}_m_s2": statistics[:, column]
            for column, name in enumerate(STATISTICS[:-1])
        },
        "unfelt_share": statistics[:, -1],
    }


def _draw(plate: Plate, best: list[_Drive], *, title: str) -> Figure:
    boxes = [
        LayoutBox(
            drive.layout.name.replace(" ", "\n"),
            drive.layout.positions(plate),
            drive.active,
            drive.statistics[:5] / G,
        )
        for drive in best
    ]
    return layout_boxes_figure(
        plate,
        boxes,
        title=f"{title}: peak accelerations added up over 27 frequencies",
        label="cumulative peak acceleration / g",
        over="the plate",
    )
