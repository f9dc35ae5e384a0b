"""The reduced plate at its drive frequencies, with what is fixed to it and what may be wrong.

Free plate in reduced coordinates: A(x, y) = phi_x diag(g) phi_y^T with g = 1 / (s lambda - w²),
s lambda = (1 + i eta) lambda + i loss. A plate thicker by a factor has modal masses larger by it
and frequencies higher by it (as in `model.reduction.receptance`), so that of one h times
as thick

    g = 1 / (h (h² s lambda - w²)),    dg / d ln loss = -i h³ Im(s lambda) g².
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import (
    Era,
    Fingertip,
    PointLoad,
    attached_stiffness,
    drive_forces,
    full_strokes,
)
from model.structure.modal_elasticity import Dispersion, ModalElasticity, modal_receptance
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
    each = attached_stiffness(eras, masses, w), drive_forces(eras, w), full_strokes(eras, w)
    single = (part.astype(np.complex64) for part in (*each, by_stiffness, by_damping))
    return Mounts(-(w**2).astype(np.float32), *single)


@dataclass(frozen=True, eq=False)
class AttachedPlate(Mounts):
    """The plate with its attachments.

    All in single precision: accelerations are within 1e-5 of their largest.

    - receptance: (f, r) g; by_loss: (f, r) its change by one standard deviation of the loss factor
    - shapes: (b, r) of the attachments
    - fingertip: of the rig, None for weightless ones; finger: (f,) its dynamic stiffness [N/m];
      omega: (f,) [rad/s]; load_std: standard deviation of the logarithm of its load
    - gain, phase: standard deviations of an ERA's amplitude and of its phase [rad]; gain_variance:
      mean square of both together; common_gain: standard deviation of that of all ERAs
    - thickness: its standard deviation, relative
    """

    receptance: Complex64Array
    by_loss: Complex64Array
    shapes: Float32Array
    omega: FloatArray
    finger: ComplexArray
    fingertip: Fingertip | None
    load_std: float
    gain: float
    phase: float
    gain_variance: float
    common_gain: float
    thickness: float

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.forces.shape[1])

    def of_thicknesses(self, deviations: FloatArray, frequency: int) -> "AttachedPlate":
        """Plates of known thicknesses at a frequency by index, in place of several frequencies.

        deviations (d,): in standard deviations.
        """
        each = {name: getattr(self, name)[[frequency] * len(deviations)] for name in _BY_FREQUENCY}
        g, w2 = each["receptance"], -each["minus_omega2"].astype(float)[:, None]
        factor = np.maximum(1 + self.thickness * deviations, LEAST_THICKNESS)
        stiffness = (1 / g.astype(complex) + w2)[:, None]
        at = self.omega[[frequency]]
        receptance = modal_receptance(stiffness, at, factor)[:, 0].astype(np.complex64)
        by_loss = (
            each["by_loss"] * (factor[:, None] ** 3).astype(np.float32) * (receptance / g) ** 2
        )
        each |= {"receptance": receptance, "by_loss": by_loss}
        return replace(self, **each, thickness=0.0)

    def finger_stiffness(self, count: int, loads: Sequence[float] = ()) -> Complex64Array:
        """Dynamic stiffness of a number of fingers [N/m], (f, count).

        loads (count,): of each relative to the rig's fingertip, empty for 1.
        """
        found = np.repeat(self.finger[:, None], count, axis=1)
        if self.fingertip is not None:
            for number, load in enumerate(loads):
                if load != 1:
                    found[:, number] = self.fingertip.scaled(load).dynamic_stiffness(self.omega)
        return found.astype(np.complex64)


_BY_FREQUENCY = (
    "minus_omega2",
    "receptance",
    "by_loss",
    "stiffness",
    "forces",
    "strokes",
    "by_stiffness",
    "by_damping",
    "finger",
    "omega",
)


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
    frequencies (f,) [Hz]; dispersion: how omega² changes with them.
    """
    w = 2 * np.pi * frequencies
    elasticity = ModalElasticity.of(plate, omega**2, losses, dispersion)
    stiffness = elasticity.stiffness(w)
    g = modal_receptance(stiffness, w)
    by_loss = -1j * stiffness.imag * g**2
    return AttachedPlate(
        **vars(mounts_of(eras, masses, w, uncertainty)),
        receptance=g.astype(np.complex64),
        by_loss=(math.log(uncertainty.damping) * by_loss).astype(np.complex64),
        shapes=shapes.astype(np.float32),
        finger=fingertip.dynamic_stiffness(w) if fingertip else np.zeros(len(w), dtype=complex),
        omega=w,
        fingertip=fingertip,
        load_std=uncertainty.fingertip,
        gain=uncertainty.gain,
        phase=math.radians(uncertainty.phase_deg),
        gain_variance=uncertainty.gain_variance,
        common_gain=uncertainty.common_gain,
        thickness=uncertainty.thickness,
    )
