# %% [markdown]
"""
# Model a plate, build its table, predict what fingers feel

For researchers. Open this file as a notebook in VS Code (or in Jupyter with jupytext) and start
with `%matplotlib inline` to see the figures, or run `python examples/researcher.py`. If the
environment variable ERA_PICTURES names a folder, the figures are saved there.

Positions are in meters from the south-west corner: x along the plate's length, y along its width.
Levels are in dB SL, decibels above the detection threshold of a fingertip. A vibration of 12 dB SL
is felt; 20 dB SL is strong.
"""

# %%
import os
from pathlib import Path

import numpy as np

import era_haptics as era

pictures = os.environ.get("ERA_PICTURES")


def show(figure, name):
    """Save a figure if a folder is set, and return it for the notebook."""
    if pictures:
        figure.savefig(Path(pictures) / f"{name}.png", dpi=150)
    return figure


# %% [markdown]
"""
## The plate
The plate of the founding paper: 12 x 9 inches of aluminium, 1.5 mm thick, with an ERA under each
corner. The paper's mesh of 12 x 9 elements reproduces its Table 2 to the last digit. The rig's own
mesh, `mesh: auto`, is converged to 0.1 %.
"""

# %%
rig = era.load_rig(era.example_rig_path())
plate = era.SolvedPlate(rig)
paper_rig = era.load_rig(era.example_rig_path(), mesh="12x9")
paper_plate = era.SolvedPlate(paper_rig)

paper_frequencies = paper_plate.modes.natural_frequencies[:5]
print("mesh 12x9:", " ".join(f"{frequency:.2f}" for frequency in paper_frequencies), "Hz")
for frequency, damping in zip(
    plate.modes.natural_frequencies, plate.modes.damping_ratios, strict=True
):
    print(f"{frequency:8.2f} Hz  damping ratio {100 * damping:.1f} %")

# %% [markdown]
"""
## A map
Two ERAs on a diagonal run at 110 Hz. One has half the amplitude and leads by a quarter of a
period. At equal frequencies the complex amplitudes add, and nulls appear where they cancel.
"""

# %%
drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90)}
vibration = plate.map(drive)
print(f"maximum {vibration.peak.max():.1f} m/s², {len(vibration.nulls)} nulls")
show(era.draw_map(plate, drive, title="SW at 110 Hz, NE at half amplitude, 90° ahead"), "map")

# %% [markdown]
"""
## One target finger, one quiet finger
The target finger should feel 20 dB SL, and the other finger as little as possible. The table
contains the vibration that each ERA causes at each frequency. The query uses it to choose a
frequency, and an amplitude and a phase for each ERA.
"""

# %%
table = era.table(rig)
target = (0.08, 0.06)
quiet = (0.22, 0.16)
plain = era.query(table, target, quiet=[quiet])
for name, tone in table.drive_of(plain.layers[0].excitation).items():
    print(name, {key: round(value, 3) for key, value in tone.items()})
promised_db = plain.fingers[0].promised_contrast_db
print(
    f"contrast: at least {promised_db:.1f} dB on 90 % of plates within the rig's tolerances, "
    f"{plain.fingers[0].contrast_db:.1f} dB on the nominal plate"
)
show(era.draw_answer(table, plain), "answer")

# %% [markdown]
"""
## A vibration for each finger
Now both fingers should feel something, each its own vibration. The promised isolation of a finger
is the level of its own vibration relative to the power of all others at that finger. Playing the
answer on the simulated plate shows what the finger actually feels.
"""

# %%
fingers = [era.Finger(target, era.Stimulus()), era.Finger(quiet, era.Stimulus())]
joint = era.answer(table, fingers)
for predicted, felt in zip(joint.fingers, plate.play(joint).fingers, strict=True):
    print(
        f"{predicted.finger.at}: {predicted.verdict}, isolation "
        f"{predicted.promised_contrast_db:.1f} dB promised, {felt.contrast_db:.1f} dB felt; "
        f"other vibrations peak at {felt.foreign_levels_db_sl.max():.1f} dB SL during the onset"
    )
show(era.draw_contents(table, joint), "contents")

# %% [markdown]
"""
## The onset
The predictions above are for the steady state. Here the first answer starts from rest, once with a
linear ramp and once with shaped onsets, which keep the quiet finger quiet from the start.
"""

# %%
shaped = era.query(table, target, quiet=[quiet], shaped=True)
answers = {"ramp": plain, "shaped": shaped}
playbacks = {name: plate.play(answer) for name, answer in answers.items()}
print("              steady / dB      first 100 ms / dB    target / dB SL")
print("         predicted   felt    predicted   felt     predicted   felt")
for name, answer in answers.items():
    steady = answer.fingers[0]
    onset = era.measures(table, answer)
    felt = playbacks[name]
    print(
        f"{name:8} {steady.contrast_db:7.1f} {felt.contrast_db:8.1f} "
        f"{onset.transient_contrast_db:10.1f} {felt.transient_contrast_db:8.1f} "
        f"{steady.level_db_sl:11.1f} {felt.level_db_sl:8.1f}"
    )
show(era.draw_playback(playbacks["ramp"]), "ramp")

# %%
show(era.draw_playback(playbacks["shaped"]), "shaped")

# %% [markdown]
"""
## Tolerances
The same answer on ten plates drawn at random from the rig's tolerances.
"""

# %%
contrasts_db = []
for seed in range(10):
    random_plate = era.SolvedPlate(rig, seed=seed)
    contrasts_db.append(random_plate.play(plain).contrast_db)
kept = sum(contrast >= promised_db for contrast in contrasts_db)
print(
    f"ten random plates: {min(contrasts_db):.1f} to {max(contrasts_db):.1f} dB felt; "
    f"{kept} reach the promised {promised_db:.1f} dB"
)

# %% [markdown]
"""
## A small study: how close can the quiet finger be?
The quiet finger moves away from the target along a line. The same table is queried in the paper's
drive mode (`switched`: ERAs on or off) and with free amplitudes and phases (`phased`).
"""

# %%
distances = np.array([0.02, 0.03, 0.05, 0.08, 0.12])
study = {}
for drive_mode in ("switched", "phased"):
    promises = []
    for distance in distances:
        neighbor = (target[0] + distance, target[1])
        answer = era.query(table, target, quiet=[neighbor], drive_mode=drive_mode)
        promises.append(answer.fingers[0].promised_contrast_db)
    study[drive_mode] = np.array(promises)
print("distance / cm", 100 * distances)
for drive_mode, promises in study.items():
    print(f"{drive_mode} / dB", promises.round(1))
