"""Named layouts of ERAs on a plate.

The drawings of the paper's layouts (its Figures 8 and 9) are not available, so the layouts here are
our own. Their positions are fractions of the plate's length and width, so that they fit every
plate.
"""

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from model.arrays import FloatArray
from model.structure.exciter import OneKind
from model.structure.plate import Plate

RelativePlace = tuple[float, float]
"""Position of an ERA as fractions of length and width, 0 to 1."""


@dataclass(frozen=True)
class EraLayout:
    """Positions of a rig's ERAs."""

    name: str
    places: tuple[RelativePlace, ...]

    def positions(self, plate: Plate) -> FloatArray:
        """Positions on a plate [m], (eras, 2)."""
        return np.array(self.places) * [plate.length, plate.width]


def _layout(name: str, places: str) -> EraLayout:
    """Return a layout from the text of its positions, such as "0 0, 1 1/2"."""
    pairs = []
    for pair in places.split(","):
        x, y = pair.split()
        pairs.append((float(Fraction(x)), float(Fraction(y))))
    return EraLayout(name, tuple(pairs))


FOUR_ERA_LAYOUTS = (
    _layout("corners", "0 0, 1 0, 1 1, 0 1"),
    _layout("mid-edges", "1/2 0, 1 1/2, 1/2 1, 0 1/2"),
    _layout("long edges", "1/4 0, 3/4 0, 3/4 1, 1/4 1"),
    _layout("short edges", "0 1/4, 1 1/4, 1 3/4, 0 3/4"),
    _layout("inset corners", "1/6 1/6, 5/6 1/6, 5/6 5/6, 1/6 5/6"),
    _layout("trapezoid", "0 0, 1 0, 3/4 1, 1/4 1"),
    _layout("diagonal", "0 0, 1/3 1/3, 2/3 2/3, 1 1"),
)
"""Layouts of four ERAs; the first one is from the paper's Table 2."""

_FURTHER_LAYOUTS = (
    _layout("centre", "1/2 1/2"),
    _layout("opposite corners", "0 0, 1 1"),
    _layout("mid-short-edges", "0 1/2, 1 1/2"),
    _layout("triangle", "0 0, 1 0, 1/2 1"),
    _layout("corners and center", "0 0, 1 0, 1 1, 0 1, 1/2 1/2"),
    _layout("corners and mid-long-edges", "0 0, 1/2 0, 1 0, 1 1, 1/2 1, 0 1"),
)


def named_layouts(era_count: int) -> tuple[EraLayout, ...]:
    """Return the named layouts for a number of ERAs."""
    layouts = (*FOUR_ERA_LAYOUTS, *_FURTHER_LAYOUTS)
    return tuple(layout for layout in layouts if len(layout.places) == era_count)


def alike(era: OneKind, positions: FloatArray) -> tuple[OneKind, ...]:
    """Return copies of an ERA at positions [m] (n, 2), named E1, E2, ..."""
    return tuple(
        replace(era, name=f"E{number}", x=float(x), y=float(y))
        for number, (x, y) in enumerate(positions, start=1)
    )
