"""Columns of numbers as a CSV file, and as a pandas DataFrame."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.errors import InputError
from model.files.array_file import whole_or_nothing

Column: TypeAlias = Sequence[object] | NDArray[np.generic]

Columns: TypeAlias = Mapping[str, Column]
"""Columns of equal length by name, which ends in the unit."""


def write_columns(path: Path, columns: Columns) -> None:
    """Write columns below a line of names, atomically; floats with all their digits.

    Raises OSError.
    """
    plain = [
        column.tolist() if isinstance(column, np.ndarray) else column for column in columns.values()
    ]
    write_rows(path, chain([columns], zip(*plain, strict=True)), line_end="\n")


def write_rows(path: Path, rows: Iterable[Iterable[object]], *, line_end: str = "\r\n") -> None:
    """Write rows, atomically, by default with the line ends of RFC 4180; raises OSError."""
    with whole_or_nothing(path) as stream:
        text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
        csv.writer(text, lineterminator=line_end).writerows(rows)
        text.detach()


def as_frame(columns: Columns) -> Any:
    """A pandas DataFrame of columns; raises InputError where pandas is not installed."""
    try:
        pandas = import_module("pandas")
    except ModuleNotFoundError as error:
        raise InputError("pandas must be installed for to_frame: pip install pandas") from error
    return pandas.DataFrame(dict(columns))
