"""Responses of a rig's plate for many values of its parameters, in milliseconds each.

The free plate is reduced once. The modulus only scales its natural frequencies; ERAs are a
correction of low rank to its receptance (Woodbury identity).
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.fem.assembly import era_positions
from model.fem.harmonic import check_frequencies
from model.reduction.low_rank import coupled_forces, on_diagonal
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.dynamic_stiffness import attached_stiffness, base_stiffness
from model.structure.point_load import load_positions


@dataclass(frozen=True, eq=False)
class FastPlate:
    """The reduced plate of a rig at its ERAs and loads (h, r) and at points (p, r).

    eigenvalues: omega² of the modes (r,) [rad²/s²] at the rig's own modulus; omega (f,) [rad/s].
    """

    modulus: float
    eigenvalues: FloatArray
    held: FloatArray
    shapes: FloatArray
    omega: FloatArray

    def responses(self, rig: Rig) -> ComplexArray:
        """Acceleration per base displacement [1/s²] of each ERA without its gain, (f, e, p).

        rig: the same geometry with other values.
        """
        plate = rig.plate
        elastic = (
            (1 + 1j * plate.loss_factor) * (plate.material.E / self.modulus) * self.eigenvalues
        )
        modal_receptance = 1 / (elastic - (self.omega**2)[:, None])
        forward = modal_receptance[:, :, None] * self.held.T
        stiffness = attached_stiffness(rig.eras, rig.loads, self.omega)
        applied = on_diagonal(base_stiffness(rig.eras, self.omega), rows=stiffness.shape[1])
        forces = coupled_forces(self.held @ forward, stiffness, applied)
        moved = self.shapes @ forward @ forces
        return np.asarray(-(self.omega**2)[:, None, None] * moved.transpose(0, 2, 1))


def fast_plate(rig: Rig, points: FloatArray, frequencies: FloatArray) -> FastPlate:
    """Solve a rig's free plate once, for points (p, 2) [m] and frequencies (f,) [Hz].

    Raises InputError for frequencies too high for its mesh.
    """
    check_frequencies(rig.plate, rig.mesh, frequencies)
    attached = np.vstack([era_positions(rig.eras), load_positions(rig.loads)])
    reduced = reduce_plate(
        rig.plate, rig.mesh, attached, frequency_max=float(max(frequencies.max(), 200.0))
    )
    return FastPlate(
        rig.plate.material.E,
        reduced.omega**2,
        reduced.at(attached),
        reduced.at(points),
        2 * np.pi * frequencies,
    )
