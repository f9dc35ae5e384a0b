"""Columns of numbers as a CSV file."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.files.array_file import whole_or_nothing

Column: TypeAlias = Sequence[object] | NDArray[np.generic]

Columns: TypeAlias = Mapping[str, Column]
"""Columns of equal length by their name, which ends in their unit."""


def write_columns(path: Path, columns: Columns) -> None:
    """Write columns with a line of names above them; floats with every digit that tells them apart.

    The file is either the old one or the whole new one. Raises OSError where it cannot be written.
    """
    plain = [
        column.tolist() if isinstance(column, np.ndarray) else column for column in columns.values()
    ]
    with whole_or_nothing(path) as stream:
        text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*plain, strict=True))
        text.detach()
