# %% [markdown]
"""
# A plate, its table, and what fingers feel

For researchers. Open it as a notebook in VS Code or, with jupytext, in Jupyter, and start with
`%matplotlib inline` to see its pictures, or run it with `python examples/researcher.py`. It writes
pictures to the folder ERA_PICTURES if that is set.

Places are metres from the corner SW, x along the plate's length, y along its width. A vibration is
felt from 12 dB SL on, decibels above what a fingertip just detects, and strong at 20.
"""

# %%
import os
from pathlib import Path

import numpy as np

import era_haptics as era

pictures = os.environ.get("ERA_PICTURES")


def show(figure, name):
    """Write a picture if a folder is set; a notebook shows the returned figure."""
    if pictures:
        figure.savefig(Path(pictures) / f"{name}.png", dpi=150)
    return figure


# %% [markdown]
"""
## The plate
The founding paper's: 12 x 9 inches of aluminium, 1.5 mm thick, on four ERAs under its corners. On
the paper's own mesh of 12 x 9 elements its Table 2 comes out, digit by digit; `mesh: auto`, as
in the rig, is within 0.1 % of converged.
"""

# %%
rig = era.load_rig(era.example_rig_path())
paper = era.SolvedPlate(era.load_rig(era.example_rig_path(), mesh="12x9"))
plate = era.SolvedPlate(rig)

paper_frequencies = paper.modes.natural_frequencies[:5]
print("mesh 12x9:", " ".join(f"{frequency:.2f}" for frequency in paper_frequencies), "Hz")
for frequency, ratio in zip(
    plate.modes.natural_frequencies, plate.modes.damping_ratios, strict=True
):
    print(f"{frequency:8.2f} Hz  damping ratio {100 * ratio:.1f} %")

# %% [markdown]
"""
## A map
Two ERAs on a diagonal at 110 Hz, one of them with half its stroke and a quarter of a period ahead.
They are at one frequency, so that their complex amplitudes add, and where these cancel are nulls.
"""

# %%
drive = {"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90)}
field = plate.map(drive)
print(f"largest {field.peak.max():.1f} m/s², {len(field.nulls)} nulls")
show(era.draw_map(plate, drive, title="SW 110 Hz, NE half of it, 90° ahead"), "map")

# %% [markdown]
"""
## Felt here, not there
One finger shall feel 20 dB SL, the other as little as possible. The table has each ERA's field at
each frequency; from these it picks amplitudes and phases for the fingers.
"""

# %%
table = era.table(rig)
target, quiet = (0.08, 0.06), [(0.22, 0.16)]
only = era.query(table, target, quiet=quiet)
for name, tone in table.drive_of(only.layers[0].excitation).items():
    print(name, {key: round(value, 3) for key, value in tone.items()})
print(
    f"felt contrast at least {only.fingers[0].promised_contrast_db:.1f} dB on nine of ten plates "
    f"within the rig's uncertainty, {only.fingers[0].contrast_db:.1f} dB on the nominal plate"
)
show(era.draw_answer(table, only), "answer")

# %% [markdown]
"""
## Each finger its own
Both fingers shall feel something now, each its own vibration. What is promised is its level above
the power of all others where that finger is; played in time, it is what the finger feels of both.
"""

# %%
both = era.answer(table, [era.Finger(at, era.Stimulus()) for at in (target, *quiet)])
for said, felt in zip(both.fingers, plate.play(both).fingers, strict=True):
    print(
        f"{said.finger.at}: {said.verdict}, {said.promised_contrast_db:.1f} dB promised, "
        f"{felt.contrast_db:.1f} dB felt; of the others at most "
        f"{felt.foreign_levels_db_sl.max():.1f} dB SL while it starts"
    )
show(era.draw_contents(table, both), "contents")

# %% [markdown]
"""
## In time
The predictions above are steady ones. Here the first pattern starts from rest on the plate in
time, along a ramp and with shaped onsets, which keep the quiet finger quiet from the start.
"""

# %%
shaped = era.query(table, target, quiet=quiet, shaped=True)
played = {name: (each, plate.play(each)) for name, each in (("ramp", only), ("shaped", shaped))}
print("              steady / dB      first 100 ms / dB    target / dB SL")
print("         predicted   felt    predicted   felt     predicted   felt")
for name, (answer, felt) in played.items():
    predicted, more = answer.fingers[0], era.measures(table, answer)
    print(
        f"{name:8} {predicted.contrast_db:7.1f} {felt.contrast_db:8.1f} "
        f"{more.transient_contrast_db:10.1f} {felt.transient_contrast_db:8.1f} "
        f"{predicted.level_db_sl:11.1f} {felt.level_db_sl:8.1f}"
    )
promised = only.fingers[0].promised_contrast_db
drawn = [era.SolvedPlate(rig, seed=seed).play(only).contrast_db for seed in range(10)]
print(
    f"on ten drawn plates {min(drawn):.1f} to {max(drawn):.1f} dB felt, "
    f"{sum(felt >= promised for felt in drawn)} of them at least the {promised:.1f} dB promised"
)
show(era.draw_playback(played["ramp"][1]), "ramp")

# %%
show(era.draw_playback(played["shaped"][1]), "shaped")

# %% [markdown]
"""
## A small study: how near may the other finger be?
The other finger moves away from the target along a line, in the paper's mode (`switched`: ERAs on
or off) and with free amplitudes and phases (`phased`), from one table: the felt contrast promised.
"""

# %%
distances = np.array([0.02, 0.03, 0.05, 0.08, 0.12])
study = {
    drive_mode: np.array(
        [
            era.query(
                table,
                target,
                quiet=(target[0] + distance, target[1]),
                drive_mode=drive_mode,
            )
            .fingers[0]
            .promised_contrast_db
            for distance in distances
        ]
    )
    for drive_mode in ("switched", "phased")
}
print("distance / cm", 100 * distances)
for drive_mode, promised_db in study.items():
    print(f"{drive_mode} / dB", promised_db.round(1))
