"""What makes a plate not quite the one of its rig, in a few dozen coordinates.

A rig file has no words for a cable glued to the plate, or sides that are not cut to size. Left out,
such form errors bias what is fitted by far more than noise does, and no residual shows by how much.
They change the stiffness and the mass between the modes of the free plate, and so their shapes.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.fem import Mesh, element_slopes
from model.finger import Grid
from model.reduction.free_plate import TERMS, FreePlate
from model.reduction.reduced_plate import ReducedPlate, reduce_free_plate
from model.rig.rig import Rig
from model.spectral.shape_stiffness import stiffness_slopes
from model.structure.attachments import footprints_of
from model.structure.modal_elasticity import Dispersion

MASS_CELLS = Grid(8, 6)


@dataclass(frozen=True, eq=False)
class ReducedModes:
    """A plate's modes and residual vectors at all that is attached, as if no others were truncated.

    cells (c, r): shapes where foreign mass may lie; stiffening (3, r, r): derivatives of the
    stiffness between them by length and width (relative), and by Poisson's ratio [rad²/s²].
    """

    plate: ReducedPlate
    cells: FloatArray
    stiffening: FloatArray

    @property
    def eigenvalues(self) -> FloatArray:
        """omega² (r,) [rad²/s²]."""
        return np.asarray(self.plate.omega**2)

    @property
    def losses(self) -> FloatArray:
        """Their imaginary part beside the plate's own loss factor (r,)."""
        return self.plate.losses

    @property
    def dispersion(self) -> Dispersion | None:
        """How they change with frequency, None where they do not."""
        return self.plate.dispersion

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Shapes at points or footprints [m], (n, r)."""
        return self.plate.at(points)

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums over truncated modes: zero, (TERMS, n, m)."""
        return np.zeros((TERMS, len(points), len(others)))


def reduced_modes(rig: Rig, free: FreePlate) -> ReducedModes:
    """Reduce a rig's free plate to coordinates in which it may have form errors."""
    plate = rig.plate
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses))
    cells = MASS_CELLS.centres(plate)
    unknowns = reduced.unknowns()
    if isinstance(free.mesh, Mesh):
        stiffening = element_slopes(plate, free.mesh, unknowns[0])
    else:
        degrees = free.mesh.nx, free.mesh.ny
        frequency = math.sqrt(plate.lowest_bending_frequency * free.frequency_max)
        stiffening = stiffness_slopes(plate, degrees, unknowns, frequency=frequency)
    return ReducedModes(reduced, reduced.at(cells), stiffening)
