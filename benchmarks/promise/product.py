"""The model's answers for the same contact sets, from its own tables."""

import json
from functools import cache

import numpy as np

from benchmarks.promise.optimum import Drive
from benchmarks.promise.plate import CORNERS, LENGTH, MID_EDGES, WIDTH, Spread
from benchmarks.setting import RIG
from model.arrays import FloatArray
from model.config.document import read_document
from model.rig.file import parse_rig
from model.table.build import build_table
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.table import LocalizationTable

FREQUENCIES = np.linspace(40.0, 500.0, 27)


@cache
def table_for(eras: int, spread: Spread, *, loaded: bool) -> LocalizationTable:
    """Build the table of the paper's plate on four or eight ERAs for what a rig says of itself."""
    rig = dict(read_document(RIG).data)
    rig["eras"] = {
        f"E{number}": {
            "at": [float(x * LENGTH), float(y * WIDTH)],
            "stiffness": 17_000,
            "damping_ratio": 0.05,
            "amplifier": "main",
            "channel": number,
        }
        for number, (x, y) in enumerate([*CORNERS, *MID_EDGES][:eras])
    }
    rig["uncertainty"] = vars(spread)
    if not loaded:
        rig["fingertip"] = "none"
    return build_table(
        parse_rig("promise", json.dumps(rig)), frequencies=FREQUENCIES, drive_mode="phased"
    )


def answer(
    table: LocalizationTable, places: FloatArray, *, level_db_sl: float
) -> tuple[Drive, Pattern]:
    """The pattern for fingers (n, 2) [m], the first of them the target, and its drive."""
    points = [(float(x), float(y)) for x, y in places]
    question = Question(
        tuple(points[:1]), tuple(points[1:]), level_db_sl=level_db_sl, envelopes=True
    )
    pattern = table.query(question)
    tones = [pattern.excitation.get(era.name) for era in table.eras]
    (frequency,) = {tone.frequency for tone in tones if tone is not None}
    weights = np.array([0 if tone is None else tone.phasor for tone in tones], dtype=complex)
    return Drive(float(frequency), weights / np.abs(weights).max()), pattern
