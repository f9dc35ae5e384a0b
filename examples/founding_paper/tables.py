"""Compare the founding paper's tables and claims with this model.

    python examples/founding_paper/tables.py [RIG]

Prints the natural frequencies of Tables 1 and 2, on the paper's mesh (12 x 9 elements of one inch)
and on this model's, the paper's claims about Figures 10 to 13 as numbers, and the parametric study
of stiffness that the paper announces. Default for RIG: `examples/paper_plate.yaml`.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from paper_figures import (
    SWEEP,
    PaperFigure,
    diagonal_pair,
    pair_map,
    paper_figures,
    with_stiffness,
)

from model.fem import Mesh
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.plate import Plate
from model.vibration import NULL_SHARE, G, find_nulls, natural_modes

RIG = Path(__file__).parents[1] / "paper_plate.yaml"

ELEMENT_SIDE = 0.0254
"""Element side in the paper's mesh [m], one inch: 12 x 9 elements, 390 degrees of freedom."""

TABLE_1 = (110.95, 234.16, 337.90, 454.29, 459.69)
TABLE_1_COMSOL = (109.6, 228.02, 320.29, 425.6, 438.6)
"""Natural frequencies [Hz], simply supported: the paper's own model and its COMSOL model."""

TABLE_2 = (31.98, 68.50, 76.62, 107.84, 160.77)
TABLE_2_COMSOL = (31.67, 68.07, 75.62, 106.53, 157.14)
"""Natural frequencies [Hz] on four ERAs at the corners."""

STIFFNESSES = 500.0 * 2 ** (np.arange(61) / 6)
"""Stiffnesses [N/m], 0.5 to 512 kN/m, six per octave: from nearly free to nearly pinned."""

PAPER_STIFFNESS = 17_000.0
"""ERA stiffness [N/m], identified: it reproduces the paper's Table 2 to the last digit."""

NEARLY_STILL = 0.3
"""Fraction of the maximum below which the paper considers a point to be still."""

Floats = NDArray[np.float64]


def thin_plate_frequencies(plate: Plate, count: int) -> Floats:
    """Natural frequencies [Hz] (count,) of a simply supported thin plate: paper Eq. 29."""
    half_waves = np.arange(1, count + 1)
    along = (half_waves * np.pi / plate.length) ** 2
    across = (half_waves * np.pi / plate.width) ** 2
    speed = np.sqrt(plate.flexural_rigidity / (plate.material.rho * plate.thickness))
    frequencies = (along[:, None] + across) * speed / (2 * np.pi)
    return np.asarray(np.sort(frequencies.ravel())[:count])


def tables(rig: Rig) -> Iterator[tuple[str, dict[str, Floats]]]:
    """Yield name and columns [Hz] of Tables 1 and 2."""
    plate = rig.plate
    cells = [max(2, round(side / ELEMENT_SIDE)) for side in (plate.length, plate.width)]
    coarse = Mesh(cells[0], cells[1], plate.length, plate.width)
    printed = {
        "simply-supported": ("Table 1", TABLE_1, TABLE_1_COMSOL),
        "eras": ("Table 2", TABLE_2, TABLE_2_COMSOL),
    }
    for support, (name, paper, comsol) in printed.items():
        columns = {"paper": np.array(paper)}
        for title, mesh in ((f"{cells[0]}x{cells[1]}", coarse), ("model", None)):
            solved = natural_modes(rig, len(paper), support=support, mesh=mesh)
            columns[title] = solved.frequencies
        columns["COMSOL"] = np.array(comsol)
        if support != "eras":
            columns["Eq. 29"] = thin_plate_frequencies(plate, len(paper))
        yield name, columns


def claims(figures: dict[str, PaperFigure]) -> dict[str, object]:
    """Compute the numbers that the paper claims about Figures 10 to 13."""
    single = _medians(figures["figure_10"])
    pairs = _medians(figures["figure_11_boxplots"])
    edge, diagonal = _maps(figures["figure_11_maps"])
    switched = _maps(figures["figure_12"])
    still = np.array([peak < NEARLY_STILL * peak.max() for peak in switched])
    soft, stiff = _maps(figures["figure_13_maps"])
    return {
        "Figure 10: median / g": {name: value / G for name, value in single.items()},
        "Figure 11: median / g": {name: value / G for name, value in pairs.items()},
        "best pair to best single ERA": {n: pairs[n] / single[n] for n in single},
        "Figure 11, maps: maxima / g": [edge.max() / G, diagonal.max() / G],
        "their ratio": edge.max() / diagonal.max(),
        "nulls of the edge kept on the diagonal": _kept(figures["figure_11_maps"], edge, diagonal),
        "Figure 12: maxima / g": [peak.max() / G for peak in switched],
        "nulls kept by the next": [
            _kept(figures["figure_12"], peak, next_peak) for peak, next_peak in pairwise(switched)
        ],
        "nearly still in each": still.mean(axis=1),
        "nearly still in all": still.all(axis=0).mean(),
        "Figure 13: maxima / g": [soft.max() / G, stiff.max() / G],
        "stiff to soft": stiff.max() / soft.max(),
        "correlation of the two": np.corrcoef(soft, stiff)[0, 1],
    }


def stiffness_study(rig: Rig) -> dict[str, Floats]:
    """Return maximum and median of the peak acceleration over the plate, by ERA stiffness.

    The diagonal pair is driven at 250 Hz. `correlation` compares each map with the map at 17 kN/m.
    """
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(SWEEP[-1]))

    def peak(stiffness: float) -> Floats:
        varied_rig = replace(rig, eras=with_stiffness(rig.eras, stiffness))
        panel = pair_map(varied_rig, free, diagonal_pair(rig.eras), (250.0, 250.0), "")
        return panel.plate_map.peak.ravel()

    reference = peak(PAPER_STIFFNESS)
    peaks = np.array([peak(stiffness) for stiffness in STIFFNESSES.tolist()])
    return {
        "stiffness / kN/m": STIFFNESSES / 1000,
        "maximum / g": peaks.max(axis=1) / G,
        "median / g": np.median(peaks, axis=1) / G,
        "correlation": np.array([np.corrcoef(row, reference)[0, 1] for row in peaks]),
    }


def _medians(figure: PaperFigure) -> dict[str, float]:
    """Return the highest median [m/s²] of each layout."""
    table = figure.tables[""]
    medians: dict[str, float] = {}
    for layout, median in zip(table["layout"], table["median_m_s2"], strict=True):
        name = str(layout)
        medians[name] = max(medians.get(name, 0.0), float(str(median)))
    return medians


def _maps(figure: PaperFigure) -> list[Floats]:
    """Return the maps of a figure [m/s²]."""
    return [
        np.asarray(column, float)
        for name, column in figure.tables[""].items()
        if name.startswith("peak_")
    ]


def _kept(figure: PaperFigure, peak: Floats, next_peak: Floats) -> float:
    """Return the fraction of nulls in a map that are nulls in the next map too; 0 without nulls."""
    x, y = (np.unique(np.asarray(figure.tables[""][key], float)) for key in ("x_m", "y_m"))
    nulls = find_nulls(x, y, peak.reshape(len(y), len(x)))
    if not len(nulls):
        return 0.0
    columns = np.searchsorted(x, nulls[:, 0])
    rows = np.searchsorted(y, nulls[:, 1])
    at_nulls = next_peak.reshape(len(y), -1)[rows, columns]
    return float((at_nulls <= NULL_SHARE * next_peak.max()).mean())


def _formatted(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_formatted(entry)}" for key, entry in value.items())
    if isinstance(value, list | np.ndarray):
        return ", ".join(map(_formatted, value))
    return f"{float(str(value)):.4g}"


def _print_columns(columns: dict[str, Floats], digits: int) -> None:
    print("  ".join(f"{name:>16s}" for name in columns))
    for row in zip(*columns.values(), strict=True):
        # The paper rounds half up: 110.945 becomes 110.95.
        rounded = (np.floor(value * 10**digits + 0.5) / 10**digits for value in row)
        print("  ".join(f"{value:16.{digits}f}" for value in rounded))


def main() -> None:
    """Print all tables and claims."""
    rig = load_rig(sys.argv[1] if len(sys.argv) > 1 else RIG)
    for name, columns in tables(rig):
        print(f"{name}: natural frequencies / Hz")
        _print_columns(columns, 2)
    figures = {figure.name: figure for figure in paper_figures(rig, "all")}
    for claim, value in claims(figures).items():
        print(f"{claim}: {_formatted(value)}")
    study = stiffness_study(rig)
    print("Diagonal pair at 250 Hz by ERA stiffness")
    _print_columns({key: values[::6] for key, values in study.items()}, 3)
    similar = STIFFNESSES[study["correlation"] > 0.95] / 1000
    print(f"correlation above 0.95 from {similar.min():.3g} to {similar.max():.3g} kN/m")


if __name__ == "__main__":
    main()
