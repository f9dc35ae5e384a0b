"""The reduced plate at its drive frequencies, with what is fixed to it and what may be wrong.

Free plate in reduced coordinates: A(x, y) = phi_x diag(g) phi_y^T with g = 1 / (s lambda - w²),
s lambda = (1 + i eta) lambda + i loss. A plate thicker by a factor has modal masses larger by it
and frequencies higher by it (as in `model.reduction.receptance`): of one h times as thick

    g = 1 / (h (h² s lambda - w²)),    dg / d ln loss = -i h³ Im(s lambda) g².
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import (
    Era,
    Fingertip,
    PointLoad,
    attached_stiffness,
    drive_forces,
)
from model.structure.modal_elasticity import (
    Dispersion,
    ModalElasticity,
    check_scales,
    modal_receptance,
)
from model.structure.plate import Plate

LEAST_THICKNESS = 0.1
"""Of plates that deviate, relative to the modelled one."""


@dataclass(frozen=True, eq=False)
class Mounts:
    """b fixed attachments of a plate, n ERAs first and then masses, at frequencies (f,).

    - minus_omega2: (f,) [rad²/s²]
    - stiffness: (f, b) dynamic stiffness of the attachments [N/m]
    - forces: (f, n) of each ERA at full stroke [N]; strokes: (f, n) of its base [m]
    - by_stiffness: (f, n), by_damping: (f, n) change of the ERAs' dynamic stiffness by one standard
      deviation [N/m]
    """

    minus_omega2: Float32Array
    stiffness: Complex64Array
    forces: Complex64Array
    strokes: Complex64Array
    by_stiffness: Complex64Array
    by_damping: Complex64Array


def mounts_of(
    eras: Sequence[Era], masses: Sequence[PointLoad], w: FloatArray, uncertainty: Uncertainty
) -> Mounts:
    """ERAs and masses at w (f,) [rad/s], wherever they are."""
    k, c = (np.array([getattr(era, key) for era in eras]) for key in ("stiffness", "damping"))
    by_damping = math.log(uncertainty.damping) * 1j * w[:, None] * c
    by_stiffness = np.broadcast_to(uncertainty.stiffness * k, by_damping.shape)
    strokes = np.array([era.base(w) for era in eras]).T
    each = attached_stiffness(w, eras, masses), drive_forces(w, eras), strokes
    single = (part.astype(np.complex64) for part in (*each, by_stiffness, by_damping))
    return Mounts(-(w**2).astype(np.float32), *single)


@dataclass(frozen=True, eq=False)
class AttachedPlate(Mounts):
    """The plate with its attachments.

    What answers read is in single precision: accelerations are within 1e-5 of their largest.

    - modal: (f, r) s lambda of the coordinates [rad²/s²], with all that they lose
    - shapes: (b, r) of the attachments
    - omega: (f,) [rad/s]
    - fingertip: of the rig, None for weightless ones
    - uncertainty: of the rig's parameters
    """

    modal: ComplexArray
    shapes: Float32Array
    omega: FloatArray
    fingertip: Fingertip | None
    uncertainty: Uncertainty

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.forces.shape[1])

    def of_thicknesses(
        self, deviations: FloatArray, row: int
    ) -> tuple[Complex64Array, Complex64Array]:
        """g of plates of known thicknesses at a frequency by its row, (d, r) [s²/kg].

        And its change by one standard deviation of the loss factor. deviations (d,): in standard
        deviations.
        """
        factor = np.maximum(1 + self.uncertainty.thickness * deviations, LEAST_THICKNESS)
        receptance = modal_receptance(self.modal[[row]], self.omega[[row]], factor)[:, 0]
        lost = -1j * math.log(self.uncertainty.damping) * self.modal[row].imag
        by_loss = lost * factor[:, None] ** 3 * receptance**2
        return receptance.astype(np.complex64), by_loss.astype(np.complex64)

    def finger_stiffness(self, count: int, loads: Sequence[float] = ()) -> Complex64Array:
        """Dynamic stiffness of a number of fingers [N/m], (f, count), of 0 for weightless ones.

        loads (count,): of each relative to the rig's fingertip, empty for 1.
        """
        found = np.repeat(self._finger[:, None], count, axis=1)
        if self.fingertip is not None:
            for number, load in enumerate(loads):
                if load != 1:
                    found[:, number] = self.fingertip.scaled(load).dynamic_stiffness(self.omega)
        return found.astype(np.complex64)

    @cached_property
    def _finger(self) -> ComplexArray:
        if self.fingertip is None:
            return np.zeros(len(self.omega), dtype=complex)
        return self.fingertip.dynamic_stiffness(self.omega)


def attach(
    plate: Plate,
    omega: FloatArray,
    losses: FloatArray,
    shapes: FloatArray,
    *,
    eras: Sequence[Era],
    masses: Sequence[PointLoad],
    fingertip: Fingertip | None,
    uncertainty: Uncertainty,
    frequencies: FloatArray,
    dispersion: Dispersion | None = None,
) -> AttachedPlate:
    """Attach ERAs and masses to a reduced free plate.

    omega (r,) [rad/s], losses (r,) [rad²/s²]: of its coordinates; shapes (eras + masses, r);
    frequencies (f,) [Hz]; dispersion: how omega² changes with them. Raises InputError for a plate
    that is not known by one thickness, and does not scale with it.
    """
    check_scales(plate, 1 + uncertainty.thickness)
    w = 2 * np.pi * frequencies
    elasticity = ModalElasticity.of(plate, omega**2, losses, dispersion)
    return AttachedPlate(
        **vars(mounts_of(eras, masses, w, uncertainty)),
        modal=elasticity.stiffness(w),
        shapes=shapes.astype(np.float32),
        omega=w,
        fingertip=fingertip,
        uncertainty=uncertainty,
    )
