"""What two contents keep of their contrast while the amplifiers' clocks are held to some error.

By answers of the rig's own plate, at few places and frequencies, in a second.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model.answer.plan import answer, worst_of
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray
from model.drive_modes import UNRESTRICTED
from model.ensemble.draws import ClockErrors
from model.finger import FINGERTIP_RADIUS
from model.rig.rig import Rig
from model.study.random_contacts import random_contacts
from model.table.build import TableProblem, solve_table
from model.table.table import PAPER_GRID, LocalizationTable

_PAIRS, _SEED, _LEVEL_DB_SL = 16, 14, 14.0
_STEP, _HIGHEST = 20.0, 250.0  # Hz; fingers feel most there, and a table of more takes longer


@dataclass(frozen=True)
class ClockCost:
    """Contrast promised to the worst of two fingers, median over places, and what is kept [dB]."""

    exact_db: float
    kept_db: float


def clock_cost(rig: Rig, errors: Mapping[str, float]) -> ClockCost:
    """Contrast of two contents with exact clocks, and with errors by amplifier, rms [s].

    Raises InputError for a plate on which two fingers have no room, or that makes no table.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    frequencies = np.arange(low, max(min(high, _HIGHEST), low) + 1e-9, _STEP)
    problem = TableProblem(rig, frequencies, PAPER_GRID)
    table = solve_table(problem, drive_mode=UNRESTRICTED, is_estimated=False)
    clocks = ClockErrors.of([era.name for era in table.eras], rig.wiring, errors)
    exact = _promised_db(table)
    kept = _promised_db(table.with_clocks(clocks))  # made now: it shares what answers have computed
    # Of places one by one, which differ by far more.
    lost = max(float(np.median(exact - kept)), 0.0)
    median = float(np.median(exact))
    return ClockCost(median, median - lost)


def _promised_db(table: LocalizationTable) -> FloatArray:
    """Contrast promised to the worst of two fingers at places anywhere (pairs,)."""
    rng, found = np.random.default_rng(_SEED), list[float]()
    for _ in range(_PAIRS):
        fingers = [
            Finger(at, Stimulus(_LEVEL_DB_SL))
            for at in random_contacts(rng, 2, table.plate, margin=FINGERTIP_RADIUS)
        ]
        found.append(worst_of(answer(table, fingers, min_contrast_db=-math.inf)))
    return np.array(found)
