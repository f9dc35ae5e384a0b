"""Figures 6 and 7: mode shapes 1 and 5, simply supported and on the ERAs, and Tables 1 and 2."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from model.arrays import FloatArray, lattice
from model.choice import best_of
from model.fem.mesh import Mesh
from model.figures.drawing import draw_eras, draw_shape, raster
from model.files.csv_file import Column, Columns
from model.paper.figure import PaperFigure
from model.paper.printed import (
    ELEMENT_SIDE,
    TABLE_1_COMSOL,
    TABLE_1_PAPER,
    TABLE_2_COMSOL,
    TABLE_2_PAPER,
    is_paper_plate,
    is_paper_rig,
)
from model.rig.rig import Rig
from model.structure.plate import Plate
from model.vibration.natural_modes import natural_modes

MODE_COUNT = 5
SHOWN_MODES = (1, 5)

_HEADINGS = {"analytical_hz": "Eq. 29", "comsol_hz": "COMSOL, paper", "paper_hz": "MATLAB, paper"}


def simply_supported_figure(rig: Rig) -> PaperFigure:
    """Figure 6: simply supported on all edges, without ERAs; paper Eq. 29 beside the model."""
    known: dict[str, Column] = {"analytical_hz": thin_plate_frequencies(rig.plate, MODE_COUNT)}
    if is_paper_plate(rig.plate):
        known |= {"comsol_hz": TABLE_1_COMSOL, "paper_hz": TABLE_1_PAPER}
    return _shapes_figure(
        "figure_6",
        rig,
        support="simply-supported",
        caption="Simply supported",
        known=known,
    )


def era_supported_figure(rig: Rig) -> PaperFigure:
    """Figure 7: on the rig's ERAs, undamped."""
    printed: Columns = {"comsol_hz": TABLE_2_COMSOL, "paper_hz": TABLE_2_PAPER}
    return _shapes_figure(
        "figure_7",
        rig,
        support="eras",
        caption=f"On {len(rig.eras)} ERAs",
        known=printed if is_paper_rig(rig) else {},
    )


def thin_plate_frequencies(plate: Plate, count: int) -> FloatArray:
    """Natural frequencies [Hz] (count,) of a thin plate, simply supported: paper Eq. 29."""
    half_waves = np.arange(1, count + 1)
    along = (half_waves * np.pi / plate.length) ** 2
    across = (half_waves * np.pi / plate.width) ** 2
    speed = np.sqrt(plate.flexural_rigidity / (plate.material.rho * plate.thickness))
    every = (along[:, None] + across) * speed / (2 * np.pi)
    return np.asarray(np.sort(every.ravel())[:count])


def paper_mesh(plate: Plate) -> Mesh:
    """A mesh of the paper's element size, one inch; 12x9 on its plate."""
    return Mesh(
        max(2, round(plate.length / ELEMENT_SIDE)),
        max(2, round(plate.width / ELEMENT_SIDE)),
        plate.length,
        plate.width,
    )


def _shapes_figure(
    name: str, rig: Rig, *, support: str, caption: str, known: Columns
) -> PaperFigure:
    coarse_mesh = paper_mesh(rig.plate)
    coarse = natural_modes(rig, MODE_COUNT, support=support, mesh=coarse_mesh)
    fine = natural_modes(rig, MODE_COUNT, support=support)
    table: Columns = {
        **known,
        f"model_{coarse_mesh.nx}x{coarse_mesh.ny}_hz": coarse.frequencies,
        "model_fine_hz": fine.frequencies,
    }
    columns, rows = raster(rig.plate)
    x = np.linspace(0, rig.plate.length, columns)
    y = np.linspace(0, rig.plate.width, rows)
    points = lattice(x, y)
    shapes = [_scaled(shape) for shape in fine.at(points)[:, [mode - 1 for mode in SHOWN_MODES]].T]
    figure = Figure(figsize=(9, 6.2), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(3, 1.6), squeeze=False)[:, 0]
    axes = upper.subplots(1, len(shapes), sharey=True)
    for drawn, mode, shape in zip(axes, SHOWN_MODES, shapes, strict=True):
        image = draw_shape(drawn, x, y, shape.reshape(rows, columns))
        if support == "eras":
            draw_eras(drawn, rig.eras, active=())
        drawn.set_title(f"mode {mode}: {fine.frequencies[mode - 1]:.2f} Hz")
        drawn.label_outer()
    upper.colorbar(image, ax=axes, label="deflection, largest = 1")
    upper.suptitle(caption)
    _draw_table(lower.subplots(), table)
    return PaperFigure(
        name,
        figure,
        {
            "": {"mode": list(range(1, MODE_COUNT + 1)), **table},
            "_shapes": {
                "x_m": points[:, 0],
                "y_m": points[:, 1],
                **{f"mode_{mode}": shape for mode, shape in zip(SHOWN_MODES, shapes, strict=True)},
            },
        },
        {
            key: np.round(np.asarray(column, dtype=float), 2).tolist()
            for key, column in table.items()
        },
    )


def _scaled(shape: FloatArray) -> FloatArray:
    """A mode shape with its largest deflection at +1: sign and size of a mode are free."""
    return np.asarray(shape / shape[best_of(np.abs(shape))])


def _draw_table(axes: Axes, columns: Columns) -> None:
    """Write frequencies (modes,) in Hz under their column's name."""
    axes.axis("off")
    drawn = axes.table(
        cellText=[[f"{value:.2f}" for value in row] for row in zip(*columns.values(), strict=True)],
        rowLabels=[f"  mode {mode} / Hz  " for mode in range(1, MODE_COUNT + 1)],
        colLabels=[_HEADINGS.get(key, key.replace("_hz", "").replace("_", " ")) for key in columns],
        bbox=Bbox.from_bounds(0.15, 0, 0.83, 1),
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(10)
