"""Cost of errors: the promised contrast with a kind of error, and without it.

Kinds of errors are the amplifiers' clock errors, the rig's weather, an object on the plate, and
each tolerance of a rig. The contrasts are computed at a few positions, in a second.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from model.answer.plan import answer, worst_of
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.drive_modes import UNRESTRICTED
from model.ensemble.draws import ClockErrors
from model.errors import InputError
from model.finger import FINGERTIP_RADIUS
from model.rig.rig import BOUNDS, Rig
from model.study.contact_sets import random_contacts
from model.study.weak_cells import contrasts_of
from model.table.table import PAPER_GRID, LocalizationTable
from model.table.table_file import TableProblem, solve_table

_PAIRS = 16
_QUESTIONS = 8  # for each tolerance
_SEED = 14
_LEVEL_DB_SL = 14.0
_FREQUENCY_STEP = 20.0  # Hz
_HIGHEST_FREQUENCY = 250.0  # Hz: fingers are most sensitive there, and more would take longer


@dataclass(frozen=True)
class PromiseCost:
    """Promised contrast [dB] at the worst of two fingers, without and with a kind of error."""

    exact_db: float
    kept_db: float


def clock_cost(rig: Rig, errors: Mapping[str, float]) -> PromiseCost:
    """Compute the contrast of two contents with exact clocks, and with rms errors [s] by amplifier.

    Median over positions. Raises InputError for a plate too small for two fingers, or without a
    table.
    """
    table = _coarse_table(rig)
    clocks = ClockErrors.of([era.name for era in table.eras], rig.wiring, errors)
    exact = _promised_db(table)
    # Built after these answers, so that the copy shares their cached results.
    with_errors = table.with_clocks(clocks)
    return _cost(exact, _promised_db(with_errors))


def uncertainty_cost(rig: Rig, key: str) -> PromiseCost:
    """Compute the contrast of two contents with a key of the uncertainty set to 0, and unchanged.

    Median over positions; raises the errors of `clock_cost`.
    """
    table = _coarse_table(rig)
    without_key = replace(rig.uncertainty, **{key: 0.0})
    exact_table = replace(table, uncertainty=without_key)
    return _cost(_promised_db(exact_table), _promised_db(table))


def tolerance_costs(table: LocalizationTable) -> dict[str, float]:
    """Return how much each tolerance of the rig costs [dB], the most expensive first.

    The cost of a key of `uncertainty` is the increase of the promised contrast with one quiet
    finger if this tolerance is 0, averaged over random positions. Empty if the plate is too small
    for two fingers, or reaches the level nowhere.
    """
    rng = np.random.default_rng(_SEED)
    questions = []
    with suppress(InputError):
        for _ in range(_QUESTIONS):
            target, quiet = random_contacts(rng, 2, table.plate, margin=FINGERTIP_RADIUS)
            questions.append(Placement((target,), (quiet,)))
    promised = [contrasts_of(table, question) for question in questions]
    costs = {}
    for key, (exact, _) in BOUNDS.items():
        if getattr(table.uncertainty, key) == exact:
            continue
        uncertainty = replace(table.uncertainty, **{key: exact})
        exact_table = replace(table, uncertainty=uncertainty)
        gains = []
        for question, kept in zip(questions, promised, strict=True):
            without_error = contrasts_of(exact_table, question)
            if kept is not None and without_error is not None:
                gains.append(without_error[0] - kept[0])
        if gains:
            costs[key] = float(np.mean(gains))
    by_cost = sorted(costs.items(), key=lambda cost: cost[1], reverse=True)
    return dict(by_cost)


def _coarse_table(rig: Rig) -> LocalizationTable:
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    highest = max(min(high, _HIGHEST_FREQUENCY), low)
    frequencies = np.arange(low, highest + 1e-9, _FREQUENCY_STEP)
    problem = TableProblem(rig, frequencies, PAPER_GRID)
    return solve_table(problem, drive_mode=UNRESTRICTED, is_estimated=False)


def _promised_db(table: LocalizationTable) -> FloatArray:
    """Return the contrast (pairs,) promised to the worst of two fingers at random positions."""
    rng = np.random.default_rng(_SEED)
    contrasts = []
    for _ in range(_PAIRS):
        contacts = random_contacts(rng, 2, table.plate, margin=FINGERTIP_RADIUS)
        fingers = [Finger(contact, Stimulus(_LEVEL_DB_SL)) for contact in contacts]
        contrasts.append(worst_of(answer(table, fingers, min_contrast_db=-math.inf)))
    return np.array(contrasts)


def _cost(exact: FloatArray, kept: FloatArray) -> PromiseCost:
    # The loss is computed per position, because contrasts differ much more between positions.
    loss = max(float(np.median(exact - kept)), 0.0)
    median = float(np.median(exact))
    return PromiseCost(median, median - loss)
