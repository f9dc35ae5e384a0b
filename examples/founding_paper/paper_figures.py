"""Draw the figures of the founding paper for any rig, and write their data as CSV.

    python examples/founding_paper/paper_figures.py RIG DIR

Frequencies, layouts and stiffnesses are the paper's. `tables.py` compares the results with
the paper's claims.
"""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from model.arrays import FloatArray, best_by, best_of, lattice
from model.errors import InputError
from model.figures.plate_maps import MapPanel, maps_figure, raster
from model.figures.style import draw_eras, label_plate, save_figure
from model.files.csv_file import Columns, write_columns
from model.finger import Grid
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.era_layouts import FOUR_ERA_LAYOUTS, alike
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.exciter import Actuator
from model.structure.plate import Plate
from model.vibration import G, Tone, natural_modes, plate_map

SWEEP = np.arange(60.0, 321.0, 10.0)
"""The 27 frequencies [Hz] of Figures 10 and 11; they include every one in the paper's text."""

FIGURE_12_FREQUENCIES = (
    (320.0, 320.0),
    (300.0, 100.0),
    (100.0, 300.0),
    (170.0, 170.0),
    (250.0, 220.0),
    (150.0, 150.0),
)
"""Frequencies [Hz] of the two diagonal ERAs in Figure 12 (a) to (f)."""

FIGURE_13_STIFFNESS = (8_000.0, 16_000.0)
"""ERA stiffness [N/m] of the two maps in Figure 13."""

STATISTICS = ("minimum", "lower_quartile", "median", "upper_quartile", "maximum")
"""Statistics of the cumulative peak acceleration over the plate [m/s²]."""

_MODES = (1, 5)
_CONTOURS = (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75)


@dataclass(frozen=True)
class PaperFigure:
    """A figure, its file name without suffix, and its tables by file name suffix."""

    name: str
    figure: Figure
    tables: dict[str, Columns]


def paper_figures(rig: Rig, number: str) -> Iterator[PaperFigure]:
    """Draw the figures with one number, or `all`, for a rig's plate and mesh.

    Raises InputError for the number of a figure without results, for a mesh too coarse for 320 Hz,
    and for a rig with one ERA if the figure needs a pair.
    """
    if number not in (*_FIGURES, "all"):
        raise InputError(f"figure must be one of {', '.join(_FIGURES)} or all, got {number!r}")
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(SWEEP[-1]))
    for key, figures in _FIGURES.items():
        if number in (key, "all"):
            yield from (figure(rig, free) for figure in figures)


def _modes(rig: Rig, free: FreePlate, *, name: str, support: str) -> PaperFigure:
    """Draw mode shapes 1 and 5; list the natural frequencies."""
    solved = natural_modes(rig, max(_MODES), support=support)
    columns, rows = raster(rig.plate)
    x, y = np.linspace(0, rig.plate.length, columns), np.linspace(0, rig.plate.width, rows)
    points = lattice(x, y)
    displacements = solved.at(points)[:, np.array(_MODES) - 1]
    # Scaled to a largest deflection of +1, since the sign and size of a mode are arbitrary.
    shapes = [shape / shape[best_of(np.abs(shape))] for shape in displacements.T]
    figure = Figure(figsize=(8, 3.7), layout="constrained")
    grid = figure.subplots(1, len(shapes), sharey=True)
    for axes, mode, shape in zip(grid, _MODES, shapes, strict=True):
        colours = {"cmap": "RdBu_r", "shading": "gouraud", "vmin": -1, "vmax": 1}
        deflection = shape.reshape(rows, columns)
        image = axes.pcolormesh(100 * x, 100 * y, deflection, **colours)
        # Dashed where negative, so that the sign needs no colors.
        axes.contour(100 * x, 100 * y, deflection, _CONTOURS, colors="black", linewidths=0.7)
        label_plate(axes)
        if support == "eras":
            draw_eras(axes, rig.eras, active=())
        axes.set_title(f"mode {mode}: {solved.frequencies[mode - 1]:.2f} Hz")
        axes.label_outer()
    figure.colorbar(
        image, ax=grid, label="deflection relative to the maximum\n(dashed contours: negative)"
    )
    figure.suptitle(f"On {len(rig.eras)} ERAs" if support == "eras" else "Simply supported")
    shape_columns = {f"mode_{mode}": shape for mode, shape in zip(_MODES, shapes, strict=True)}
    tables: dict[str, Columns] = {
        "": {"mode": range(1, max(_MODES) + 1), "model_hz": solved.frequencies},
        "_shapes": {"x_m": points[:, 0], "y_m": points[:, 1], **shape_columns},
    }
    return PaperFigure(name, figure, tables)


def _box_plots(rig: Rig, free: FreePlate, *, name: str, active_count: int) -> PaperFigure:
    """Draw box plots of the peak acceleration summed over the sweep, for each layout.

    active_count: number of driven ERAs, all like the rig's first one, at full amplitude and in
    phase. The box of a layout shows the drive with the highest median.
    """
    points = equal_area_points(rig.plate)
    figure = Figure(figsize=(max(6, 1.4 * len(FOUR_ERA_LAYOUTS)), 6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1, 4), squeeze=False)[:, 0]
    rows, boxes = [], []
    for axes, layout in zip(
        upper.subplots(1, len(FOUR_ERA_LAYOUTS)), FOUR_ERA_LAYOUTS, strict=True
    ):
        eras = alike(rig.eras[0], layout.positions(rig.plate))
        acceleration = free.acceleration(eras, SWEEP, points, loads=rig.masses)
        places = " ".join(f"({x:.4g};{y:.4g})" for x, y in layout.places)
        drives = []
        for active in combinations(range(len(eras)), active_count):
            total = np.abs(acceleration[:, active].sum(axis=1)).sum(axis=0)
            drives.append((active, np.percentile(total, [0, 25, 50, 75, 100])))
            names = "+".join(str(era + 1) for era in active)
            rows.append((layout.name, names, places, *drives[-1][1]))
        # Symmetric drives have equal medians to six digits; the first one is taken.
        best, statistics = best_by(drives, lambda drive: float(f"{drive[1][2]:.6g}"))
        box = dict(zip(("whislo", "q1", "med", "q3", "whishi"), statistics / G, strict=True))
        boxes.append({"label": layout.name.replace(" ", "\n"), "fliers": [], **box})
        axes.add_patch(
            Rectangle((0, 0), 100 * rig.plate.length, 100 * rig.plate.width, fc="0.93", ec="0.4")
        )
        draw_eras(axes, eras, active=[eras[number].name for number in best], size=7)
        axes.set_aspect("equal")
        axes.axis("off")
    axes = lower.subplots()
    axes.bxp(
        boxes,
        widths=0.6,
        patch_artist=True,
        showfliers=False,
        boxprops={"facecolor": "#9ecae1"},
        medianprops={"color": "black", "linewidth": 1.5},
    )
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.set_ylabel("cumulative peak acceleration / g")
    axes.set_ylim(bottom=0)
    axes.set_title("boxes: quartiles over the plate; whiskers: minimum and maximum", fontsize=10)
    drive = "One active ERA" if active_count == 1 else "Two active ERAs"
    squares = "orange square" if active_count == 1 else "orange squares"
    figure.suptitle(f"{drive} ({squares}): peak acceleration summed over {len(SWEEP)} frequencies")
    headers = ("layout", "active_eras", "era_fractions", *(f"{key}_m_s2" for key in STATISTICS))
    table: Columns = dict(zip(headers, zip(*rows, strict=True), strict=True))
    return PaperFigure(name, figure, {"": table})


def equal_area_points(plate: Plate) -> FloatArray:
    """Return points [m] (p, 2) that represent equal areas: the centers of nearly square cells.

    The longer side has 24 cells, or more if the shortest bending wavelength needs them (12 cells).
    Compared with cells of a quarter of the size on the paper's plate, medians differ by up to 3 %,
    quartiles by up to 8 %, and the maximum, which is on the edge, is up to 12 % too low. The
    minimum, which is at a null, depends on the points.
    """
    wavelength = plate.bending_wavelength(float(SWEEP[-1]))
    size = min(max(plate.length, plate.width) / 24, wavelength / 12)
    grid = Grid(max(1, round(plate.length / size)), max(1, round(plate.width / size)))
    return grid.centers(plate)


def _same_frequency(rig: Rig, free: FreePlate) -> PaperFigure:
    """Draw the maps of an edge pair and a diagonal pair at 110 Hz."""
    pairs = {"edge": edge_pair(rig.eras), "diagonal": diagonal_pair(rig.eras)}
    titles = "(a) same edge: {names}", "(b) diagonal: {names}"
    panels = {
        key: pair_map(rig, free, pair, (110.0, 110.0), title)
        for (key, pair), title in zip(pairs.items(), titles, strict=True)
    }
    return _maps("figure_11_maps", panels, columns=2, caption="Two ERAs at 110 Hz")


def _switched(rig: Rig, free: FreePlate) -> PaperFigure:
    """Draw the maps of the diagonal pair at six pairs of frequencies."""
    pair = diagonal_pair(rig.eras)
    panels = {
        f"{tones[0]:g}_{tones[1]:g}_hz": pair_map(rig, free, pair, tones, f"({letter}) {{tones}}")
        for letter, tones in zip("abcdef", FIGURE_12_FREQUENCIES, strict=True)
    }
    caption = "Frequencies switched between two diagonal ERAs"
    return _maps("figure_12", panels, columns=3, caption=caption)


def _stiffnesses(rig: Rig, free: FreePlate) -> PaperFigure:
    """Draw the maps of the diagonal pair at 250 Hz, for ERA stiffnesses of 8 and 16 kN/m."""
    pair = diagonal_pair(rig.eras)
    panels = {
        f"{stiffness / 1000:g}_kn_m": pair_map(
            replace(rig, eras=with_stiffness(rig.eras, stiffness)),
            free,
            pair,
            (250.0, 250.0),
            f"({letter}) $k_b$ = {stiffness / 1000:g} kN/m",
        )
        for letter, stiffness in zip("ab", FIGURE_13_STIFFNESS, strict=True)
    }
    names = " and ".join(rig.eras[era].name for era in pair)
    return _maps("figure_13_maps", panels, columns=2, caption=f"{names} at 250 Hz")


def edge_pair(eras: Sequence[Actuator]) -> tuple[int, int]:
    """Return the two ERAs on an edge along x: closest in y, then furthest apart in x."""

    def order(pair: tuple[int, int]) -> tuple[float, float]:
        along, across = abs(_distance(eras, pair))
        return _rounded(across), -_rounded(along)

    return min(_pairs(eras), key=order)


def diagonal_pair(eras: Sequence[Actuator]) -> tuple[int, int]:
    """Return the two ERAs that are furthest apart; of equal pairs, the first one."""
    pairs = _pairs(eras)
    return pairs[best_of([np.hypot(*_distance(eras, pair)) for pair in pairs])]


def _pairs(eras: Sequence[Actuator]) -> list[tuple[int, int]]:
    if len(eras) < 2:
        raise InputError(f"number of ERAs in the rig must be >= 2 to drive a pair, got {len(eras)}")
    return list(combinations(range(len(eras)), 2))


def _distance(eras: Sequence[Actuator], pair: tuple[int, int]) -> FloatArray:
    first, second = (eras[index] for index in pair)
    return np.array([second.x - first.x, second.y - first.y])


def _rounded(distance: float) -> float:
    """Round a distance [m], so that numerical errors do not decide between equal pairs."""
    return round(float(distance), 9)


def with_stiffness(eras: Sequence[Actuator], stiffness: float) -> tuple[Actuator, ...]:
    """Return ERAs with another stiffness [N/m] and the same damping ratio, c / sqrt(k_b)."""
    factors = [stiffness / era.stiffness for era in eras]
    return tuple(
        era.varied(stiffness=factor, damping=math.sqrt(factor))
        for era, factor in zip(eras, factors, strict=True)
    )


def pair_map(
    rig: Rig,
    free: FreePlate,
    pair: tuple[int, int],
    frequencies: tuple[float, float],
    title: str,
) -> MapPanel:
    """Return the map of two ERAs at full amplitude; title: can contain {names} and {tones}."""
    excitation = {
        rig.eras[number].name: Tone(frequency, rig.eras[number].full_level)
        for number, frequency in zip(pair, frequencies, strict=True)
    }
    tones = ", ".join(f"{name} {tone.frequency:g} Hz" for name, tone in excitation.items())
    solved = plate_map(rig, excitation, raster=raster(rig.plate), free=free)
    text = title.format(names=", ".join(excitation), tones=tones)
    return MapPanel(text, solved, rig.eras, excitation.keys())


def _maps(name: str, panels: dict[str, MapPanel], *, columns: int, caption: str) -> PaperFigure:
    panel_list = list(panels.values())
    x, y = np.meshgrid(panel_list[0].plate_map.x, panel_list[0].plate_map.y)
    peaks = {f"peak_{key}_m_s2": panel.plate_map.peak.ravel() for key, panel in panels.items()}
    table: Columns = {"x_m": x.ravel(), "y_m": y.ravel(), **peaks}
    figure = maps_figure(panel_list, columns=columns, caption=caption)
    return PaperFigure(name, figure, {"": table})


_FIGURES: dict[str, tuple[Callable[[Rig, FreePlate], PaperFigure], ...]] = {
    "6": (partial(_modes, name="figure_6", support="simply-supported"),),
    "7": (partial(_modes, name="figure_7", support="eras"),),
    "10": (partial(_box_plots, name="figure_10", active_count=1),),
    "11": (  # the paper has two figures with this number
        partial(_box_plots, name="figure_11_boxplots", active_count=2),
        _same_frequency,
    ),
    "12": (_switched,),
    "13": (_stiffnesses,),
}


def main() -> None:
    """Draw all figures of a rig into a folder."""
    rig_file, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    for paper_figure in paper_figures(load_rig(rig_file), "all"):
        name = paper_figure.name
        save_figure(paper_figure.figure, folder / f"{name}.png")
        for suffix, columns in paper_figure.tables.items():
            write_columns(folder / f"{name}{suffix}.csv", columns)
        print(f"wrote {folder / name}.png")


if __name__ == "__main__":
    main()
