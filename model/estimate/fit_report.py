"""Parts of the reports of calibrations and identifications: table of values, lines on quality.

A table lists each fitted value with its standard error, the value before the fit, and the
parameter whose error is most correlated with its own.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from model.arrays import FloatArray
from model.quantities import percent
from model.rig.rig import Uncertainty

_MIN_CORRELATION = 0.9  # of two errors, above which a report names the other parameter


class TableRow(NamedTuple):
    """Texts of a fitted value, one per column."""

    name: str
    fitted: str
    standard_error: str
    value_before: str
    note: str


_HEADER = TableRow("", "fitted", "standard error", "before", "note")


def table_lines(rows: Sequence[TableRow]) -> list[str]:
    """Return the lines of a table of fitted values, with a header."""
    cells = [_HEADER, *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]


def confusions(names: Sequence[str], covariance: FloatArray) -> list[str]:
    """Return the name of the parameter with the most correlated error, for each parameter.

    The name is empty if the correlation is at most 0.9. covariance: of the errors, (p, p).
    """
    std = np.sqrt(np.diagonal(covariance))
    std = np.where(std > 0, std, np.inf)
    correlations = np.abs(covariance / np.outer(std, std)) * ~np.eye(len(std), dtype=bool)
    confused = [""] * len(names)
    for number, nearest in enumerate(correlations.argmax(axis=1).tolist()):
        if correlations[number, nearest] > _MIN_CORRELATION:
            confused[number] = names[nearest]
    return confused


def quality_rows(
    uncertainty: Uncertainty, held_out: str, error: float | None, note: str
) -> list[str]:
    """Return lines on the uncertainty of the new rig and on the prediction of held-out data.

    held_out: the data; error: of their prediction relative to the response, None if there were too
    few sensors for a prediction.
    """
    prediction = "too few sensors to leave any out"
    if error is not None:
        prediction = f"{held_out} predicted within {percent(error)} of the response"
    return [f"uncertainty in the new rig: {uncertainty}", f"held out: {prediction}; {note}"]
