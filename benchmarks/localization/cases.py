"""Contact sets on the paper's plate, and its table."""

from functools import cache

import numpy as np

from benchmarks.setting import APART, RIG, random_contacts
from model.arrays import FloatArray
from model.finger.perception import STRONG_DB_SL
from model.rig.file import load_rig
from model.table.build import build_table
from model.table.question import Question
from model.table.table import LocalizationTable

FREQUENCIES = np.linspace(40.0, 500.0, 27)


@cache
def paper_table() -> LocalizationTable:
    """The table of the paper's plate that all figures are from."""
    return build_table(load_rig(RIG), frequencies=FREQUENCIES)


def contact_sets(
    count: int, *, fingers: int, rng: np.random.Generator, apart: float = APART
) -> FloatArray:
    """Sets of fingers [m] anywhere on the plate, (count, fingers, 2)."""
    plate = paper_table().plate
    size = (plate.length, plate.width)
    return np.array([random_contacts(rng, fingers, size, apart=apart) for _ in range(count)])


def question_of(
    places: FloatArray,
    *,
    targets: int = 1,
    level_db_sl: float = STRONG_DB_SL,
    drive_mode: str | None = None,
) -> Question:
    """The first ones are targets, the others quiet."""
    points = [(float(x), float(y)) for x, y in places]
    return Question(
        tuple(points[:targets]),
        tuple(points[targets:]),
        level_db_sl=level_db_sl,
        drive_mode=drive_mode,
    )
