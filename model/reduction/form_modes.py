"""Coordinates in which a plate can have form errors, which a rig file does not describe.

Errors of length, width and Poisson's ratio change the stiffness between the coordinates,

    K = diag(omega²) + sum_e e D_e,    D_e = q' (dK / de) q,

with q the coordinates in the unknowns of the mesh; foreign mass on a cell c adds m phi_c phi_c' to
M. An estimate fits the errors to measured responses (`model.estimate.forward`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.fem import Mesh, element_slopes
from model.reduction.free_plate import TERMS, FreePlate
from model.reduction.reduced_plate import reduce_free_plate
from model.spectral.direct_solution import stiffness_slopes
from model.structure.modal_elasticity import Dispersion, check_is_plate


@dataclass(frozen=True, eq=False)
class ReducedModes:
    """Modes and residual vectors at all attachments of a plate that can have form errors.

    No further modes count as truncated.
    """

    eigenvalues: FloatArray
    """omega² (r,) [rad²/s²]."""
    losses: FloatArray
    """Their imaginary part in addition to the plate's loss factor (r,)."""
    dispersion: Dispersion | None
    """Their change with frequency, None without any."""
    shapes_at: Callable[[FloatArray], FloatArray]
    """Shapes at points or footprints [m], (n, r)."""
    cells: FloatArray
    """Shapes at the cells on which foreign mass can lie (c, r)."""
    stiffening: FloatArray
    """D_e (3, r, r) [rad²/s²], for relative errors of length and width, and for Poisson's ratio."""

    def truncated_terms(self, points: FloatArray, receivers: FloatArray) -> FloatArray:
        """Sums over truncated modes: zero, (TERMS, n, m)."""
        return np.zeros((TERMS, len(points), len(receivers)))


def reduced_modes(free: FreePlate, footprints: FloatArray, cells: FloatArray) -> ReducedModes:
    """Reduce a free plate to coordinates in which it may have form errors.

    footprints (n, 3) [m]: of its supports; cells (c, 2) [m]: on which foreign mass can lie.
    """
    plate = free.plate
    check_is_plate(plate, "form errors")
    reduced = reduce_free_plate(free, footprints)
    assert reduced.origin is not None  # noqa: S101  it was reduced from the free plate
    unknowns = reduced.origin.unknowns()
    if isinstance(free.mesh, Mesh):
        stiffening = element_slopes(plate, free.mesh, unknowns[0])
    else:
        degrees = free.mesh.nx, free.mesh.ny
        frequency = math.sqrt(plate.lowest_bending_frequency * free.frequency_max)
        stiffening = stiffness_slopes(plate, degrees, unknowns, frequency=frequency)
    return ReducedModes(
        eigenvalues=np.asarray(reduced.omega**2),
        losses=reduced.losses,
        dispersion=reduced.dispersion,
        shapes_at=reduced.at,
        cells=reduced.at(cells),
        stiffening=stiffening,
    )
