"""CSV files: writing columns and rows, and reading lines with named columns."""

import csv
import io
import logging
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.errors import MAX_VALUE, InputError
from model.files.array_file import whole_or_nothing
from model.files.uff import open_measured, text_stream
from registry.files import LineTooLong, lines_of
from registry.plugins import did_you_mean

_MAX_NAMED = 3  # unknown columns in an error
_MAX_COLUMNS = 1000
_MAX_LINE = 1 << 16  # characters
_MAX_ABOVE = 1000  # lines above the first of values
_POINT = re.compile(r'[;\t"\n][-+]?\d+\.\d+(?:[eE][-+]?\d+)?[;\t"\n]')  # a number with one
_BLANK = "\n ,;\t"  # of lines without content
_REMARK = re.compile(r"\s*(?:[*#!]|//)[*#!/\s]*")

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
    """Return a pandas DataFrame of columns; raises InputError if pandas is not installed."""
    try:
        pandas = import_module("pandas")
    except ModuleNotFoundError as error:
        raise InputError(
            "to_frame needs pandas, which is not installed; install the extra `frames`, or run  "
            "pip install pandas"
        ) from error
    return pandas.DataFrame(dict(columns))


@dataclass(frozen=True)
class CsvLine:
    """A line of a CSV file."""

    place: str
    """File and number of the line, for errors."""

    cells: Mapping[str, str]
    """Text by column."""

    has_decimal_comma: bool = False
    """Whether numbers may have a comma in place of a point."""

    def number(self, column: str, default: float | None = None) -> float:
        """Return the number in a column, or the default for a missing column.

        Raises InputError for anything but a finite number of usual size.
        """
        if default is not None and column not in self.cells:
            return default
        # Some spreadsheet programs write a minus sign of their own.
        text = self.cells[column].replace("\N{MINUS SIGN}", "-")
        try:
            value = float(text.replace(",", ".") if self.has_decimal_comma else text)
        except ValueError:
            value = math.nan
        if not abs(value) <= MAX_VALUE:
            form = "; write all with a decimal point, or all with a comma" if "," in text else ""
            raise InputError(
                f"{self.place}: {column} must be a finite number, got {text[:30]!r}{form}"
            )
        return value


def read_lines(
    path: Path,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
    instead: Sequence[str] = (),
) -> Iterator[CsvLine]:
    """Yield the lines of a file whose first line names its columns, in any order.

    Columns are separated by commas, semicolons or tabs. With semicolons and tabs a decimal comma is
    accepted unless a number has a decimal point, because a comma can then separate thousands. Empty
    lines, remarks above the names (after *, #, ! or //), empty cells behind the last column and
    unknown columns are skipped. instead: columns that replace the last columns if the file has the
    first replacement.

    The file is read line by line: a damaged file takes no more memory than its first lines. Raises
    InputError with file and line for missing and repeated columns, names that are probably
    misspelt, lines of another length, and a file without lines.
    """
    skipped, separator = _head_of(path)
    has_decimal_comma = separator != "," and not _has_points(path, skipped)
    rows = csv.reader(
        (f"{row}\n" for row in _rows_from(path, skipped)),
        strict=True,
        skipinitialspace=True,
        delimiter=separator,
    )
    filled = (row for row in rows if any(map(str.strip, row)))
    count = 0
    try:
        header = [name.strip() for name in next(filled, ())]
        place = f"{path}:{rows.line_num or 1}"
        while header and not header[-1]:
            del header[-1]
        if len(header) > _MAX_COLUMNS:
            raise InputError(
                f"{place}: line must have up to {_MAX_COLUMNS} columns, got {len(header)}; give a "
                "CSV file"
            )
        if instead and instead[0] in header:
            columns = (*columns[: -len(instead)], *instead)
        _check_header(place, header, columns, optional)
        for row in filled:
            place = f"{path}:{rows.line_num}"
            while len(row) > len(header) and not row[-1].strip():
                del row[-1]
            if len(row) != len(header):
                raise InputError(
                    f"{place}: line must have {len(header)} values as the first line has, got "
                    f"{len(row)}; the file is damaged"
                )
            cells = dict(zip(header, map(str.strip, row), strict=True))
            count += 1
            yield CsvLine(place, cells, has_decimal_comma)
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: invalid CSV ({error}); check quotes and the end of the file"
        ) from error
    if count == 0:
        raise InputError(f"{path}:1: at least one line of values must follow, got none")


def _head_of(path: Path) -> tuple[int, str]:
    """Return the number of rows above the names of columns, and the separator of columns.

    Raises InputError for a file without names.
    """
    is_empty = True
    for number, row in enumerate(_text_rows(path)):
        if number > _MAX_ABOVE:
            raise InputError(
                f"{path}: columns must be named in the first {_MAX_ABOVE} lines, got none; give a "
                "CSV file"
            )
        is_empty = is_empty and not row.strip()
        is_remark = _REMARK.match(row) is not None
        if row.strip(_BLANK) and not is_remark:
            separator = next((sign for sign in "\t;" if sign in row), ",")
            return number, separator
    if is_empty:
        raise InputError(f"{path}: file is empty; export the measurement again")
    return 0, ","


def _has_points(path: Path, skipped: int) -> bool:
    """Whether a number of a file has a decimal point."""
    return any(_POINT.search(f"\n{row}\n") for row in _rows_from(path, skipped))


def _rows_from(path: Path, skipped: int) -> Iterator[str]:
    """Yield all rows of a file; skipped rows are empty, so that lines keep their numbers."""
    for number, row in enumerate(_text_rows(path)):
        yield "" if number < skipped else row


def _text_rows(path: Path) -> Iterator[str]:
    """Yield all rows of a file without line ends; raises InputError for a binary file."""
    with open_measured(path) as file, text_stream(file) as stream:
        try:
            for number, row in enumerate(lines_of(stream, _MAX_LINE)):
                if "\0" in row:
                    raise InputError(
                        f"{path}: file must be text in UTF-8, got zero bytes; export it as such"
                    )
                # Spreadsheet programs state the separator in the first row.
                is_separator = number == 0 and row.lower().startswith("sep=")
                yield "" if is_separator else row
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: text must be UTF-8; save it as such") from error
        except LineTooLong as error:
            raise InputError(f"{path}:{error.line}: {error}; give a CSV file") from error


def _check_header(
    place: str, header: Sequence[str], columns: Sequence[str], optional: Sequence[str]
) -> None:
    absent = [name for name in (*columns, *optional) if name not in header]
    missing = [name for name in columns if name not in header]
    unknown = [name for name in header if name not in (*columns, *optional)]
    further = f" and {len(unknown) - _MAX_NAMED} more" if len(unknown) > _MAX_NAMED else ""
    named = ", ".join(repr(name[:30]) for name in unknown[:_MAX_NAMED]) + further
    is_misspelt = any(did_you_mean(name, absent) for name in unknown)
    if missing or is_misspelt or len(set(header)) < len(header):
        problems = [f"{', '.join(missing)} missing"] if missing else []
        problems += [f"{named} unknown"] if unknown else []
        problems += ["a column is repeated"] if not problems else []
        also = f", optionally {', '.join(optional)}" if optional else ""
        raise InputError(
            f"{place}: columns must be {', '.join(columns)}{also}, got {'; '.join(problems)}"
        )
    if unknown:
        _logger.warning("%s: columns not read: %s", place, named)
