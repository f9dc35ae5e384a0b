"""CSV files: columns of numbers as one and as a pandas DataFrame, and lines of named columns."""

import cmath
import csv
import io
import logging
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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
_MAX_DB = 200.0
_REMARK = re.compile(r"\s*(?:[*#!]|//)[*#!/\s]*")
_NUMERIC = re.compile(r"\s*[-+.]?\d[-+.,;\d\seE]*$")  # a line of numbers alone
_SPACED = re.compile(r"\d[ \t]+[-+.\d]")
_MEANINGS = {
    column: re.compile(pattern, re.IGNORECASE)
    for column, pattern in {
        "frequency_hz": r"\b(f|fre[qk]\w*|[kM]?hz)\b",
        "phase_deg": r"\b(ph|pha\w*|deg\w*|rad|theta|angle|arg|winkel)\b|[°φθ]",
        "imag": r"\b(im|ima\w*|xs?|reactance)\b",
        "real": r"\b(re|real\w*|rs?|resist\w*)\b",
        "magnitude_db": r"\bdB\b",
        "magnitude": r"\b(z|mag\w*|mod\w*|abs\w*|amp\w*|imped\w*|betrag|[km]?ohms?)\b"
        r"|[\u03a9\u2126]",
    }.items()
}
"""What programs that measure call their columns, by ours: the first that is in a name."""

_UNIT = re.compile(r"([kKmM]?)(?:[hH][zZ]|[oO]hms?|[\u03a9\u2126])")
_PREFIXES = {"": 1.0, "k": 1e3, "K": 1e3, "m": 1e-3, "M": 1e6}

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
        raise InputError(
            "to_frame needs pandas, which is not installed; install it with  pip install pandas"
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

    factors: Mapping[str, float] = field(default_factory=dict)
    """Factors of the numbers of columns in other units, by column."""

    def number(
        self,
        column: str,
        default: float | None = None,
        *,
        at_least: float = -MAX_VALUE,
        at_most: float = MAX_VALUE,
    ) -> float:
        """The number in a column, or what stands for a column that the file does not have.

        Raises InputError for anything but a number within these bounds.
        """
        if default is not None and column not in self.cells:
            return default
        # Some spreadsheet programs write a minus sign of their own.
        text = self.cells[column].replace("\N{MINUS SIGN}", "-")
        try:
            value = float(text.replace(",", ".") if self.has_decimal_comma else text)
        except ValueError:
            value = math.nan
        value *= self.factors.get(column, 1.0)
        if not at_least <= value <= at_most:
            form = "; write all with a decimal point, or all with a comma" if "," in text else ""
            lower = f" from {at_least:g}" if at_least > -MAX_VALUE else ""
            upper = f" up to {at_most:g}" if at_most < MAX_VALUE else ""
            raise InputError(
                f"{self.place}: {column} must be a finite number{lower}{upper}, got "
                f"{text[:30]!r}{form}"
            )
        return value

    def complex_number(self) -> complex:
        """The number of real and imag, or of magnitude or magnitude_db with phase_deg.

        Raises InputError where the file has neither.
        """
        given = self.cells.keys()
        if {"real", "imag"} <= given:
            return complex(self.number("real"), self.number("imag"))
        if "phase_deg" in given and ("magnitude" in given or "magnitude_db" in given):
            if "magnitude" in given:
                size = self.number("magnitude", at_least=0)
            else:
                size = 10 ** (self.number("magnitude_db", at_most=_MAX_DB) / 20)
            return cmath.rect(size, math.radians(self.number("phase_deg")))
        raise InputError(
            f"{self.place}: columns must have magnitude or magnitude_db with phase_deg, or real "
            f"with imag, got {', '.join(name[:30] for name in given)}"
        )


def read_lines(
    path: Path,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
    instead: Sequence[str] = (),
    unnamed: Sequence[str] = (),
) -> Iterator[CsvLine]:
    """Yield the lines of a file whose first line names its columns, in any order.

    Columns are separated by commas, semicolons, tabs or spaces; but for commas a decimal comma is
    read as well, unless another number has a decimal point: it may separate thousands. Empty lines,
    remarks above the names (with *, #, ! or // before them), empty cells behind the last column and
    further columns are skipped. instead: columns in place of the last ones, of a file that has the
    first of them. unnamed: columns of a file that has numbers alone, as programs that measure write
    it; then names of quantities and units are read by their meaning, also from a remark.

    The file is read line by line: one that is damaged takes no more memory than its first lines.
    Raises InputError with file and line for missing and repeated columns, names that may be
    misspelt, lines of another length, and a file without any.
    """
    head = _head_of(path, unnamed)
    has_decimal_comma = head.separator != "," and not _has_points(path, head)
    rows = csv.reader(
        (f"{row}\n" for row in _plain_rows(path, head)),
        strict=True,
        skipinitialspace=True,
        delimiter=head.separator,
    )
    filled = (row for row in rows if any(map(str.strip, row)))
    count = 0
    try:
        header = list(head.names) or [name.strip() for name in next(filled, ())]
        place = f"{path}:{rows.line_num or 1}"
        while header and not header[-1]:
            del header[-1]
        if len(header) > _MAX_COLUMNS:
            raise InputError(
                f"{place}: line must have up to {_MAX_COLUMNS} columns, got {len(header)}; give a "
                "CSV file"
            )
        factors: Mapping[str, float] = {}
        if unnamed:
            header, factors = _meant(header, (*columns, *optional))
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
            yield CsvLine(place, cells, has_decimal_comma, factors)
    except csv.Error as error:
        raise InputError(
            f"{path}:{rows.line_num}: invalid CSV ({error}); check quotes and the end of the file"
        ) from error
    if count == 0:
        raise InputError(f"{path}:1: at least one line of values must follow, got none")


@dataclass(frozen=True)
class _Head:
    """How the rows of a file are read."""

    skipped: int
    """Number of rows before the first that is read."""

    separator: str
    is_spaced: bool
    """Whether spaces separate its columns."""

    has_remarks: bool
    """Whether remarks may stand between its rows."""

    names: Sequence[str]
    """Columns; empty if the first row that is read names them."""


def _head_of(path: Path, unnamed: Sequence[str]) -> _Head:
    """Find where a file begins, and how its columns are separated; raises InputError."""
    above: list[str] = []
    first_row = first_filled = ""
    is_empty = True
    skipped = 0
    for number, row in enumerate(_text_rows(path)):
        if number > _MAX_ABOVE and not first_filled:
            raise InputError(
                f"{path}: columns must be named in the first {_MAX_ABOVE} lines, got none; give a "
                "CSV file"
            )
        if number > _MAX_ABOVE:
            break
        is_empty = is_empty and not row.strip()
        is_remark = _REMARK.match(row) is not None
        if unnamed and not is_remark and _NUMERIC.match(row):
            first_row, skipped = row, number
            break
        if not first_filled and not is_remark and row.strip(_BLANK):
            first_filled = row
        # Below names a line may begin with the name of a sensor, such as #1.
        if not unnamed and row and not is_remark:
            skipped = number
            if first_filled:
                break
        above.append(row)
    if is_empty:
        raise InputError(f"{path}: file is empty; export the measurement again")
    first = first_row or first_filled
    is_spaced = _SPACED.search(first) is not None and not (";" in first or "\t" in first)
    plain = "\t".join(first.split()) if is_spaced else first
    separator = "\t" if is_spaced else next((sign for sign in "\t;" if sign in first), ",")
    names: Sequence[str] = ()
    if first_row:
        count = len([cell for cell in plain.split(separator) if cell.strip()])
        heads = [_REMARK.sub("", row).strip(_BLANK) for row in above]
        split = [_columns(row, separator, count) for row in heads if row]
        default = [f"column {number + 1}" for number in range(count)]
        names = unnamed if count == len(unnamed) else default
        names = next((row for row in reversed(split) if len(row) == count), names)
    return _Head(skipped, separator, is_spaced, bool(unnamed), names)


def _has_points(path: Path, head: _Head) -> bool:
    """Whether a number of a file has a decimal point."""
    return any(_POINT.search(f"\n{row}\n") for row in _plain_rows(path, head))


def _plain_rows(path: Path, head: _Head) -> Iterator[str]:
    """All rows of a file in turn: skipped ones and remarks as empty ones."""
    for number, row in enumerate(_text_rows(path)):
        if number < head.skipped or (head.has_remarks and _REMARK.match(row)):
            yield ""
        elif head.is_spaced:
            yield "\t".join(row.split())
        else:
            yield row


def _text_rows(path: Path) -> Iterator[str]:
    """All rows of a file without their ends; raises InputError for what is no text."""
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


def _columns(row: str, separator: str, count: int) -> list[str]:
    """Names in a line above numbers, which may be separated otherwise than these."""
    tried = (row.split(separator), row.split(","), re.split(r"\t| {2,}", row), row.split())
    found = next((each for each in tried if len(each) == count), [])
    return [name.strip() for name in found]


def _meant(header: Sequence[str], known: Sequence[str]) -> tuple[list[str], dict[str, float]]:
    """Columns by what their names mean, where one is known, and factors of their units."""
    found, factors = list[str](), dict[str, float]()
    for name in header:
        words = name.replace("_", " ")
        meant = (each for each, pattern in _MEANINGS.items() if pattern.search(words))
        column = name if name in known else next(meant, name)
        if column in found or column not in known:
            column = name
        elif unit := _UNIT.search(words):
            factors[column] = _PREFIXES[unit[1]]
        elif re.search(r"\brad", words):
            factors[column] = math.degrees(1)
        found.append(column)
    return found, factors


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
        also = f", optionally {', '.join(optional)}" if optional else ""
        raise InputError(
            f"{place}: columns must be {', '.join(columns)}{also}, got {'; '.join(problems)}"
        )
    if unknown:
        _logger.warning("%s: columns not read: %s", place, named)
