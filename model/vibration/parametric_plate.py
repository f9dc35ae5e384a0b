"""Responses of a rig's plate for many values of its parameters, in milliseconds each.

The free plate is reduced once. The modulus only scales its natural frequencies; ERAs are a
correction of low rank to its receptance (Woodbury identity).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.fem.plate_mesh import check_frequencies
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.dynamic_stiffness import attached_stiffness, dynamic_stiffness
from model.structure.low_rank import coupled_forces, on_diagonal
from model.structure.point_load import PointLoad, footprints_of


@dataclass(frozen=True, eq=False)
class ParametricPlate:
    """The reduced plate of a rig at its ERAs and loads (h, r) and at points (p, r).

    eigenvalues: omega² of the modes (r,) [rad²/s²] at the rig's own modulus; omega (f,) [rad/s].
    """

    modulus: float
    eigenvalues: FloatArray
    attachment_shapes: FloatArray
    shapes: FloatArray
    omega: FloatArray

    def at(self, kept: NDArray[np.bool_]) -> "ParametricPlate":
        """Select some of the points (p,)."""
        return replace(self, shapes=self.shapes[kept])

    def responses(self, rig: Rig) -> ComplexArray:
        """Acceleration per base displacement [1/s²] of each ERA without its gain, (f, e, p).

        rig: the same geometry with other values.
        """
        eras = np.array([(era.stiffness, era.damping, era.bolt_mass) for era in rig.eras])
        return self.responses_of(rig.plate.material.E, rig.plate.loss_factor, eras, rig.masses)

    def responses_of(
        self,
        modulus: FloatArray | float,
        loss_factor: FloatArray | float,
        eras: FloatArray,
        loads: Sequence[PointLoad],
    ) -> ComplexArray:
        """Responses (..., f, e, p) for many values at once; see `responses`.

        modulus, loss_factor (...); eras (..., e, 3): stiffness, damping and bolt mass.
        """
        elastic = np.asarray((1 + 1j * np.asarray(loss_factor)) * modulus / self.modulus)
        modal_receptance = 1 / (
            elastic[..., None, None] * self.eigenvalues - (self.omega**2)[:, None]
        )
        forward = self.attachment_shapes.T
        k, c, m = (eras[..., None, :, number] for number in range(3))
        omega = self.omega[:, None]
        stiffness = dynamic_stiffness(k, c, m, omega)
        rest = attached_stiffness((), loads, self.omega)
        rest = np.broadcast_to(rest, (*stiffness.shape[:-1], rest.shape[-1]))
        stiffness = np.concatenate([stiffness, rest], axis=-1)
        applied = on_diagonal(dynamic_stiffness(k, c, 0.0, omega), rows=stiffness.shape[-1])

        def receptance(shapes: FloatArray) -> ComplexArray:
            """Of points (n, r) for forces at the attachments, (..., f, n, h)."""
            products = (shapes.T[:, :, None] * forward[:, None]).reshape(len(forward), -1)
            found = modal_receptance @ products
            return np.asarray(found.reshape(*found.shape[:-1], len(shapes), -1))

        forces = coupled_forces(receptance(self.attachment_shapes), stiffness, applied)
        moved = receptance(self.shapes) @ forces
        return np.asarray(-(self.omega**2)[:, None, None] * np.swapaxes(moved, -1, -2))


def parametric_plate(rig: Rig, points: FloatArray, frequencies: FloatArray) -> ParametricPlate:
    """Solve a rig's free plate once, for points (p, 2) [m] and frequencies (f,) [Hz].

    Raises InputError for frequencies too high for its mesh.
    """
    check_frequencies(rig.plate, rig.mesh, frequencies)
    attached = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(
        rig.plate, rig.mesh, attached, frequency_max=float(max(frequencies.max(), 200.0))
    )
    return ParametricPlate(
        rig.plate.material.E,
        reduced.omega**2,
        reduced.at(attached),
        reduced.at(points),
        2 * np.pi * frequencies,
    )
