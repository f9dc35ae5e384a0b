"""Draw the pictures of the plate in time: onsets and endings, and a finger that lands.

    python docs/generators/time_pictures.py docs/pictures

Writes transients.png and plant_touch.png for the founding paper's plate, and prints the numbers in
their captions. Takes a minute.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from era_haptics.lab.checks.touch_simulator import loaded_plate
from model.answer.envelope import ONSET_RAMP
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray
from model.figures.style import PAGE_WIDTH, SMALL_TEXT, TITLE_TEXT, save_figure
from model.finger import contrast_db, fingertip_points, fingertip_weights
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.structure.attachments import footprints_of
from model.structure.fingertips import Fingertip, FingertipLoad
from model.table.table_file import build_table
from model.transients.base_motion import (
    Bases,
    raised_cosine,
    ramped_ending,
    ramped_onset,
    shaped,
)
from model.transients.shaping import SAMPLE_RATE, Shaper, Transients
from model.vibration import Excitation
from sim.plant.plant import Plant

RIG = Path(__file__).parents[2] / "examples" / "paper_plate.yaml"

TARGET, QUIET = (0.09, 0.08), (0.24, 0.14)  # m
DRAWN = 0.16  # s
ONSET, LATE = (
    0.1,
    0.04,
)  # s; window of an onset, start of the rest after an ending
TARGET_COLOR, QUIET_COLOR = "0.7", "#b2182b"


def transients_figure(rig: Rig) -> Figure:
    """Draw a steady pattern that starts and ends abruptly, along a ramp, and shaped."""
    table = build_table(rig)
    answer = query(table, Placement((TARGET,), (QUIET,)))
    excitation = answer.layers[0].excitation
    plate = loaded_plate(table, [TARGET, QUIET])
    shaper = Shaper(plate, gain_variance=rig.uncertainty.gain_variance(len(rig.eras)))
    onset = shaper.onset(excitation, targets=[TARGET], quiet=[QUIET])
    ending = shaper.ending(excitation, targets=[TARGET], quiet=[QUIET])
    ramp = f"{1000 * ONSET_RAMP:.0f} ms ramp"
    onsets = {
        "abrupt onset": ramped_onset(excitation, rig.eras, ramp=0.0),
        f"onset with {ramp}": ramped_onset(excitation, rig.eras, ramp=ONSET_RAMP),
        "shaped onset": shaped(onset, rig.eras),
    }
    endings = {
        "abrupt ending": ramped_ending(excitation, rig.eras, ramp=0.0),
        f"ending with {ramp}": ramped_ending(excitation, rig.eras, ramp=ONSET_RAMP),
        "shaped ending": shaped(ending, rig.eras),
    }
    transients = Transients(plate)
    figure = Figure(figsize=(PAGE_WIDTH, 5.6), layout="constrained")
    grid = figure.subplots(len(onsets), 2, sharex=True, sharey=True)
    for axes, (name, bases) in zip(grid[:, 0], onsets.items(), strict=True):
        fingers = _fingers(rig, transients, bases)
        _draw_fingers(axes, fingers)
        axes.set_title(f"{name}: contrast {fingers.onset_contrast_db:.0f} dB", fontsize=TITLE_TEXT)
    for axes, (name, bases) in zip(grid[:, 1], endings.items(), strict=True):
        fingers = _fingers(rig, transients, bases, after=excitation)
        _draw_fingers(axes, fingers)
        rest = f"{fingers.late_target_peak:.1g} m/s² after {1000 * LATE:.0f} ms"
        axes.set_title(f"{name}: {rest}", fontsize=TITLE_TEXT)
    grid[0, 0].legend(loc="upper right", fontsize=SMALL_TEXT)
    figure.supxlabel("time / ms", fontsize=TITLE_TEXT)
    figure.supylabel("acceleration / (m/s²)", fontsize=TITLE_TEXT)
    (frequency,) = {tone.frequency for tone in excitation.values()}
    steady = answer.fingers[0]
    sys.stdout.write(
        f"transients.png: {frequency:g} Hz at {steady.level_db_sl:.0f} dB SL, steady contrast "
        f"{steady.contrast_db:.0f} dB\n"
    )
    return figure


@dataclass(frozen=True)
class _Fingers:
    """Accelerations (n, p) [m/s²] at the points of the target and of the quiet fingertip."""

    target: FloatArray
    quiet: FloatArray
    target_weights: FloatArray

    @property
    def onset_contrast_db(self) -> float:
        """Contrast of the peaks within the first 100 ms [dB]."""
        count = round(ONSET * SAMPLE_RATE)
        target_peaks = np.abs(self.target[:count]).max(axis=0)
        quiet_peaks = np.abs(self.quiet[:count]).max(axis=0)
        return float(contrast_db([target_peaks], quiet_peaks, [self.target_weights]))

    @property
    def late_target_peak(self) -> float:
        """Peak at the target from 40 ms on [m/s²]."""
        return float(np.abs(self.target[round(LATE * SAMPLE_RATE) :]).max())


def _fingers(
    rig: Rig, transients: Transients, bases: Bases, *, after: Excitation | None = None
) -> _Fingers:
    """Simulate both fingertips; after: the steady excitation before, None for a plate at rest."""
    target_points = fingertip_points(*TARGET, rig.plate)
    quiet_points = fingertip_points(*QUIET, rig.plate)
    points = np.concatenate([target_points, quiet_points])
    acceleration = transients.acceleration(bases, points, duration=DRAWN, after=after)
    count = len(target_points)
    weights = fingertip_weights(*TARGET, rig.plate)
    return _Fingers(acceleration[:, :count], acceleration[:, count:], weights)


def _draw_fingers(axes: Axes, fingers: _Fingers) -> None:
    """Draw a point of the target, and the loudest point of the quiet fingertip."""
    milliseconds = 1000 * np.arange(len(fingers.target)) / SAMPLE_RATE
    loudest = int(np.abs(fingers.quiet).max(axis=0).argmax())
    axes.plot(milliseconds, fingers.target[:, 0], color=TARGET_COLOR, lw=0.8, label="target finger")
    axes.plot(
        milliseconds, fingers.quiet[:, loudest], color=QUIET_COLOR, lw=1.0, label="quiet finger"
    )
    axes.tick_params(labelsize=SMALL_TEXT)
    axes.grid(alpha=0.3)


FREQUENCY = 110.0  # Hz
LANDS, LIFTS, ENDS = 0.40, 0.60, 0.80  # s
FINGER, ELSEWHERE = (0.29, 0.10), (0.08, 0.15)  # m
SHOWN = (0.36, 0.72)  # s
RATE = 10_000.0  # Hz
SETTLED = (LIFTS - 0.05, LIFTS)  # s; the vibration under a resting finger is steady again


def touch_figure(rig: Rig) -> Figure:
    """Draw the vibration under a finger that lands, and elsewhere, with and without its load."""
    load = FingertipLoad(*FINGER, Fingertip())
    times, loaded = _vibration(rig, [load])
    _, unloaded = _vibration(rig, [])
    distance = 100 * np.hypot(FINGER[0] - ELSEWHERE[0], FINGER[1] - ELSEWHERE[1])
    titles = ("under the finger, near the plate's edge", f"{distance:.0f} cm away from the finger")
    figure = Figure(figsize=(PAGE_WIDTH, 4.0), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    is_shown = (times >= SHOWN[0]) & (times <= SHOWN[1])
    is_settled = (times > SETTLED[0]) & (times <= SETTLED[1])
    for number, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        curves = (
            ("without load", unloaded, {"color": "0.6", "lw": 1.0, "ls": "--"}),
            ("with the finger's load", loaded, {"color": "#0072b2", "lw": 1.0}),
        )
        for label, accelerations, style in curves:
            axes.plot(times[is_shown], accelerations[is_shown, number], label=label, **style)
        axes.axvspan(LANDS, LIFTS, color="black", alpha=0.08, lw=0)
        axes.set_title(title, loc="left", fontsize=TITLE_TEXT)
        axes.tick_params(labelsize=SMALL_TEXT)
        axes.set_xlim(*SHOWN)
        with_load = np.abs(loaded[is_settled, number]).max()
        without_load = np.abs(unloaded[is_settled, number]).max()
        ratio = with_load / without_load
        sys.stdout.write(f"plant_touch.png, {title}: {ratio:.2f} times the vibration\n")
    panels[0].margins(y=0.25)  # room for the legend
    panels[0].legend(loc="upper right", fontsize=SMALL_TEXT, ncols=2)
    panels[1].set_xlabel("time / s (shaded: the finger rests on the plate)", fontsize=TITLE_TEXT)
    figure.supylabel("acceleration / (m/s²)", fontsize=TITLE_TEXT)
    return figure


def _vibration(rig: Rig, contacts: Sequence[FingertipLoad]) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) [s] and accelerations (n, 2) [m/s²] under the finger and elsewhere."""
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras))
    plant = Plant(reduced, rig.eras)
    driven = 1
    amplitude = 0.2 * rig.eras[driven].full_level
    onset = raised_cosine(0.0, 0.02, 2 * np.pi * FREQUENCY, 0j, amplitude)
    plant.set_input(driven, onset)
    resting = {f"finger {number}": load for number, load in enumerate(contacts)}
    times, accelerations = [], []
    for end, next_contacts in ((LANDS, resting), (LIFTS, {}), (ENDS, {})):
        shapes = plant.reduced.at(np.array([FINGER, ELSEWHERE]))
        moments, samples = plant.advance(end, sample_rate=RATE, shapes=shapes)
        times.append(moments)
        accelerations.append(samples)
        plant.set_contacts(next_contacts)
    return np.concatenate(times), np.concatenate(accelerations)


def main() -> None:
    """Draw both pictures into a folder."""
    folder = Path(sys.argv[1])
    rig = load_rig(RIG)
    save_figure(transients_figure(rig), folder / "transients.png")
    save_figure(touch_figure(rig), folder / "plant_touch.png")


if __name__ == "__main__":
    main()
