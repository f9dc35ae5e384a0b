"""Shapes of the reduced plate under fingertips, kept for fingers that do not move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Float32Array
from model.table.question import Point
from model.table.raster import Raster

MAX_KEPT = 512
"""Positions that are kept, of some 8 kB each."""


@dataclass(frozen=True, eq=False)
class FingertipShapes:
    """Shapes (k, p, r) under k fingertips and weights (k, p) of the points in the mean over each.

    At few points for searches and at fine ones for figures; the centre comes first.
    """

    few: Float32Array
    fine: Float32Array
    few_weights: Float32Array
    fine_weights: Float32Array


class FingertipReader:
    """Reads shapes (points, r) on a raster at fingertips."""

    def __init__(self, raster: Raster, shapes: Float32Array) -> None:
        self._raster, self._shapes = raster, shapes
        self._kept: dict[Point, tuple[Float32Array, ...]] = {}

    def __call__(self, places: Sequence[Point]) -> FingertipShapes:
        """Read at fingertips centred at places [m] of the plate; from any thread."""
        kept = self._kept
        missing = [place for place in places if place not in kept]
        if missing:
            if len(kept) > MAX_KEPT:
                kept = self._kept = {}  # another thread may still read the one before
                missing = list(places)
            tips = self._raster.fingertips(np.array(missing))
            read = (*tips.read(self._shapes), tips.few_weights, tips.fine_weights)
            kept.update(zip(missing, zip(*read, strict=True), strict=True))
        found = [kept[place] for place in places]
        return FingertipShapes(*(np.array(each) for each in zip(*found, strict=True)))
