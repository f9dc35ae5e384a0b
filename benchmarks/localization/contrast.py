"""Realised contrast of every method for one, two and three quiet fingers, and of two targets."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.localization.bounds import mixture_bound, robust_bound
from benchmarks.localization.cases import (
    NO_ERRORS,
    Errors,
    contact_sets,
    fields_of,
    paper_table,
    question_of,
    quiet_centres,
    weights_of,
)
from benchmarks.localization.methods import (
    inverse_filter,
    reversed_pulse_contrast,
    time_reversal,
)
from model.arrays import ComplexArray, FloatArray
from model.drive_modes import DRIVE_MODES, Choice, find_drives
from model.drive_modes.exact_search import search_exactly
from model.drive_modes.fields import Fields
from model.finger.perception import decibels
from model.table.robust import with_robust_contrast

QUIET = (1, 2, 3)
GOALS = {
    "switched": {1: "17 (12)", 2: "11 (7)", 3: "8.5 (5)"},
    "phased": {1: "27 (19)", 2: "17 (12)", 3: "13 (9)"},
}


@dataclass
class Section:
    """A table of figures, with what stands over and under it."""

    title: str
    columns: list[str]
    rows: list[list[str]]
    notes: list[str] = field(default_factory=list)
    data: dict[Any, Any] = field(default_factory=dict)

    def text(self) -> str:
        table = [self.columns, *self.rows]
        widths = [max(len(row[column]) for row in table) for column in range(len(self.columns))]
        lines = [
            "  ".join(
                cell.ljust(width) if number == 0 else cell.rjust(width)
                for number, (cell, width) in enumerate(zip(row, widths, strict=True))
            )
            for row in table
        ]
        return "\n".join([self.title, *(f"  {line}" for line in lines), *self.notes])


def shown(values: Sequence[float | None]) -> str:
    """Median, and the tenth percentile in brackets."""
    there = np.array(values, dtype=float)
    return f"{np.median(there):.1f} ({np.percentile(there, 10):.1f})"


def contrast_section(sets: int, draws: int, seed: int) -> Section:
    """Every method on the same contact sets, with and without errors."""
    nominal: dict[tuple[str, int], list[float]] = {}
    realised: dict[tuple[str, int], list[float | None]] = {}
    for quiet in QUIET:
        rng = np.random.default_rng([seed, quiet])
        for places in contact_sets(sets, fingers=quiet + 1, rng=rng):
            errors = Errors.draw(draws, eras=4, rng=rng)
            for name, (without, with_errors) in _methods(places, errors).items():
                nominal.setdefault((name, quiet), []).append(without)
                realised.setdefault((name, quiet), []).append(with_errors)
    names = list(dict.fromkeys(name for name, _ in realised))
    rows = []
    for name in names:
        row = [name]
        for quiet in QUIET:
            values = realised[name, quiet]
            row += [shown(nominal[name, quiet]), "" if values[0] is None else shown(values)]
        rows.append(row)
    for drive_mode, goals in GOALS.items():
        rows.append(
            [f"goal, {drive_mode}", *(cell for quiet in QUIET for cell in ("", goals[quiet]))]
        )
    return Section(
        "Contrast [dB], median (10th percentile): without errors, realised",
        ["", *(cell for quiet in QUIET for cell in (f"{quiet} quiet", "realised"))],
        rows,
        notes=[
            "bounds hold for any drive of their kind without errors; the robust score includes the",
            "mean effect of errors of 10 %, and its bound holds for any complex weights at any of",
            "the frequencies.",
        ],
        data={"realised": realised, "names": names},
    )


def _methods(places: FloatArray, errors: Errors) -> dict[str, tuple[float, float | None]]:
    """By name, contrast of one contact set without errors and realised (None: a bound)."""
    fields = fields_of(places)
    found: dict[str, tuple[float, float | None]] = {}

    def add(name: str, weights: ComplexArray) -> None:
        found[name] = (
            float(NO_ERRORS.contrast_db(fields, weights)[0]),
            float(np.median(errors.contrast_db(fields, weights))),
        )

    add("time reversal, one frequency", time_reversal(fields))
    found["time reversal, pulse of 27"] = (
        float(reversed_pulse_contrast(fields, NO_ERRORS)[0]),
        float(np.median(reversed_pulse_contrast(fields, errors))),
    )
    add("inverse filter", inverse_filter(fields, quiet_centres(places)))
    add("the paper's: switched, 1 or 2 ERAs", weights_of(_best(fields, "switched").drive, fields))
    exact = search_exactly(fields, eras_at_most=4)
    assert exact.drive is not None
    add("switched, exact, 1 to 4 ERAs", weights_of(exact.drive, fields))
    found["  bound: any mixture of these"] = (
        float(decibels(mixture_bound(fields, eras_at_most=4))),
        None,
    )
    for drive_mode in ("graded", "signed", "phased"):
        choice = _best(fields, drive_mode)
        add(drive_mode, weights_of(choice.drive, fields))
    found["  robust score of phased"] = (float(decibels(choice.evaluation.score)), None)
    found["  bound of that score"] = (float(decibels(robust_bound(fields))), None)
    return found


def _best(fields: Fields, drive_mode: str) -> Choice:
    choice = find_drives(fields, drive_mode)
    assert choice is not None  # the wanted level is reached everywhere
    return choice


def two_target_section(sets: int, draws: int, seed: int) -> Section:
    """Two targets at once: the contrast of the weaker one."""
    rows = []
    for quiet in (1, 2):
        cells: dict[str, list[float]] = {drive_mode: [] for drive_mode in DRIVE_MODES}
        for_one: list[float] = []
        rng = np.random.default_rng([seed, 100 + quiet])
        for places in contact_sets(sets // 4, fingers=quiet + 2, rng=rng):
            errors = Errors.draw(draws, eras=4, rng=rng)
            fields = fields_of(places, targets=2)
            for drive_mode, values in cells.items():
                drive = _best(fields, drive_mode).drive
                realised = errors.contrast_db(fields, weights_of(drive, fields))
                values.append(float(np.median(realised)))
            alone = fields_of(np.delete(places, 1, axis=0))
            drive = _best(alone, "phased").drive
            realised = errors.contrast_db(alone, weights_of(drive, alone))
            for_one.append(float(np.median(realised)))
        rows.append(
            [f"2 targets, {quiet} quiet", *(shown(v) for v in cells.values()), shown(for_one)]
        )
    return Section(
        "Two targets: realised contrast [dB] of the weaker one, median (10th percentile)",
        ["", *DRIVE_MODES, "phased, one of them only"],
        rows,
    )


def ensemble_section(sets: int, seed: int) -> Section:
    """Robust contrast over the whole ensemble of plates, for patterns of 12 dB SL."""
    table = paper_table()
    rows = []
    for drive_mode in DRIVE_MODES:
        row = [drive_mode]
        for quiet in QUIET:
            rng = np.random.default_rng([seed, 200 + quiet])
            values = []
            for places in contact_sets(sets, fingers=quiet + 1, rng=rng):
                question = question_of(places, drive_mode=drive_mode, level_db_sl=12.0)
                pattern = with_robust_contrast(table, question, table.query(question))
                values.append(pattern.robust_contrast_db)
            row.append(shown(values))
        rows.append(row)
    return Section(
        "Deviating plates: robust contrast [dB], median (10th percentile)",
        ["", *(f"{quiet} quiet" for quiet in QUIET)],
        rows,
        notes=[
            "nine of ten plates have more. They vary in gains, phases, stiffness of each ERA",
            "(10 %), thickness (2 %) and damping (half to twice), with fingers that press on the",
            "plate, and in the table's discretisation error. Patterns are chosen for a plain ramp.",
        ],
    )


def freedom_section(sets: int, seed: int) -> Section:
    """How often, and by how much, a mode's answer has a lower robust score than a poorer mode's."""
    names = list(DRIVE_MODES)
    rows = []
    for quiet in (1, 2, 3, 9):
        rng = np.random.default_rng([seed, 400 + quiet])
        apart = 0.05 if quiet < 6 else 0.03
        scores = []
        for places in contact_sets(sets, fingers=quiet + 1, rng=rng, apart=apart):
            fields = fields_of(places)
            scores.append([_best(fields, drive_mode).evaluation.score for drive_mode in names])
        ahead = decibels(np.array(scores)[:, :-1] / np.array(scores)[:, 1:])
        rows.append(
            [f"{quiet} quiet"]
            + [f"{int((column > 1e-6).sum())}, {max(column.max(), 0):.2f} dB" for column in ahead.T]
        )
    return Section(
        f"Modes with more freedom but less contrast: number of {sets} contact sets, maximum "
        "difference",
        ["", *(f"{name} below {poorer}" for poorer, name in pairwise(names))],
        rows,
    )
