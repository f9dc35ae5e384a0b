"""The founding paper's tables and claims, compared with this model.

    python examples/founding_paper/tables.py [RIG]

prints the natural frequencies of its Tables 1 and 2 on its own mesh, 12 x 9 elements of one inch,
and on polynomials, its Figures 10 to 13 as the numbers that it claims of them, and the parametric
study of stiffness that it announces. RIG: by default `examples/paper_plate.yaml`.
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
"""Side of an element in the paper's mesh [m], one inch: 12 x 9 elements, 390 degrees of freedom."""

TABLE_1 = (110.95, 234.16, 337.90, 454.29, 459.69)
TABLE_1_COMSOL = (109.6, 228.02, 320.29, 425.6, 438.6)
"""Natural frequencies [Hz], simply supported: the paper's own model, and its COMSOL model."""

TABLE_2 = (31.98, 68.50, 76.62, 107.84, 160.77)
TABLE_2_COMSOL = (31.67, 68.07, 75.62, 106.53, 157.14)
"""The same on four ERAs at the corners."""

STIFFNESSES = 500.0 * 2 ** (np.arange(61) / 6)
"""Stiffness [N/m], 0.5 to 512 kN/m, six per octave: from nearly free to nearly pinned."""

PAPER_STIFFNESS = 17_000.0
"""ERA stiffness [N/m], recovered: with it the paper's Table 2 comes out to the last digit."""

NEARLY_STILL = 0.3
"""Share of its maximum below which the paper counts a point of a switched pattern as still."""

Floats = NDArray[np.float64]


def thin_plate_frequencies(plate: Plate, count: int) -> Floats:
    """Natural frequencies [Hz] (count,) of a thin plate, simply supported: paper Eq. 29."""
    half_waves = np.arange(1, count + 1)
    along = (half_waves * np.pi / plate.length) ** 2
    across = (half_waves * np.pi / plate.width) ** 2
    speed = np.sqrt(plate.flexural_rigidity / (plate.material.rho * plate.thickness))
    every = (along[:, None] + across) * speed / (2 * np.pi)
    return np.asarray(np.sort(every.ravel())[:count])


def tables(rig: Rig) -> Iterator[tuple[str, dict[str, Floats]]]:
    """Tables 1 and 2 by name, each with its columns [Hz]."""
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
    """Return the paper's claims on Figures 10 to 13 as numbers from the figures' tables."""
    single, pairs = (_medians(figures[name]) for name in ("figure_10", "figure_11_boxplots"))
    edge, diagonal = _maps(figures["figure_11_maps"])
    switched = _maps(figures["figure_12"])
    still = np.array([each < NEARLY_STILL * each.max() for each in switched])
    soft, stiff = _maps(figures["figure_13_maps"])
    return {
        "Figure 10: median / g": {name: value / G for name, value in single.items()},
        "Figure 11: median / g": {name: value / G for name, value in pairs.items()},
        "best pair to best single ERA": {n: pairs[n] / single[n] for n in single},
        "Figure 11, maps: maxima / g": [edge.max() / G, diagonal.max() / G],
        "their ratio": edge.max() / diagonal.max(),
        "nulls of the edge kept on the diagonal": _kept(figures["figure_11_maps"], edge, diagonal),
        "Figure 12: maxima / g": [each.max() / G for each in switched],
        "nulls kept by the next": [
            _kept(figures["figure_12"], now, then) for now, then in pairwise(switched)
        ],
        "nearly still in each": still.mean(axis=1),
        "nearly still in all": still.all(axis=0).mean(),
        "Figure 13: maxima / g": [soft.max() / G, stiff.max() / G],
        "stiff to soft": stiff.max() / soft.max(),
        "correlation of the two": np.corrcoef(soft, stiff)[0, 1],
    }


def stiffness_study(rig: Rig) -> dict[str, Floats]:
    """Largest and median peak acceleration, diagonal pair at 250 Hz, by ERA stiffness.

    Also the correlation of the map with that at 17 kN/m.
    """
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(SWEEP[-1]))

    def peak(stiffness: float) -> Floats:
        on_springs = replace(rig, eras=with_stiffness(rig.eras, stiffness))
        solved = pair_map(on_springs, free, diagonal_pair(rig.eras), (250.0, 250.0), "")
        return solved.plate_map.peak.ravel()

    reference, peaks = peak(PAPER_STIFFNESS), [peak(each) for each in STIFFNESSES.tolist()]
    return {
        "stiffness / kN/m": STIFFNESSES / 1000,
        "maximum / g": np.array([each.max() / G for each in peaks]),
        "median / g": np.array([np.median(each) / G for each in peaks]),
        "correlation": np.array([np.corrcoef(each, reference)[0, 1] for each in peaks]),
    }


def _medians(figure: PaperFigure) -> dict[str, float]:
    """The highest median [m/s²] of each layout."""
    table = figure.tables[""]
    found: dict[str, float] = {}
    for name, median in zip(table["layout"], table["median_m_s2"], strict=True):
        found[str(name)] = max(found.get(str(name), 0.0), float(str(median)))
    return found


def _maps(figure: PaperFigure) -> list[Floats]:
    """The maps of a figure [m/s²]."""
    return [
        np.asarray(column, float)
        for name, column in figure.tables[""].items()
        if name.startswith("peak_")
    ]


def _kept(figure: PaperFigure, now: Floats, then: Floats) -> float:
    """Return the fraction of nulls in one map that are nulls of another; 0 without nulls."""
    x, y = (np.unique(np.asarray(figure.tables[""][key], float)) for key in ("x_m", "y_m"))
    nulls = find_nulls(x, y, now.reshape(len(y), len(x)))
    if not len(nulls):
        return 0.0
    columns, rows = np.searchsorted(x, nulls[:, 0]), np.searchsorted(y, nulls[:, 1])
    return float((then.reshape(len(y), -1)[rows, columns] <= NULL_SHARE * then.max()).mean())


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(each)}" for key, each in value.items())
    if isinstance(value, list | np.ndarray):
        return ", ".join(map(_shown, value))
    return f"{float(str(value)):.4g}"


def _print_columns(columns: dict[str, Floats], digits: int) -> None:
    print("  ".join(f"{name:>16s}" for name in columns))
    for row in zip(*columns.values(), strict=True):
        # Half up, as the paper rounds: 110.945 is 110.95.
        rounded = (np.floor(value * 10**digits + 0.5) / 10**digits for value in row)
        print("  ".join(f"{value:16.{digits}f}" for value in rounded))


def main() -> None:
    """Print all tables and claims."""
    rig = load_rig(sys.argv[1] if len(sys.argv) > 1 else RIG)
    for name, columns in tables(rig):
        print(f"{name}: natural frequencies / Hz")
        _print_columns(columns, 2)
    for text, value in claims({each.name: each for each in paper_figures(rig, "all")}).items():
        print(f"{text}: {_shown(value)}")
    study = stiffness_study(rig)
    print("Diagonal pair at 250 Hz by ERA stiffness")
    _print_columns({key: values[::6] for key, values in study.items()}, 3)
    alike = STIFFNESSES[study["correlation"] > 0.95] / 1000
    print(f"correlation above 0.95 from {alike.min():.3g} to {alike.max():.3g} kN/m")


if __name__ == "__main__":
    main()
