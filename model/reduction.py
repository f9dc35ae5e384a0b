"""The plate in a few dozen coordinates: modes of the free plate and static corrections.

ERAs touch the plate at a few points only, so the free plate is solved once and everything that
holds or drives it is added afterwards in the small coordinates. Bare modes converge slowly near a
point force; the static deflection under a unit force at each attachment, with the part that the
modes already carry taken out, brings the error from percents to a few 1e-4 of the response (the
test against the direct solve says how few).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.assembly import assemble
from model.mesh import Mesh
from model.modal import RIGID_BODY_MODES, shift_invert_modes
from model.plate import Plate

# Modes are kept up to this multiple of the highest frequency asked for.
FREQUENCY_MARGIN = 4.0


@dataclass(frozen=True)
class ReducedPlate:
    """The free plate in coordinates where its mass is the identity and its stiffness is diagonal.

    omega: (r,) [rad/s], ascending, the first three 0 (rigid body), the last ones pseudo-modes that
    carry the static corrections; shapes: (node_count, r) deflection at the nodes [1/sqrt(kg)].
    """

    plate: Plate
    mesh: Mesh
    omega: FloatArray
    shapes: FloatArray

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points [m] (p, 2) of the plate, (p, r)."""
        return np.asarray(self.mesh.interpolation(points) @ self.shapes)


def reduce_plate(
    plate: Plate, mesh: Mesh, attachments: FloatArray, *, frequency_max: float = 500.0
) -> ReducedPlate:
    """Solve the free plate once, for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: up to where the response shall hold; modes well above it are kept.
    """
    matrices = assemble(plate, mesh)
    stiffness, mass = matrices.stiffness, matrices.mass
    squared, vectors, factor = shift_invert_modes(
        stiffness,
        mass,
        min(_mode_count(plate, frequency_max), matrices.dof - 1),
        shift=(2 * np.pi * plate.lowest_bending_frequency) ** 2,
    )
    squared[:RIGID_BODY_MODES] = 0.0

    # A free plate has no static answer, but the shifted one serves as well: what the modes already
    # carry is taken out anyway.
    forces = matrices.deflection_at(attachments).toarray()
    corrections = factor.solve(np.ascontiguousarray(forces.T))
    for _ in range(2):  # once leaves rounding behind, twice is enough (Kahan)
        corrections -= vectors @ (vectors.T @ (mass @ corrections))

    small_mass = corrections.T @ (mass @ corrections)
    small_stiffness = corrections.T @ (stiffness @ corrections)
    extra_squared, mix = linalg.eigh(small_stiffness, small_mass)
    shapes = np.hstack([vectors[0::3], (corrections @ mix)[0::3]])
    return ReducedPlate(plate, mesh, np.sqrt(np.concatenate([squared, extra_squared])), shapes)


def _mode_count(plate: Plate, frequency_max: float) -> int:
    """How many modes a free plate has up to FREQUENCY_MARGIN times a frequency [Hz], about.

    Area term of the mode count of a thin plate, pi S / wavelength², and by half more for its edges.
    """
    wavelength = plate.bending_wavelength(FREQUENCY_MARGIN * frequency_max)
    area_term = math.pi * plate.length * plate.width / wavelength**2
    return math.ceil(1.5 * area_term) + RIGID_BODY_MODES
