"""Cases of which `make test` takes a few; `make test-long` takes the others."""

from collections.abc import Collection, Iterable, Sequence
from itertools import cycle
from typing import Any

import pytest


def shortly(values: Iterable[Any], short: Collection[Any]) -> list[Any]:
    """Values for `parametrize`, long ones marked; short: those that `make test` takes."""
    return [value if value in short else _long(value) for value in values]


def in_turn(rows: Iterable[Any], columns: Sequence[Any]) -> list[Any]:
    """All pairs of a row and a column; `make test` takes every row, and the columns in turn."""
    return [
        (row, column) if column == taken else _long(row, column)
        for row, taken in zip(rows, cycle(columns), strict=False)
        for column in columns
    ]


def _long(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.long)
