"""CSV files: columns of numbers as one and as a pandas DataFrame, and lines of named columns."""

import csv
import io
import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.errors import InputError
from model.files.array_file import whole_or_nothing
from model.files.uff import read_bytes, text_of
from registry.suggestions import did_you_mean

_MAX_NAMED = 3  # unknown columns in an error
_SEPARATORS = (",", ";", "\t")
_POINT = re.compile(r'[;\t"\n][-+]?\d+\.\d+(?:[eE][-+]?\d+)?[;\t"\n]')  # a number with one
_BLANK = "\n ,;\t"  # of lines without content

_logger = logging.getLogger(__name__)

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


@dataclass(frozen=True)
class Line:
    """A line of a file: its file and number, for errors, and the text of each column.

    has_decimal_comma: whether a number may have a comma in place of a point.
    """

    place: str
    cells: Mapping[str, str]
    has_decimal_comma: bool = False

    def number(self, column: str, default: float | None = None) -> float:
        """The number in a column, or what stands for a column that the file does not have.

        Raises InputError for anything but a finite number.
        """
        if default is not None and column not in self.cells:
            return default
        # Some spreadsheet programs write a minus sign of their own.
        text = self.cells[column].replace("\N{MINUS SIGN}", "-")
        try:
            value = float(text.replace(",", ".") if self.has_decimal_comma else text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            form = "; write all with a decimal point, or all with a comma" if "," in text else ""
            raise InputError(
                f"{self.place}: {column} must be a finite number, got {text[:30]!r}{form}"
            )
        return value


def read_lines(path: Path, columns: Sequence[str], *, optional: Sequence[str] = ()) -> list[Line]:
    """Read a file whose first line names its columns, in any order.

    Columns are separated by commas, semicolons or tabs; with the latter two a decimal comma is read
    as well, unless another number has a decimal point: it may separate thousands. Empty lines,
    empty cells behind the last column and further columns are skipped. Raises InputError with file
    and line for missing and repeated columns, names that may be misspelt, lines of another length,
    and a file without any.
    """
    text = text_of(path, read_bytes(path)).replace("\r\n", "\n").replace("\r", "\n")
    first = text.partition("\n")[0]
    if first.lower().startswith("sep="):  # of a spreadsheet program
        text = text[len(first) :]
    separator = max(_SEPARATORS, key=text.lstrip(_BLANK).partition("\n")[0].count)
    rows = csv.reader(io.StringIO(text), strict=True, skipinitialspace=True, delimiter=separator)
    has_decimal_comma = separator != "," and _POINT.search(text) is None
    filled = (row for row in rows if any(map(str.strip, row)))
    lines = []
    try:
        header = [name.strip() for name in next(filled, ())]
        while header and not header[-1]:
            del header[-1]
        _check_header(f"{path}:{rows.line_num}", header, columns, optional)
        for row in filled:
            place = f"{path}:{rows.line_num}"
            while len(row) > len(header) and not row[-1].strip():
                del row[-1]
            if len(row) != len(header):
                raise InputError(
                    f"{place}: line must have {len(header)} values as the first line has, got "
                    f"{len(row)}; the file is damaged"
                )
            cells = map(str.strip, row)
            lines.append(Line(place, dict(zip(header, cells, strict=True)), has_decimal_comma))
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: invalid CSV ({error}); check quotes and the end of the file"
        ) from error
    if not lines:
        raise InputError(f"{path}:1: at least one line of values must follow, got none")
    return lines


def _check_header(
    place: str, header: Sequence[str], columns: Sequence[str], optional: Sequence[str]
) -> None:
    absent = [name for name in (*columns, *optional) if name not in header]
    missing = [name for name in columns if name not in header]
    unknown = [name for name in header if name not in (*columns, *optional)]
    more = f" and {len(unknown) - _MAX_NAMED} more" if len(unknown) > _MAX_NAMED else ""
    named = ", ".join(repr(name[:30]) for name in unknown[:_MAX_NAMED]) + more
    is_misspelt = any(did_you_mean(name, absent) for name in unknown)
    if missing or is_misspelt or len(set(header)) < len(header):
        problems = [f"{', '.join(missing)} missing"] if missing else []
        problems += [f"{named} unknown"] if unknown else []
        problems += ["a column is repeated"] if not problems else []
        raise InputError(
            f"{place}: columns must be {', '.join(columns)}, optionally {', '.join(optional)}, "
            f"got {'; '.join(problems)}"
        )
    if unknown:
        _logger.warning("%s: columns not read: %s", place, named)
