"""The paper's plate on a mesh that is quick to solve, as smooth as its fields, and its table."""

from dataclasses import replace
from functools import cache

import numpy as np

from model.answer.promise import FingersOnPlate
from model.answer.stimulus import Placement
from model.drive_modes import Forms
from model.fem import ELEMENTS, Mesh
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from paper_plate import make_paper_rig

FREQUENCIES = np.linspace(40.0, 500.0, 27)


def smooth_rig() -> Rig:
    """The paper's rig on 6x5 elements of the fifth order, promising by one set of thresholds."""
    rig = make_paper_rig(6, 5)
    mesh = Mesh(6, 5, rig.plate.length, rig.plate.width, ELEMENTS["Q5"])
    return replace(rig, mesh=mesh, promised_thresholds=(rig.threshold,))


def forms_of(table: LocalizationTable, placed: Placement, level_db_sl: float = 20.0) -> Forms:
    """Expected powers at fingertips, at all frequencies of a table."""
    fingers = FingersOnPlate.of(table, placed.contacts, placed.loads)
    formed = fingers.forms(np.arange(len(table.frequencies)), with_fine=True)
    every, count = range(len(placed.contacts)), len(placed.targets)
    return formed.of(every[:count], every[count:], level_db_sl)


@cache
def smooth_table() -> LocalizationTable:
    """Its table at 27 frequencies from 40 to 500 Hz."""
    return build_table(smooth_rig(), frequencies=FREQUENCIES)


def contact_sets(count: int, *, fingers: int, seed: int) -> list[list[tuple[float, float]]]:
    """Fingertips anywhere on the paper's plate, at least 5 cm apart."""
    rng = np.random.default_rng(seed)
    plate = smooth_rig().plate
    found: list[list[tuple[float, float]]] = []
    while len(found) < count:
        places = rng.uniform(0, [plate.length, plate.width], (fingers, 2))
        gaps = np.linalg.norm(places[:, None] - places, axis=-1)
        if gaps[np.triu_indices(fingers, 1)].min() >= 0.05:
            found.append([(float(x), float(y)) for x, y in places])
    return found
