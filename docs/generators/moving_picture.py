"""Draw the moving picture of the README: three fingers on a car display, in slow motion.

    python docs/generators/moving_picture.py docs/pictures/car_display.webp

`make pictures` runs this. One finger moves along a path while two rest. Every frame is a new answer
for the fingers' positions, from the table of `examples/car_display.yaml`. Colors are those of
`era demo`; relief is the simulated motion of the plate. The vibrations repeat after one period of
50 Hz, and so does the picture. Takes a minute or two, and prints the lowest promised contrasts.
"""

import io
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from model.answer.answer import OWN_CONTRAST_DB, Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import ComplexArray, FloatArray, Point, lattice
from model.figures.contents import BRIGHTEST_DB_SL, CONTENT_COLORS
from model.finger import FINGERTIP_RADIUS, decibels, detection_threshold
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table

RIG = Path(__file__).parents[2] / "examples" / "car_display.yaml"

FRAMES, FRAME_MS = 72, 60
FREQUENCIES = (300.0, 200.0, 250.0)  # Hz; multiples of the repetition
REPETITION = 50.0  # Hz
PATH: tuple[Point, ...] = ((0.085, 0.195), (0.085, 0.07), (0.20, 0.07))  # m; there and back
RESTING: tuple[Point, ...] = ((0.451, 0.12), (0.265, 0.21))  # m
LEVEL_DB_SL = 20.0

COLUMNS, ROWS = 160, 90
WIDTH, DPI = 6.4, 100  # inches; dots per inch
QUALITY = 72  # of the file; 100 is best
_DARKEST, _GRAY = 0.18, 0.62
_STEEP, _RELIEF = 30.0, 24.0  # motion over the threshold that is half as steep; height of relief


@dataclass(frozen=True)
class Scene:
    """The fingers at a moment, and the fields of their vibrations.

    motion (k, p): complex acceleration of each layer, relative to the detection threshold at its
    frequency, at the points of a lattice of ROWS by COLUMNS.
    """

    positions: tuple[Point, ...]
    planned: Answer
    motion: ComplexArray


def moving_position(share: float) -> Point:
    """Return the moving finger's position [m] after a share of the picture, without jerks."""
    last = len(PATH) - 1
    along = last * (1 - math.cos(2 * math.pi * share)) / 2
    x, y = (np.interp(along, np.arange(len(PATH)), axis) for axis in zip(*PATH, strict=True))
    return float(x), float(y)


def scene(table: LocalizationTable, share: float) -> Scene:
    """Plan one vibration for each finger after a share of the picture, and compute its field."""
    positions = (moving_position(share), *RESTING)
    fingers = []
    for position, frequency in zip(positions, FREQUENCIES, strict=True):
        stimulus = Stimulus(LEVEL_DB_SL, band_hz=(frequency, frequency))
        fingers.append(Finger(position, stimulus))
    planned = answer(table, fingers)
    plate = table.plate
    points = lattice(np.linspace(0, plate.length, COLUMNS), np.linspace(0, plate.width, ROWS))
    unit_fields = table.unit_fields(points, contacts=positions)
    motion = []
    for layer in planned.layers:
        frequencies, (field,) = table.driven(layer.excitation, unit_fields)
        (threshold,) = detection_threshold(frequencies, table.threshold)
        motion.append(field / threshold)
    return Scene(positions, planned, np.array(motion))


def colors_of(motion: ComplexArray) -> FloatArray:
    """Return RGB (p, 3): color of the loudest layer, gray in a mixture, dark if not felt."""
    powers = np.abs(motion) ** 2
    loudest, total = powers.max(axis=0), powers.sum(axis=0)
    contrast_db = decibels(loudest / (total - loudest)) / 2
    purity = np.clip(contrast_db / OWN_CONTRAST_DB, 0, 1)[:, None]
    level = np.clip(decibels(loudest) / 2 / BRIGHTEST_DB_SL, 0, 1)[:, None]
    light = _DARKEST + (1 - _DARKEST) * level
    hue = np.array([to_rgb(color) for color in CONTENT_COLORS])[powers.argmax(axis=0)]
    return np.asarray(light * (purity * hue + (1 - purity) * _GRAY))


def frame(table: LocalizationTable, drawn: Scene, share: float) -> Image.Image:
    """Draw a scene at a moment of the repetition."""
    cycles = np.array(FREQUENCIES) / REPETITION * share
    height = (drawn.motion * np.exp(2j * np.pi * cycles)[:, None]).imag.sum(axis=0)
    relief = _RELIEF * np.tanh(height / _STEEP).reshape(ROWS, COLUMNS)
    colors = colors_of(drawn.motion).reshape(ROWS, COLUMNS, 3)
    light = LightSource(azdeg=315, altdeg=50)
    shaded = light.shade_rgb(colors, relief, blend_mode="soft", vert_exag=1)
    length, width = 1000 * table.plate.length, 1000 * table.plate.width
    figure = Figure(figsize=(WIDTH, WIDTH * width / length), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.imshow(
        np.clip(shaded, 0, 1),
        origin="lower",
        extent=(0, length, 0, width),
        interpolation="bicubic",
        aspect="auto",
    )
    for era in table.eras:
        axes.plot(1000 * era.x, 1000 * era.y, "s", ms=5, c="0.9", mec="black")
    _label_fingers(axes, drawn)
    slowness = FRAMES * FRAME_MS / 1000 * REPETITION
    axes.text(length - 6, 6, f"slow motion, 1:{slowness:.0f}", ha="right", size=9, color="white")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return Image.open(buffer).convert("RGB")


def _label_fingers(axes: Axes, drawn: Scene) -> None:
    for number, felt in enumerate(drawn.planned.fingers):
        x, y = drawn.positions[number]
        center, color = (1000 * x, 1000 * y), CONTENT_COLORS[number]
        for width, edge in ((5, "white"), (2.5, color)):
            axes.add_patch(Circle(center, 2000 * FINGERTIP_RADIUS, fill=False, ec=edge, lw=width))
        axes.annotate(
            f"{FREQUENCIES[number]:g} Hz, +{felt.promised_contrast_db:.0f} dB",
            center,
            (0, 32),
            textcoords="offset points",
            ha="center",
            va="center",
            size=10,
            color=color,
            bbox={"fc": "black", "ec": "none", "alpha": 0.75, "boxstyle": "round"},
        )


def draw(path: Path, shares: Sequence[float]) -> list[Scene]:
    """Write the picture with a frame for each share of its duration; return the scenes."""
    table = build_table(load_rig(RIG), drive_mode="phased")
    scenes = [scene(table, share) for share in shares]
    frames = [frame(table, drawn, share) for drawn, share in zip(scenes, shares, strict=True)]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=FRAME_MS,
        loop=0,
        quality=QUALITY,
        method=4,
    )
    return scenes


def main() -> None:
    """Draw the picture, and print the lowest promised contrasts."""
    path = Path(sys.argv[1])
    scenes = draw(path, [number / FRAMES for number in range(FRAMES)])
    for number, frequency in enumerate(FREQUENCIES):
        contrasts = [drawn.planned.fingers[number].promised_contrast_db for drawn in scenes]
        lowest = min(contrast for contrast in contrasts if contrast is not None)
        sys.stdout.write(f"{frequency:g} Hz: promised contrast at least {lowest:.1f} dB\n")
    sys.stdout.write(f"{path}: {path.stat().st_size / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()
