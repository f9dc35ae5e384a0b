"""The reduced plate with its shapes on a raster instead of a mesh."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.structure.plate import Plate
from model.table.raster import Raster


@dataclass(frozen=True, eq=False)
class ReducedOnRaster:
    """As `ReducedPlate` of `model.reduction`; omega (r,) [rad/s]; shapes (points, r) on raster."""

    plate: Plate
    omega: FloatArray
    raster: Raster
    shapes: NDArray[np.float32]

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points [m] (p, 2) of the plate, (p, r)."""
        return self.raster.at(self.shapes, points).astype(float)
