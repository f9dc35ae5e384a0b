"""One target and one quiet finger in every drive mode: what the plate does."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from benchmarks.localization.cases import paper_table, question_of
from model.arrays import lattice
from model.drive_modes import DRIVE_MODES
from model.figures.drawing import draw_eras
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import sensation_level

PLACES = np.array([[0.09, 0.15], [0.20, 0.07]])  # target, quiet [m]
SIDE = 161
SCALE = Normalize(-15.0, 30.0)
COLORS = "magma"


def modes_figure() -> Figure:
    """A map of level above threshold for each mode, fingers drawn in."""
    table = paper_table()
    x, y = (np.linspace(0, side, SIDE) for side in (table.plate.length, table.plate.width))
    points = lattice(x, y)
    figure = Figure(figsize=(6.8, 2.7), layout="constrained")
    panels = figure.subplots(1, len(DRIVE_MODES))
    for axes, drive_mode in zip(panels, DRIVE_MODES, strict=True):
        question = question_of(PLACES, drive_mode=drive_mode)
        pattern = table.query(question)
        contacts = [(float(place[0]), float(place[1])) for place in PLACES]
        amplitudes = table.amplitudes(pattern.excitation, points, contacts=contacts)
        level = sensation_level(*amplitudes, table.threshold)
        axes.pcolormesh(
            100 * x, 100 * y, level.reshape(SIDE, SIDE), cmap=COLORS, norm=SCALE, shading="gouraud"
        )
        axes.set_aspect("equal")
        axes.set_axis_off()
        draw_eras(axes, table.eras, active=pattern.excitation.keys())
        for place, text, color in zip(
            PLACES, ("felt", "quiet"), ("#6dff9c", "#9fdcff"), strict=True
        ):
            outline = [withStroke(linewidth=2.5, foreground="black")]
            axes.add_patch(
                Circle(
                    100 * place, 100 * FINGERTIP_RADIUS, fill=False, color=color, lw=2,
                    path_effects=outline,
                )
            )  # fmt: skip
            axes.annotate(
                text,
                100 * place,
                xytext=(0, 18),
                textcoords="offset points",
                ha="center",
                color=color,
                path_effects=outline,
            )
        tones = sorted({f"{tone.frequency:.0f}" for tone in pattern.excitation.values()})
        axes.set_title(
            f"{drive_mode}, {' and '.join(tones)} Hz\nat least "
            f"{pattern.robust_felt_contrast_db:.0f} dB, as modelled {pattern.felt_contrast_db:.0f}",
            fontsize=10,
        )
    figure.colorbar(
        ScalarMappable(SCALE, COLORS), ax=list(panels), label="level / dB SL", extend="both"
    )
    return figure
