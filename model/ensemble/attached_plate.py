"""The reduced plate at its drive frequencies, with what is fixed to it and what may be wrong.

Free plate in reduced coordinates: A(x, y) = phi_x diag(g) phi_y^T with g = 1 / (s lambda - w²),
s lambda = (1 + i eta) lambda + i loss. A plate thicker by a factor has modal masses larger by it
and frequencies higher by it (`model.vibration.parametric_plate`), so that of one h times as thick

    g = 1 / (h (h² s lambda - w²)),    dg / d ln loss = -i h³ Im(s lambda) g².
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray
from model.rig.uncertainty import Uncertainty
from model.structure.actuator import Era
from model.structure.dispersion import Dispersion
from model.structure.fingertip import Fingertip
from model.structure.modal_elasticity import ModalElasticity
from model.structure.plate import Plate
from model.structure.point_load import PointLoad, attached_stiffness, drive_forces, full_strokes

LEAST_THICKNESS = 0.1
"""Of plates that deviate, relative to the modelled one."""


@dataclass(frozen=True, eq=False)
class AttachedPlate:
    """The plate with b fixed attachments, n ERAs first and then masses, at frequencies (f,).

    All in single precision: accelerations are within 1e-5 of their largest.

    - minus_omega2: (f,) [rad²/s²]
    - receptance: (f, r) g; by_loss: (f, r) its change by one standard deviation of the loss factor;
      deviating: (f, 2, r) that of plates thicker and thinner by a standard deviation
    - shapes: (b, r) of the attachments; stiffness: (f, b) their dynamic stiffness [N/m]
    - forces: (f, n) of each ERA at full stroke [N]; strokes: (f, n) of its base [m]
    - by_stiffness: (f, n), by_damping: (f, n) change of the ERAs' dynamic stiffness by one standard
      deviation [N/m]
    - fingertip: of the rig, None for weightless ones; finger: (f,) its dynamic stiffness [N/m];
      omega: (f,) [rad/s]; load_std: standard deviation of the logarithm of its load
    - gain, phase: standard deviations of an ERA's amplitude and of its phase [rad]; gain_variance:
      mean square of both together
    - thickness: its standard deviation, relative
    """

    minus_omega2: Float32Array
    receptance: Complex64Array
    by_loss: Complex64Array
    deviating: Complex64Array
    shapes: Float32Array
    stiffness: Complex64Array
    forces: Complex64Array
    strokes: Complex64Array
    by_stiffness: Complex64Array
    by_damping: Complex64Array
    omega: FloatArray
    finger: ComplexArray
    fingertip: Fingertip | None
    load_std: float
    gain: float
    phase: float
    gain_variance: float
    thickness: float

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.forces.shape[1])

    @cached_property
    def modal_rows(self) -> Float32Array:
        """Real and imaginary part of the receptance side by side, (r, 2 f)."""
        return np.ascontiguousarray(self.receptance.T).view(np.float32)

    def at(self, frequencies: IntArray) -> "AttachedPlate":
        """The plate at some of its frequencies, by index (n,)."""
        return replace(
            self, **{name: getattr(self, name).take(frequencies, axis=0) for name in _BY_FREQUENCY}
        )

    def receptance_at(self, deviations: FloatArray, frequencies: IntArray) -> Complex64Array:
        """Receptance of plates of deviating thickness at frequencies, by index: (f, d, r).

        deviations (d,): in standard deviations.
        """
        w2 = -self.minus_omega2.take(frequencies).astype(float)
        stiffness = 1 / self.receptance.take(frequencies, axis=0).astype(complex) + w2[:, None]
        return _deviating(stiffness, w2, self.thickness * deviations)

    def of_thicknesses(self, deviations: FloatArray, frequencies: IntArray) -> "AttachedPlate":
        """Plates of known thicknesses, each deviation at each of the frequencies, by index.

        deviations (d,): in standard deviations. The result has (f d,) frequencies.
        """
        count = len(deviations)
        each = self.at(frequencies.repeat(count))
        receptance = self.receptance_at(deviations, frequencies).reshape(each.receptance.shape)
        factor = np.maximum(1 + self.thickness * deviations, LEAST_THICKNESS)
        stiffer = np.tile(factor**3, len(frequencies))[:, None].astype(np.float32)
        by_loss = each.by_loss * stiffer * (receptance / each.receptance) ** 2
        return replace(each, receptance=receptance, by_loss=by_loss, thickness=0.0)

    def with_fingers(self, count: int, loads: Sequence[float] = ()) -> "Attachments":
        """What is attached to the plate with a number of fingers on it.

        loads (count,): of each relative to the rig's fingertip, empty for 1.
        """
        if loads:
            return self._attach_fingers(np.column_stack([*map(self._finger, loads)]))
        if count not in self._by_count:
            finger = np.repeat(self.finger[:, None], count, axis=1)
            self._by_count[count] = self._attach_fingers(finger)
        return self._by_count[count]

    def _attach_fingers(self, fingers: ComplexArray) -> "Attachments":
        """Attach fingers of dynamic stiffness (f, k) [N/m]."""
        b, n, k = self.stiffness.shape[1], self.era_count, fingers.shape[1]
        changes = (self.load_std * fingers).astype(np.complex64)
        return Attachments(
            np.concatenate([self.stiffness, fingers.astype(np.complex64)], axis=1),
            np.concatenate([np.arange(n), np.arange(b, b + k)]),
            np.concatenate([self.by_stiffness, changes], axis=1),
        )

    def _finger(self, load: float) -> ComplexArray:
        """Dynamic stiffness of a finger of a load, (f,) [N/m]."""
        if self.fingertip is None or load == 1:
            return self.finger
        return self.fingertip.scaled(load).dynamic_stiffness(self.omega)

    @cached_property
    def _by_count(self) -> dict[int, "Attachments"]:
        return {}


def _deviating(stiffness: ComplexArray, w2: FloatArray, deviations: FloatArray) -> Complex64Array:
    """Receptance of plates thicker by deviations (d,), relative, (f, d, r).

    stiffness (f, r) [rad²/s²] of the modelled plate; w2 (f,) squared frequencies.
    """
    factor = np.maximum(1 + deviations, LEAST_THICKNESS)[:, None]
    found = 1 / (factor * (factor**2 * stiffness[:, None] - w2[:, None, None]))
    return np.asarray(found, dtype=np.complex64)


_BY_FREQUENCY = (
    "minus_omega2",
    "receptance",
    "by_loss",
    "deviating",
    "stiffness",
    "forces",
    "strokes",
    "by_stiffness",
    "by_damping",
    "finger",
    "omega",
)


@dataclass(frozen=True, eq=False)
class Attachments:
    """The fixed attachments of a plate and then k fingers on it, a = b + k.

    stiffness: (f, a) dynamic stiffness [N/m]; uncertain: (j,) which are, the ERAs and the fingers;
    changes: (f, j) of their stiffness by one standard deviation.
    """

    stiffness: Complex64Array
    uncertain: IntArray
    changes: Complex64Array


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
    w2 = (w**2)[:, None]
    elasticity = ModalElasticity.of(plate, omega**2, losses, dispersion)
    stiffness = elasticity.stiffness(w)
    g = 1 / (stiffness - w2)
    by_loss = -1j * stiffness.imag * g**2
    thickness = uncertainty.thickness
    k, c = (np.array([getattr(era, key) for era in eras]) for key in ("stiffness", "damping"))
    log_damping = math.log(uncertainty.damping)
    single = np.complex64
    return AttachedPlate(
        minus_omega2=-w2[:, 0].astype(np.float32),
        receptance=g.astype(single),
        by_loss=(log_damping * by_loss).astype(single),
        deviating=_deviating(stiffness, w2[:, 0], np.array([thickness, -thickness])),
        shapes=shapes.astype(np.float32),
        stiffness=attached_stiffness(eras, masses, w).astype(single),
        forces=drive_forces(eras, w).astype(single),
        strokes=full_strokes(eras, w).astype(single),
        by_stiffness=np.broadcast_to(uncertainty.stiffness * k, (len(w), len(k))).astype(single),
        by_damping=(log_damping * 1j * w[:, None] * c).astype(single),
        finger=fingertip.dynamic_stiffness(w) if fingertip else np.zeros(len(w), dtype=complex),
        omega=w,
        fingertip=fingertip,
        load_std=uncertainty.fingertip,
        gain=uncertainty.gain,
        phase=math.radians(uncertainty.phase_deg),
        gain_variance=uncertainty.gain_variance,
        thickness=thickness,
    )
