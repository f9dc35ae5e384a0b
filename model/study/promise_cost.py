"""Cost of errors: the promised contrast with a kind of error, and without it.

Kinds of errors are the amplifiers' clock errors, the rig's weather, an object on the plate, and
each tolerance of a rig. The contrasts are computed at a few positions, in a second.
"""

import math
from collections.abc import Mapping, Sequence
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
from model.rig.rig import BOUNDS, Rig, Uncertainty
from model.structure.fingertips import Fingertip
from model.study.contact_sets import random_contacts
from model.study.overview import promised_to_another
from model.study.weak_cells import contrasts_of
from model.table.table import PAPER_GRID, LocalizationTable
from model.table.table_file import TableProblem, build_table, solve_table

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


@dataclass(frozen=True)
class ToleranceCosts:
    """Promised contrast of a finger to another, and the cost of each tolerance of a rig."""

    promised_db: float
    """See `promised_to_another`."""

    costs_db: Mapping[str, float]
    """Increase of the promise if a key of `uncertainty` is exact, by key, the largest first."""


def uncertainty_costs(rig: Rig) -> ToleranceCosts | None:
    """Compute the promise of a rig's table, and the costs of its tolerances.

    None if the plate is too small for two fingers, or reaches the level nowhere. Raises InputError
    for a rig without a table.
    """
    table = build_table(rig)
    promised_db = promised_to_another(table)
    if promised_db is None:
        return None
    return ToleranceCosts(promised_db, costs_of_tolerances(table))


def costs_of_tolerances(table: LocalizationTable) -> dict[str, float]:
    """Return the increase of a promise [dB] for each tolerance that is not exact, largest first.

    Mean over random positions, at frequencies up to 250 Hz in steps of 20 Hz, without the
    discretization error: all frequencies would take ten times as long. Empty if no position reaches
    the level.
    """
    table = _coarse(table)
    rng = np.random.default_rng(_SEED)
    questions = []
    with suppress(InputError):
        for _ in range(_QUESTIONS):
            target, quiet = random_contacts(rng, 2, table.plate, margin=FINGERTIP_RADIUS)
            questions.append(Placement((target,), (quiet,)))
    promised_db = _promises_db(table, questions)
    costs = {}
    for key, (exact, _) in BOUNDS.items():
        if getattr(table.uncertainty, key) == exact:
            continue
        uncertainty = replace(table.uncertainty, **{key: exact})
        exact_table = replace(table, uncertainty=uncertainty)
        gains = _promises_db(exact_table, questions) - promised_db
        if not np.isnan(gains).all():
            costs[key] = float(np.nanmean(gains))
    return dict(sorted(costs.items(), key=lambda cost: cost[1], reverse=True))


def _coarse(table: LocalizationTable) -> LocalizationTable:
    """Return a table with fewer of its frequencies, without discretization error."""
    rows = list[int]()
    for row, frequency in enumerate(table.frequencies.tolist()):
        is_low = frequency <= _HIGHEST_FREQUENCY or not rows
        if is_low and (not rows or frequency - table.frequencies[rows[-1]] >= _FREQUENCY_STEP):
            rows.append(row)
    return replace(
        table,
        frequencies=table.frequencies[rows],
        discretization_error=np.zeros(len(rows)),
    )


def _promises_db(table: LocalizationTable, questions: Sequence[Placement]) -> FloatArray:
    """Return the promised contrast (questions,) [dB], NaN where the level is not reached."""
    promises = []
    for question in questions:
        contrasts = contrasts_of(table, question)
        promises.append(math.nan if contrasts is None else contrasts[0])
    return np.array(promises)


MEASUREMENTS = {
    "gain": "era rig identify",
    "phase_deg": "era rig identify",
    "thickness": "era rig identify",
    "modulus": "era rig identify",
    "stiffness": "era rig identify",
    "damping": "era rig identify",
    "place": "era rig identify",
    "supports": "era rig identify",
    "mode_frequency": "era rig identify",
    "mode_amplitude": "a modal test of the built part",
    "field": "era rig identify with more sensors",
    "level": "era rig identify at the level of use",
    "harmonic": "distortion of the drives at full level",
    "touch_position": "calibration of the touch panel",
    "common_gain": "era rig identify",
    "fingertip": "force or size of each contact",
    "weather": "era rig identify in each season",
    "foreign_mass": "permanent loads, to list under masses",
}
"""Measurement that reduces each tolerance most."""

_LEAST_COST = 0.05  # dB of a tolerance that is listed


def cost_rows(uncertainty: Uncertainty, costs: ToleranceCosts) -> list[str]:
    """Return the table of costs, and the measurement that gains most, as lines."""
    listed = {key: cost for key, cost in costs.costs_db.items() if cost >= _LEAST_COST}
    if not listed:
        return []
    rows = [
        f"a finger is promised at least {costs.promised_db:.1f} dB of contrast to another (median);"
        " more if exact:"
    ]
    for key, cost in listed.items():
        exact = Uncertainty.none()
        tolerance = str(replace(exact, **{key: getattr(uncertainty, key)}))
        rows.append(f"    {tolerance:24s} {cost:5.1f} dB  {MEASUREMENTS.get(key, '')}".rstrip())
    key, cost = next(iter(listed.items()))
    rows.append(f"{key} costs most, {cost:.1f} dB: measure it ({MEASUREMENTS[key]})")
    return rows


_FORCE_COST = 0.5  # dB of the fingertip's tolerance from which harder touches break promises


def force_rows(rig: Rig, costs: ToleranceCosts) -> list[str]:
    """Return the keys to set for harder touches, as lines; none if loads of fingers matter little.

    Rigs whose other tolerances are small, by identification, lose promises if touches press harder
    than the default `fingertip` (docs/measured/promise.md).
    """
    is_default = rig.fingertip == Fingertip() and rig.uncertainty.fingertip <= Uncertainty.fingertip
    if not is_default or costs.costs_db.get("fingertip", 0.0) < _FORCE_COST:
        return []
    return [
        "promises are for touches of 0.3 to 0.5 N; for 0.3 to 2 N on a panel that reports neither "
        "force nor size of contacts, set",
        "    fingertip: {stiffness: 1.8 kN/m, damping: 3.6 N s/m, contact_mass: 0.36 g}",
        "    uncertainty: {fingertip: 0.8}",
    ]


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
