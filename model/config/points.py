"""Positions, counts and frequency ranges as text of the command line."""

import math
import re
from typing import TYPE_CHECKING

from model.errors import InputError

if TYPE_CHECKING:
    from model.arrays import FloatArray

# More is a typing error.
MAX_FREQUENCIES = 2000


def parse_point(text: str, *, what: str) -> tuple[float, float]:
    """Position [m] from `X,Y`; what: the option, for the error."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        raise InputError(
            f"{what} must be X,Y in metres without a unit, such as {what} 0.10,0.08, got {text!r}"
        ) from None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"{what}: both coordinates must be finite, got {text!r}")
    return x, y


def in_metres(x: float, y: float, *, length: float, width: float) -> str:
    """Remedy for a place off the plate that would be on it in cm or mm, else "".

    length, width [m]: of the plate. Coordinates below 1 are not taken for another unit.
    """
    for unit, count in (("cm", 100), ("mm", 1000)):
        sides = ((x, length), (y, width))
        if all(at == 0 or 1 <= at <= count * side for at, side in sides):
            return (
                f"; positions are in metres: for {x:g} {unit}, {y:g} {unit} give "
                f"{x / count:g},{y / count:g}"
            )
    return ""


def parse_pair(text: str, *, what: str) -> tuple[int, int]:
    """Two counts from `12x9`."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[x×]\s*(\d{1,6})\s*", text)
    if match is None:
        raise InputError(f"{what} must be two numbers such as 12x9, got {text!r}")
    return int(match[1]), int(match[2])


def parse_frequencies(text: str) -> "FloatArray":
    """Frequencies (f,) [Hz] from `LO:HI:STEP`, both ends included, or from a list `60,110,250`.

    Raises InputError for anything else, and for a frequency given twice.
    """
    import numpy as np  # which other commands do without

    try:
        if ":" in text:
            low, high, step = (float(part) for part in text.split(":"))
            count = int((high - low) / step + 1e-9) + 1
            if not (0 < low <= high and step > 0 and count <= MAX_FREQUENCIES):
                raise ValueError
            return np.asarray(low + step * np.arange(count))
        values = np.array([float(part) for part in text.split(",")])
    except (ValueError, OverflowError, ZeroDivisionError):
        raise InputError(
            f"--frequencies must be LO:HI:STEP in Hz with LO above zero and at most HI, such as "
            f"60:320:10, and at most {MAX_FREQUENCIES} frequencies, got {text!r}"
        ) from None
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < len(values):
        raise InputError(
            f"--frequencies must be distinct, got {distinct[counts.argmax()]:g} Hz twice in "
            f"{text[:40]!r}"
        )
    return values
