"""Values of the keys of a rig file: names, places, rows of numbers, with their bounds."""

import math
import re
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, Strict

from model.config.fields import FREQUENCY, LENGTH, Quantity
from model.finger import THRESHOLDS
from model.structure.attachments import Gain
from model.structure.plate import Plate
from registry.plugins import did_you_mean


def _identifier(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,31}", text):
        raise ValueError("must be a letter followed by at most 31 letters, digits, - and _")
    return text


def check_url(text: str) -> str:
    """The URL of an amplifier; raises ValueError for other text."""
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[!-~]{0,250}", text):
        raise ValueError(
            "must be a URL, for example sim:// or serial:///dev/ttyUSB0?baud=921600, got "
            f"{text[:40]!r}"
        )
    return text


def check_ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    """The lower and the higher frequency [Hz]; raises ValueError for others."""
    low, high = bounds
    if low >= high:
        raise ValueError(f"must be the lower and the higher frequency, got {low:g} and {high:g} Hz")
    return bounds


def _rows(
    columns: str, lowest: Sequence[float], highest: Sequence[float], *, ascending: bool = True
) -> AfterValidator:
    """Check of rows of numbers between bounds, by default sorted by the first of them."""

    def checked(rows: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        for row in rows:
            if not all(
                low <= each <= high for low, each, high in zip(lowest, row, highest, strict=True)
            ):
                got = ", ".join(f"{each:g}" for each in row)
                raise ValueError(f"must be rows of [{columns}], got [{got}]")
        if ascending and any(low[0] >= high[0] for low, high in pairwise(rows)):
            raise ValueError("frequencies must ascend; sort the rows by the first number")
        return rows

    return AfterValidator(checked)


def one_of(known: Collection[str], what: str, remedy: str = "") -> AfterValidator:
    """Check of text that is one of the known names of something."""

    def checked(name: str) -> str:
        if name not in known:
            raise ValueError(
                f"unknown {what} {name}; {did_you_mean(name, known)}known are {', '.join(known)}"
                f"{remedy}"
            )
        return name

    return AfterValidator(checked)


GAINS = _rows(
    "frequency in Hz, magnitude 0.001 to 1000, phase -360 to 360 degrees",
    (1e-6, 1e-3, -360),
    (1e5, 1e3, 360),
)
MODULI = _rows(
    "frequency in Hz, factor of E 0.001 to 1000, loss factor 0 to 2", (1e-6, 1e-3, 0), (1e5, 1e3, 2)
)
MODES = _rows(
    "natural frequency 0.8 to 1.25, loss factor 0.01 to 100, relative to the plate's theory",
    (0.8, 0.01),
    (1.25, 100),
    ascending=False,
)
GainRow = Annotated[tuple[float, float, float], Strict(strict=False)]  # a list in the file
ModeRow = Annotated[tuple[float, float], Strict(strict=False)]
ThresholdSet = Annotated[str, one_of(THRESHOLDS, "set of thresholds")]
Identifier = Annotated[str, AfterValidator(_identifier)]
Side = Annotated[float, Quantity(LENGTH, above=0, at_most=100)]
Coordinate = Annotated[float, Quantity(LENGTH, at_least=-100, at_most=100)]
Place = Annotated[tuple[Coordinate, Coordinate], Strict(strict=False)]  # a list in the file
Foot = Annotated[float, Quantity(LENGTH, at_least=0, at_most=0.2)]
Thickness = Annotated[float, Quantity(LENGTH, at_least=1e-6, at_most=1)]
Frequency = Annotated[float, Quantity(FREQUENCY, at_least=1, at_most=2000)]


def place_on(plate: Plate, place: tuple[float, float]) -> tuple[float, float]:
    """A place clipped to the plate, off whose edge rounding may have put it."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)


def gains_of(rows: Sequence[GainRow] | None) -> tuple[Gain, ...]:
    """Gains of rows with phases in degrees."""
    return tuple((f, size, math.radians(phase)) for f, size, phase in rows or ())
