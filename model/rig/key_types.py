"""Types of values in a rig file that several sections share: names, quantities, rows, positions."""

import re
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, Strict

from model.config.fields import Quantity
from model.config.units import DAMPING, FREQUENCY, LENGTH, MASS, RATIO, STIFFNESS
from model.finger import THRESHOLDS
from model.structure.plate import Plate
from registry.plugins import did_you_mean


def _identifier(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,31}", text):
        raise ValueError("must be a letter followed by at most 31 letters, digits, - and _")
    return text


def check_url(text: str) -> str:
    """Return the URL of an amplifier; raises ValueError for other text."""
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[!-~]{0,250}", text):
        raise ValueError(
            "must be a URL, for example sim:// or serial:///dev/ttyUSB0?baud=921600, got "
            f"{text[:40]!r}"
        )
    return text


def check_ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    """Return the lower and the higher frequency [Hz]; raises ValueError if they do not ascend."""
    low, high = bounds
    if low >= high:
        raise ValueError(f"must be the lower and the higher frequency, got {low:g} and {high:g} Hz")
    return bounds


def _rows(
    columns: str, lowest: Sequence[float], highest: Sequence[float], *, ascending: bool = True
) -> AfterValidator:
    """Check rows of numbers for bounds, and by default for ascending first numbers."""

    def check(rows: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        for row in rows:
            for low, number, high in zip(lowest, row, highest, strict=True):
                if not low <= number <= high:
                    digits = ", ".join(f"{number:g}" for number in row)
                    raise ValueError(f"must be rows of [{columns}], got [{digits}]")
        if ascending:
            for row, next_row in pairwise(rows):
                if row[0] >= next_row[0]:
                    raise ValueError("frequencies must ascend; sort the rows by the first number")
        return rows

    return AfterValidator(check)


def name_among(names: Collection[str], what: str, remedy: str = "") -> AfterValidator:
    """Check that text is one of some names."""

    def check(name: str) -> str:
        if name not in names:
            raise ValueError(
                f"unknown {what} {name}; {did_you_mean(name, names)}known: {', '.join(names)}"
                f"{remedy}"
            )
        return name

    return AfterValidator(check)


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
Identifier = Annotated[str, AfterValidator(_identifier)]
ThresholdSet = Annotated[str, name_among(THRESHOLDS, "set of thresholds")]

# Tuples are lists in a file, so they are not strict.
GainRow = Annotated[tuple[float, float, float], Strict(strict=False)]
ModeRow = Annotated[tuple[float, float], Strict(strict=False)]
Coordinate = Annotated[float, Quantity(LENGTH, at_least=-100, at_most=100)]
Place = Annotated[tuple[Coordinate, Coordinate], Strict(strict=False)]

Side = Annotated[float, Quantity(LENGTH, above=0, at_most=100)]
Thickness = Annotated[float, Quantity(LENGTH, at_least=1e-6, at_most=1)]
Foot = Annotated[float, Quantity(LENGTH, at_least=0, at_most=0.2)]
Frequency = Annotated[float, Quantity(FREQUENCY, at_least=1, at_most=2000)]
Share = Annotated[float, Quantity(RATIO, at_least=0, at_most=1)]
LossRatio = Annotated[float, Quantity(RATIO, at_least=0, at_most=2)]
MountedLossFactor = Annotated[float, Quantity(RATIO, at_least=0, below=1)]
SpringStiffness = Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e12)]
SpringDamping = Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)]
AttachedMass = Annotated[float, Quantity(MASS, at_least=0, at_most=10)]
SmallMass = Annotated[float, Quantity(MASS, at_least=0, at_most=0.1)]


def place_on(plate: Plate, place: tuple[float, float]) -> tuple[float, float]:
    """Clip a position to the plate; rounding can have moved it across the edge."""
    x, y = place
    return min(max(x, 0.0), plate.length), min(max(y, 0.0), plate.width)
