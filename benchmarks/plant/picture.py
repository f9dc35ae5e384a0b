"""A finger that lands on a vibrating plate, stays and goes, drawn.

    python -m benchmarks.plant.picture FILE.png

The plate of the founding paper, one ERA at 110 Hz. The finger loads it (`Fingertip`); grey is what
would be there if it only felt.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.setting import RIG
from model.arrays import FloatArray
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.attachments import Fingertip, FingertipLoad, footprints_of
from model.transients.base_motion import raised_cosine
from sim.plant.plant import Plant

FREQUENCY = 110.0  # Hz
LANDS, GOES, ENDS = 0.40, 0.60, 0.80  # s
FINGER, OTHER = (0.29, 0.10), (0.08, 0.15)
SHOWN = (0.36, 0.72)  # s
RATE = 10_000.0  # Hz
WINDOW = 0.05  # s; what a map shows the peaks of
MAPS = {"before it lands": LANDS - WINDOW, "just landed": LANDS, "150 ms later": GOES - WINDOW,
        "just lifted": GOES, "150 ms after": GOES + 0.15}  # fmt: skip
TARGET, QUIET, GREY = "#2ca02c", "#1f77b4", "#b0b0b0"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plant.picture", description=__doc__)
    parser.add_argument("file", type=Path)
    file = parser.parse_args().file
    rig = load_rig(RIG)
    x = np.linspace(0, rig.plate.length, 61)
    y = np.linspace(0, rig.plate.width, 46)
    raster = np.array([[a, b] for b in y for a in x])
    points = np.vstack([[FINGER, OTHER], raster])
    times, loaded = vibrate(rig, points, {"finger": FingertipLoad(*FINGER, Fingertip())})
    _, bare = vibrate(rig, points, {})
    figure = draw(times, loaded, bare, x, y)
    FigureCanvasAgg(figure)
    figure.savefig(file, dpi=110)
    print(file)


def vibrate(
    rig: Rig, points: FloatArray, contacts: Mapping[str, FingertipLoad]
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) [s] and accelerations (n, p) [m/s²] from long before the touch to its end."""
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))
    plant = Plant(reduced, rig.eras)
    omega = 2 * np.pi * FREQUENCY
    stroke = 0.2 * rig.eras[1].full_level
    plant.set_input(1, raised_cosine(0.0, 0.02, omega, 0j, stroke))
    times, felt = [], []
    for until, then in ((LANDS, contacts), (GOES, {}), (ENDS, {})):
        shapes = plant.reduced.at(points)
        moments, accelerations = plant.advance(until, sample_rate=RATE, shapes=shapes)
        times.append(moments)
        felt.append(accelerations)
        plant.set_contacts(then)
    return np.concatenate(times), np.concatenate(felt)


def draw(
    times: FloatArray, loaded: FloatArray, bare: FloatArray, x: FloatArray, y: FloatArray
) -> Figure:
    figure = Figure(figsize=(11, 6.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[1.8, 1], squeeze=False)[:, 0]
    panels = upper.subplots(2, 1, sharex=True)
    shown = (times >= SHOWN[0]) & (times <= SHOWN[1])
    for axes, column, color, title in (
        (panels[0], 0, TARGET, "under the finger that lands, right beside the edge"),
        (panels[1], 1, QUIET, "at another place, 22 cm away"),
    ):
        axes.plot(times[shown], bare[shown, column], color=GREY, lw=0.7, label="if it only felt")
        axes.plot(
            times[shown], loaded[shown, column], color=color, lw=0.7, label="it loads the plate"
        )
        axes.axvspan(LANDS, GOES, color="black", alpha=0.05, lw=0)
        axes.set_ylabel("acceleration / (m/s²)")
        axes.set_title(title, loc="left", fontsize=10)
        axes.legend(loc="upper right", fontsize=8, ncols=2)
        axes.set_xlim(*SHOWN)
        axes.margins(y=0.3)  # room for the legend
    panels[1].set_xlabel("time / s; grey: the finger rests on the plate")
    maps = lower.subplots(1, len(MAPS), sharey=True)
    peaks = [
        np.abs(loaded[(times > since) & (times <= since + WINDOW), 2:]).max(axis=0)
        for since in MAPS.values()
    ]
    most = np.max(peaks)
    for axes, title, peak in zip(maps, MAPS, peaks, strict=True):
        image = axes.pcolormesh(
            100 * x, 100 * y, peak.reshape(len(y), len(x)), vmin=0, vmax=most, cmap="magma"
        )
        axes.set_aspect("equal")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("x / cm")
        rests = "landed" in title or "later" in title
        axes.plot(
            *(100 * np.array(FINGER)), "o", color=TARGET if rests else GREY, ms=7, mec="white"
        )
        axes.plot(*(100 * np.array(OTHER)), "o", color=QUIET, ms=7, mec="white")
    maps[0].set_ylabel("y / cm")
    lower.colorbar(image, ax=maps, label="peak in 50 ms / (m/s²)", shrink=0.8)
    return figure


if __name__ == "__main__":
    main()
