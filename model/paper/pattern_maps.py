"""Figures 11 (maps), 12 and 13: peak acceleration over the plate, and its nulls."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from model.arrays import FloatArray
from model.figures.drawing import MapPanel, maps_figure, raster
from model.files.csv_file import Columns
from model.paper.figure import PaperFigure
from model.paper.printed import (
    FIGURE_11_FREQUENCY,
    FIGURE_12_FREQUENCIES,
    FIGURE_13_FREQUENCY,
    FIGURE_13_STIFFNESS,
)
from model.reduction.free_plate import FreePlate
from model.rig.layouts import diagonal_pair, edge_pair
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.vibration.excitation import Excitation, Tone
from model.vibration.maps import PlateMap, plate_map
from model.vibration.peak import NULL_SHARE, G

NEARLY_STILL = 0.3
"""Share of its maximum below which the paper counts a point of a switched pattern as still."""


@dataclass(frozen=True)
class MapSolver:
    """Solver of maps of a rig's plate on any ERAs, on the raster of all figures."""

    rig: Rig
    free_plate: FreePlate

    def __call__(self, eras: Sequence[Era], excitation: Excitation) -> PlateMap:
        """Solve the map of an excitation of these ERAs."""
        rig = replace(self.rig, eras=tuple(eras))
        return plate_map(rig, excitation, raster=raster(rig.plate), free=self.free_plate)


def activation_maps_figure(rig: Rig, free_plate: FreePlate) -> PaperFigure:
    """Figure 11, maps: two ERAs on an edge and two on a diagonal, both at 110 Hz."""
    solve = MapSolver(rig, free_plate)
    panels = [
        _panel(
            solve, rig.eras, pair, (FIGURE_11_FREQUENCY,) * 2, title=f"{letter} {what}: {{names}}"
        )
        for letter, what, pair in (
            ("(a)", "same edge", edge_pair(rig.eras)),
            ("(b)", "diagonal", diagonal_pair(rig.eras)),
        )
    ]
    edge, diagonal = (panel.plate_map for panel in panels)
    return PaperFigure(
        "figure_11_maps",
        maps_figure(panels, columns=2, caption=f"Two ERAs at {FIGURE_11_FREQUENCY:g} Hz"),
        {"": _columns({"edge": edge, "diagonal": diagonal})},
        {
            "edge_maximum_g": float(edge.peak.max() / G),
            "diagonal_maximum_g": float(diagonal.peak.max() / G),
            "maximum_edge_to_diagonal_ratio": float(edge.peak.max() / diagonal.peak.max()),
            "edge_null_count": len(edge.nulls),
            "diagonal_null_count": len(diagonal.nulls),
            "edge_nulls_kept_on_diagonal_share": _shared(edge, diagonal),
        },
    )


def switched_patterns_figure(rig: Rig, free_plate: FreePlate) -> PaperFigure:
    """Figure 12: the diagonal pair at six switched pairs of frequencies."""
    solve = MapSolver(rig, free_plate)
    pair = diagonal_pair(rig.eras)
    panels = [
        _panel(solve, rig.eras, pair, frequencies, title=f"({letter}) {{tones}}")
        for letter, frequencies in zip("abcdef", FIGURE_12_FREQUENCIES, strict=True)
    ]
    maps = [panel.plate_map for panel in panels]
    still = np.all([solved.peak < NEARLY_STILL * solved.peak.max() for solved in maps], axis=0)
    return PaperFigure(
        "figure_12",
        maps_figure(panels, columns=3, caption="Frequencies switched between two diagonal ERAs"),
        {
            "": _columns(
                {
                    f"{first:g}_{second:g}_hz": solved
                    for (first, second), solved in zip(FIGURE_12_FREQUENCIES, maps, strict=True)
                }
            )
        },
        {
            "maximum_g": [float(solved.peak.max() / G) for solved in maps],
            "null_count": [float(len(solved.nulls)) for solved in maps],
            "nulls_kept_by_the_next_share": [_shared(now, then) for now, then in pairwise(maps)],
            "nearly_still_in_all_share": float(still.mean()),
            "nearly_still_in_one_share": [
                float((solved.peak < NEARLY_STILL * solved.peak.max()).mean()) for solved in maps
            ],
        },
    )


def stiffness_maps_figure(rig: Rig, free_plate: FreePlate) -> PaperFigure:
    """Figure 13: the diagonal pair at 250 Hz on ERAs of 8 and of 16 kN/m."""
    solve = MapSolver(rig, free_plate)
    pair = diagonal_pair(rig.eras)
    panels = [
        _panel(
            solve,
            with_stiffness(rig.eras, stiffness),
            pair,
            (FIGURE_13_FREQUENCY,) * 2,
            title=f"({letter}) $k_b$ = {stiffness / 1000:g} kN/m",
        )
        for letter, stiffness in zip("ab", FIGURE_13_STIFFNESS, strict=True)
    ]
    soft, stiff = (panel.plate_map for panel in panels)
    names = " and ".join(rig.eras[era].name for era in pair)
    return PaperFigure(
        "figure_13_maps",
        maps_figure(panels, columns=2, caption=f"{names} at {FIGURE_13_FREQUENCY:g} Hz"),
        {"": _columns({"8_kn_m": soft, "16_kn_m": stiff})},
        {
            "soft_maximum_g": float(soft.peak.max() / G),
            "stiff_maximum_g": float(stiff.peak.max() / G),
            "maximum_stiff_to_soft_ratio": float(stiff.peak.max() / soft.peak.max()),
            "correlation": correlation(soft.peak, stiff.peak),
        },
    )


def with_stiffness(eras: Sequence[Era], stiffness: float) -> tuple[Era, ...]:
    """The same ERAs with another stiffness [N/m]; each keeps its damping ratio, c / sqrt(k_b)."""
    return tuple(
        replace(
            era, stiffness=stiffness, damping=era.damping * math.sqrt(stiffness / era.stiffness)
        )
        for era in eras
    )


def correlation(first: FloatArray, second: FloatArray) -> float:
    """Correlation coefficient of two maps of one shape, (ny, nx), point by point."""
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


def full_stroke(
    eras: Sequence[Era], active: Sequence[int], frequencies: Sequence[float]
) -> Excitation:
    """Each of the active ERAs at full stroke, at a frequency [Hz] of its own."""
    return {
        eras[era].name: Tone(frequency, eras[era].stroke)
        for era, frequency in zip(active, frequencies, strict=True)
    }


def _panel(
    solve: MapSolver,
    eras: Sequence[Era],
    pair: tuple[int, int],
    frequencies: tuple[float, float],
    *,
    title: str,
) -> MapPanel:
    """The map of a pair of ERAs; the title may contain {names} and {tones} of the driven ones."""
    excitation = full_stroke(eras, pair, frequencies)
    names = ", ".join(excitation)
    tones = ", ".join(f"{name} {tone.frequency:g} Hz" for name, tone in excitation.items())
    return MapPanel(
        title.format(names=names, tones=tones), solve(eras, excitation), eras, excitation.keys()
    )


def _columns(maps: dict[str, PlateMap]) -> Columns:
    first = next(iter(maps.values()))
    x, y = np.meshgrid(first.x, first.y)
    return {
        "x_m": x.ravel(),
        "y_m": y.ravel(),
        **{f"peak_{name}_m_s2": solved.peak.ravel() for name, solved in maps.items()},
    }


def _shared(now: PlateMap, then: PlateMap) -> float:
    """Share of the nulls of one map that are nulls of another; 0 without nulls."""
    if not len(now.nulls):
        return 0.0
    rows = np.searchsorted(now.y, now.nulls[:, 1] - 1e-9)
    columns = np.searchsorted(now.x, now.nulls[:, 0] - 1e-9)
    return float((then.peak[rows, columns] <= NULL_SHARE * then.peak.max()).mean())
