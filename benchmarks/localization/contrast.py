"""Felt contrast of every drive mode on plates that deviate, beside what answers promise."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.localization.cases import contact_sets, paper_table, question_of
from model.arrays import FloatArray
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.finger.perception import decibels
from model.table.exact_plates import draw_plates, felt_on
from model.table.question import Question

KINDS = ((1, 1), (1, 2), (1, 3), (2, 1), (2, 2))
"""Numbers of targets and quiet fingers."""

PLATES = 200


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


def mode_section(sets: int, seed: int) -> Section:
    """Every drive mode: promised, and felt in the median and on nine of ten plates."""
    rows, kept, data = [], [], {}
    for targets, quiet in KINDS:
        for drive_mode in DRIVE_MODES:
            rng = np.random.default_rng([seed, targets, quiet])
            found = []
            for places in contact_sets(sets, fingers=targets + quiet, rng=rng):
                question = question_of(places, targets=targets, drive_mode=drive_mode)
                figures = _figures(question, rng)
                if figures is not None:
                    found.append(figures)
            columns = np.array(found).T
            kept.append(columns[-1].mean())
            data[targets, quiet, drive_mode] = columns
            rows.append(
                [
                    f"{targets} target{'s' if targets > 1 else ''}, {quiet} quiet, {drive_mode}",
                    *(shown(values) for values in columns[:-1]),
                    f"{100 * columns[-1].mean():.0f} %",
                ]
            )
    return Section(
        "Felt contrast [dB] on deviating plates with loading fingers, median (10th percentile)",
        ["", "promised", "nine of ten plates", "typical", "as modelled", "kept"],
        rows,
        notes=[f"promise kept on {100 * np.mean(kept):.0f} % of all plates"],
        data=data,
    )


def shown(values: Sequence[float] | FloatArray) -> str:
    """Median, and the tenth percentile in brackets."""
    there = np.array(values, dtype=float)
    return f"{np.median(there):.1f} ({np.percentile(there, 10):.1f})"


def _figures(question: Question, rng: np.random.Generator) -> list[float] | None:
    """Promised, at nine of ten plates, typical and nominal contrast [dB], and share kept."""
    table = paper_table()
    try:
        pattern = table.query(question)
    except InputError:
        return None
    contacts = len(question.targets) + len(question.quiet)
    plates = draw_plates(
        rng, table.uncertainty, count=PLATES, era_count=len(table.eras), contact_count=contacts
    )
    contrast = felt_on(table, question, pattern.excitation, plates).contrast
    if contrast is None or pattern.robust_felt_contrast_db is None:
        return None
    found = decibels(contrast.felt[0])
    return [
        pattern.robust_felt_contrast_db,
        float(np.percentile(found, 10)),
        float(np.median(found)),
        float(pattern.felt_contrast_db or 0.0),
        float((found >= pattern.robust_felt_contrast_db).mean()),
    ]
