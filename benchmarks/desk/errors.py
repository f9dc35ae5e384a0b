"""Errors of values that were found of a plate, and the table of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_PERCENT = (100.0, " %")
_UNITS = {"place": (1e3, " mm"), "phase": (math.degrees(1), "°")}


@dataclass(frozen=True)
class Error:
    """A found value relative to the truth, bolts to the plate's share; in standard errors too.

    Per mass of the plate, which no response shows; of a place [m] and of a phase [rad] the
    difference; in_standard_errors: None where none is stated.
    """

    kind: str
    relative: float
    in_standard_errors: float | None


def errors_table(errors: Sequence[Error]) -> str:
    """Lines of a table with a row for each kind of value, in their order."""
    rows = [
        "| value | error, median | largest | intervals of 95 % that hold the truth | values |",
        "|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(one.kind for one in errors):
        some = [one for one in errors if one.kind == kind]
        scale, unit = _UNITS.get(kind, _PERCENT)
        sizes = scale * np.abs([one.relative for one in some])
        stated = [one.in_standard_errors for one in some if one.in_standard_errors is not None]
        held = f"{100 * np.mean(np.abs(stated) < 1.96):.0f} %" if stated else "–"
        rows.append(
            f"| {kind} | {np.median(sizes):.2f}{unit} | {sizes.max():.2f}{unit} | {held} "
            f"| {len(some)} |"
        )
    return "\n".join(rows)
