"""Promises on plates in air: `python -m benchmarks.promise air`.

Two contents of 14 dB SL on plates that are solved exactly, drawn within the tolerances, with air on
both sides. Answers ignore the air, with a modulus that a fit has changed so that the natural
frequencies agree on average, or count it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.promise.cases import EXAMPLES, IDENTIFIED
from benchmarks.promise.weather import contrasts_on, promised_and_kept
from model.answer.answer import Answer
from model.arrays import FloatArray, Point
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.structure.plate import Plate, SurroundingAir
from model.study.exact_plates import draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import natural_modes

HIGHEST = 320.0  # Hz; of answers, and of the modes that a fit adjusts


def _fitted(rig: Rig, true: Plate) -> Rig:
    """Return a rig in a vacuum whose plate has the natural frequencies of a true one on average."""
    vacuum, in_air = (
        natural_modes(
            replace(rig, plate=plate), rig.plate.modes_below(HIGHEST), support="free"
        ).frequencies
        for plate in (rig.plate, true)
    )
    factor = float(np.exp(2 * np.log(in_air / vacuum).mean()))
    return replace(rig, plate=rig.plate.scaled(modulus=factor))


def run(sets: int, plates: int) -> None:
    """Print a row for each rig and its surroundings."""
    print("| | ignored: promised, kept | counted: promised, kept |\n|---|---|---|")
    paper = load_rig(EXAMPLES / "paper_plate.yaml")
    known = replace(paper, uncertainty=IDENTIFIED)
    eight = replace(load_rig(EXAMPLES / "eight_eras.yaml"), uncertainty=IDENTIFIED)
    light = change_rig(known, plate={"material": "acrylic", "thickness": 0.002})
    film = change_rig(known, plate={"material": "polycarbonate", "thickness": 0.001})
    for label, rig in (
        ("4 ERAs default", paper),
        ("4 ERAs identified", known),
        ("8 ERAs identified", eight),
        ("4 ERAs identified, acrylic of 2 mm", light),
        ("4 ERAs identified, polycarbonate of 1 mm", film),
    ):
        in_air = replace(rig.plate, air=SurroundingAir.BOTH)
        true = _table(replace(rig, plate=in_air))
        ignoring = _table(_fitted(rig, in_air))
        cells = [_promised_and_kept(table, true, sets, plates) for table in (ignoring, true)]
        print(f"| {label} | {' | '.join(cells)} |", flush=True)


def _table(rig: Rig) -> LocalizationTable:
    return build_table(rig, drive_mode="phased", frequencies=np.arange(40.0, HIGHEST + 1, 10.0))


def _promised_and_kept(
    table: LocalizationTable, true: LocalizationTable, sets: int, plates: int
) -> str:
    def felt(rng: np.random.Generator, best: Answer, positions: Sequence[Point]) -> FloatArray:
        drawn = draw_plates(rng, true.uncertainty, count=plates, of=true, contact_count=2)
        return contrasts_on(true, best, positions, drawn)

    return promised_and_kept(table, sets, felt)
