"""Layouts of ERAs by name.

The drawings of the paper's layouts (its Figures 8 and 9) are not available, so these are our own.
Places are fractions of the plate's length and width, so that a layout fits every plate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from model.arrays import FloatArray, best_of
from model.errors import InputError
from model.structure.actuators import OneKind
from model.structure.attachments import Source
from model.structure.plate import Plate

Place = tuple[float, float]
"""Place of an ERA as fractions of the length and the width, 0 to 1."""


@dataclass(frozen=True)
class EraLayout:
    """Places of the ERAs of a rig."""

    name: str
    places: tuple[Place, ...]

    def positions(self, plate: Plate) -> FloatArray:
        """Positions on a plate [m], (eras, 2)."""
        return np.array(self.places) * [plate.length, plate.width]


FOUR_ERA_LAYOUTS = (
    EraLayout("corners", ((0, 0), (1, 0), (1, 1), (0, 1))),
    EraLayout("mid-edges", ((1 / 2, 0), (1, 1 / 2), (1 / 2, 1), (0, 1 / 2))),
    EraLayout("long edges", ((1 / 4, 0), (3 / 4, 0), (3 / 4, 1), (1 / 4, 1))),
    EraLayout("short edges", ((0, 1 / 4), (1, 1 / 4), (1, 3 / 4), (0, 3 / 4))),
    EraLayout("inset corners", ((1 / 6, 1 / 6), (5 / 6, 1 / 6), (5 / 6, 5 / 6), (1 / 6, 5 / 6))),
    EraLayout("trapezoid", ((0, 0), (1, 0), (3 / 4, 1), (1 / 4, 1))),
    EraLayout("diagonal", ((0, 0), (1 / 3, 1 / 3), (2 / 3, 2 / 3), (1, 1))),
)
"""Layouts of four ERAs; the first is that of the paper's Table 2."""

_OTHERS = (
    EraLayout("centre", ((1 / 2, 1 / 2),)),
    EraLayout("opposite corners", ((0, 0), (1, 1))),
    EraLayout("mid-short-edges", ((0, 1 / 2), (1, 1 / 2))),
    EraLayout("triangle", ((0, 0), (1, 0), (1 / 2, 1))),
    EraLayout("corners and centre", ((0, 0), (1, 0), (1, 1), (0, 1), (1 / 2, 1 / 2))),
    EraLayout(
        "corners and mid-long-edges", ((0, 0), (1 / 2, 0), (1, 0), (1, 1), (1 / 2, 1), (0, 1))
    ),
)


def named_layouts(era_count: int) -> tuple[EraLayout, ...]:
    """The named layouts with a number of ERAs."""
    layouts = (*FOUR_ERA_LAYOUTS, *_OTHERS)
    return tuple(layout for layout in layouts if len(layout.places) == era_count)


def alike(era: OneKind, positions: FloatArray) -> tuple[OneKind, ...]:
    """Copies of an ERA at positions [m] (n, 2), named E1, E2, ..."""
    return tuple(
        replace(era, name=f"E{number}", x=float(x), y=float(y))
        for number, (x, y) in enumerate(positions, start=1)
    )


def edge_pair(eras: Sequence[Source]) -> tuple[int, int]:
    """Two ERAs side by side along the plate's x axis: most alike in y, then furthest apart in x."""

    def order(pair: tuple[int, int]) -> tuple[float, float]:
        across, along = abs(_apart(eras, pair))[::-1]
        return _rounded(across), -_rounded(along)

    return min(_pairs(eras), key=order)


def diagonal_pair(eras: Sequence[Source]) -> tuple[int, int]:
    """The two ERAs that are furthest apart; the first of several such pairs."""
    pairs = _pairs(eras)
    return pairs[best_of([np.hypot(*_apart(eras, pair)) for pair in pairs])]


def _pairs(eras: Sequence[Source]) -> list[tuple[int, int]]:
    if len(eras) < 2:
        raise InputError(f"ERAs of the rig must be at least two to drive a pair, got {len(eras)}")
    return list(combinations(range(len(eras)), 2))


def _apart(eras: Sequence[Source], pair: tuple[int, int]) -> FloatArray:
    first, second = (eras[index] for index in pair)
    return np.array([second.x - first.x, second.y - first.y])


def _rounded(distance: float) -> float:
    """A distance [m] without the rounding errors that would decide between equal pairs."""
    return round(float(distance), 9)
