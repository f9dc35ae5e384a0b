"""Pictures of the desk without hardware: its responses, and a touch felt at one of two fingers.

    python -m benchmarks.desk.picture [--seed 3]

writes docs/pictures/desk_calibration.png, by `era measure` and `era calibrate` as typed, and
docs/pictures/desk_touch.png: a pattern of the calibrated plate's table on the plate itself, whose
model in time is not the table's.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from benchmarks.desk.session import desk
from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Truth, draw_truth
from benchmarks.setting import use_one_thread
from model.arrays import FloatArray, lattice
from model.figures import draw_eras, save_figure
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import sensation_level
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.structure.attachments import fingertip_loads
from model.table.file import load_table
from model.table.question import Question
from model.vibration.excitation import Excitation
from sim.sensors.sensor_file import WiredSensor

PICTURES = Path(__file__).parents[2] / "docs" / "pictures"
MESH = "8x6 Q3"
RATE = 48_000
FINGERS = {"felt": (0.10, 0.15), "quiet": (0.21, 0.08)}  # m
COLORS = {"felt": "#1f9d55", "quiet": "#2779bd"}
_LEVEL = 20.0  # dB SL
_ALONG = (121, 91)
_SHOWN, _RAMP = 0.2, 0.04  # s


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.desk.picture", description=__doc__)
    parser.add_argument("--seed", type=int, default=3)
    seed = parser.parse_args().seed
    use_one_thread()
    with (
        tempfile.TemporaryDirectory(prefix="desk") as name,
        desk(Path(name), seed=seed, mesh=MESH) as plate,
    ):
        plate.run(
            "measure", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
            "-o", "measured.uff",
        )  # fmt: skip
        plate.run(
            "calibrate", "rig.yaml", "measured.uff", "-o", "calibrated.yaml",
            "--picture", "calibration.png",
        )  # fmt: skip
        shutil.copyfile(plate.folder / "calibration.png", PICTURES / "desk_calibration.png")
        plate.run("table", "build", "calibrated.yaml", "-o", "table.npz", "--mode", "phased")
        rig = load_rig(plate.folder / "rig.yaml")
        table = load_table(plate.folder / "table.npz")
    question = Question((FINGERS["felt"],), (FINGERS["quiet"],), level_db_sl=_LEVEL)
    pattern = table.query(question)
    truth = draw_truth(rig, seed=seed, mesh=MESH)
    save_figure(touch_figure(rig, truth, pattern.excitation), PICTURES / "desk_touch.png")


def touch_figure(rig: Rig, truth: Truth, excitation: Excitation) -> Figure:
    """The level over the plate with both fingers on it, and both accelerations from the start."""
    figure = Figure(figsize=(10.5, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    _draw_level(left, rig, truth, excitation)
    _draw_start(right, rig, truth, excitation)
    tones = ", ".join(sorted({f"{tone.frequency:.0f}" for tone in excitation.values()}))
    figure.suptitle(f"simulated plate on the desk, one pattern at {tones} Hz", fontsize=10)
    return figure


def _draw_level(axes: Axes, rig: Rig, truth: Truth, excitation: Excitation) -> None:
    plate = rig.plate
    x, y = (
        np.linspace(0, side, n) for side, n in zip((plate.length, plate.width), _ALONG, strict=True)
    )
    points = lattice(x, y)
    fingers = fingertip_loads(truth.rig.fingertip, list(FINGERS.values()))
    model = DeskModel(truth, points).under(fingers)
    frequencies = np.unique([tone.frequency for tone in excitation.values()])
    bases = np.zeros((len(frequencies), len(rig.eras)), dtype=complex)
    for number, era in enumerate(rig.eras):
        if (tone := excitation.get(era.name)) is not None:
            row = np.searchsorted(frequencies, tone.frequency)
            bases[row, number] = tone.amplitude / era.stroke * np.exp(1j * tone.phase)
    amplitudes = np.abs(np.einsum("fpe,fe->fp", model.response(frequencies), bases))
    level = sensation_level(frequencies, amplitudes).reshape(len(y), len(x))
    image = axes.pcolormesh(
        100 * x, 100 * y, level, cmap="magma", norm=Normalize(-15, 30), shading="gouraud"
    )
    axes.figure.colorbar(image, ax=axes, label="level / dB SL", extend="both")
    draw_eras(axes, rig.eras, active=excitation.keys())
    outline = [withStroke(linewidth=2.5, foreground="white")]
    for name, place in FINGERS.items():
        at = (100 * place[0], 100 * place[1])
        axes.add_patch(
            Circle(
                at, 100 * FINGERTIP_RADIUS, fill=False, color=COLORS[name], lw=2,
                path_effects=outline,
            )
        )  # fmt: skip
        axes.annotate(
            name, at, xytext=(0, 16), textcoords="offset points", ha="center",
            color=COLORS[name], path_effects=outline,
        )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlabel("x / cm")
    axes.set_ylabel("y / cm")


def _draw_start(axes: Axes, rig: Rig, truth: Truth, excitation: Excitation) -> None:
    """What accelerometers without noise under both fingers record."""
    sensors = [
        WiredSensor(name, *place, number, 2e-3)
        for number, (name, place) in enumerate(FINGERS.items(), start=1)
    ]
    plate = DeskPlate(truth, sensors, rate=RATE, converters=Converters(delay=0, noise=0.0), seed=1)
    plate.set_fingers(list(FINGERS.values()))
    heard = plate.advance(_played(rig, plate.outputs, excitation))
    times = 1e3 * np.arange(len(heard)) / RATE
    for sensor in sensors:
        acceleration = heard[:, sensor.input - 1] / sensor.sensitivity
        axes.plot(
            times, acceleration, color=COLORS[sensor.name], lw=0.8, label=f"{sensor.name} finger"
        )
    axes.set_xlabel("time / ms")
    axes.set_ylabel("acceleration / m/s²")
    axes.grid(alpha=0.2)
    axes.margins(y=0.2)
    axes.legend(loc="upper left", ncols=2, fontsize=9)


def _played(rig: Rig, outputs: int, excitation: Excitation) -> FloatArray:
    """Samples (n, outputs) of a pattern with its ramp."""
    times = np.arange(round(_SHOWN * RATE)) / RATE
    ramp = np.sin(np.clip(times / _RAMP, 0, 1) * np.pi / 2) ** 2
    found = np.zeros((len(times), outputs))
    for era in rig.eras:
        if (tone := excitation.get(era.name)) is not None:
            angle = 2 * np.pi * tone.frequency * times + tone.phase
            found[:, rig.wiring[era.name].number] = tone.amplitude / era.stroke * np.sin(angle)
    return np.asarray(found * ramp[:, None])


if __name__ == "__main__":
    main()
