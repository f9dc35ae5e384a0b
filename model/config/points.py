"""Positions and frequency ranges as a user types them."""

import math
import re

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError

# More than this many frequencies is a typing error, not a table.
MOST_FREQUENCIES = 2000


def parse_point(text: str, *, what: str) -> tuple[float, float]:
    """Position [m] from `X,Y`; what names the option in the error."""
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        raise InputError(
            f"{what} {text!r} is not X,Y, two plain numbers in metres without a unit, for instance "
            f"{what} 0.10,0.08"
        ) from None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"{what} {text!r}: both coordinates must be finite numbers")
    return x, y


def in_metres(x: float, y: float, *, length: float, width: float) -> str:
    """What to give for a place off a plate of these sides [m] that smaller units put on it; or "".

    From 1 on: what is less is beside a plate, not in another unit.
    """
    for unit, count in (("cm", 100), ("mm", 1000)):
        sides = ((x, length), (y, width))
        if all(at == 0 or 1 <= at <= count * side for at, side in sides):
            return (
                f"; places are in metres: for {x:g} {unit}, {y:g} {unit} give "
                f"{x / count:g},{y / count:g}"
            )
    return ""


def parse_pair(text: str, *, what: str) -> tuple[int, int]:
    """Two counts from `12x9`."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[x×]\s*(\d{1,6})\s*", text)
    if match is None:
        raise InputError(f"{what} {text!r} is not two numbers such as 12x9")
    return int(match[1]), int(match[2])


def parse_frequencies(text: str) -> FloatArray:
    """Frequencies (f,) [Hz] from `LO:HI:STEP`, both ends included, or from a list `60,110,250`.

    Raises InputError for what is neither, and for one that is given twice.
    """
    try:
        if ":" in text:
            low, high, step = (float(part) for part in text.split(":"))
            count = int((high - low) / step + 1e-9) + 1
            if not (0 < low <= high and step > 0 and count <= MOST_FREQUENCIES):
                raise ValueError
            return np.asarray(low + step * np.arange(count))
        values = np.array([float(part) for part in text.split(",")])
    except (ValueError, OverflowError, ZeroDivisionError):
        raise InputError(
            f"--frequencies {text!r} is not LO:HI:STEP in Hz with LO above zero, for instance "
            f"60:320:10, at most {MOST_FREQUENCIES} of them"
        ) from None
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < len(values):
        raise InputError(
            f"--frequencies {text[:40]!r} has {distinct[counts.argmax()]:g} Hz more than once; "
            "each would count anew, so give it once"
        )
    return values
