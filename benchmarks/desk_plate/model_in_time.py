"""A plate on its ERAs in continuous time: from samples at the actuators to accelerations.

Coordinates q are those of the free plate (`ReducedPlate`) and the free end of each actuator that
has one, as the magnet of an exciter; then there are the drive y of each actuator, the base of an
ERA or the voltage of an exciter, and the phalanx of each finger. Actuators and fingers couple the
modes; their damping is not proportional. With the actuators' `InTime`,

    M q'' + C q' + K q = Phi_e^T (b y + b' y'),   y'' + 2 zeta w y' + w² y = g w² full level u

The drive is a state, so that accelerations follow from it: with it as input they would grow with
frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from benchmarks.desk_plate.truth import Truth
from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.structure.attachments import FingertipLoad, footprints_of

FREQUENCY_MAX = 1000.0
"""Hz; of the response, modes are kept to twice that."""


@dataclass(frozen=True, eq=False)
class ModelInTime:
    """x' = A x + B u, accelerations C x [m/s²] at points.

    A (n, n), B (n, eras), C (points, n); x has displacements and velocities of the coordinates of
    plate and free ends, then of the drives, then of the phalanges.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray

    def response(self, frequencies: FloatArray) -> ComplexArray:
        """Accelerations by full scale at frequencies [Hz] in continuous time, (f, points, eras)."""
        s = 2j * np.pi * np.asarray(frequencies)
        eye = np.eye(len(self.A))
        return np.array([self.C @ np.linalg.solve(each * eye - self.A, self.B) for each in s])


class DeskModel:
    """The plate of a truth, solved once; fingers come and go.

    points (p, 2) [m]: of the accelerometers.
    """

    def __init__(self, truth: Truth, points: FloatArray) -> None:
        rig = truth.rig
        self._truth = truth
        attached = footprints_of(rig.eras, rig.masses)
        self._plate: ReducedPlate = reduce_plate(
            rig.plate, rig.mesh, attached, frequency_max=FREQUENCY_MAX
        )
        far = [(n, era.in_time.far_mass) for n, era in enumerate(rig.eras)]
        self._far_masses = np.array([mass for _, mass in far if mass is not None])
        self._at_attached = self._extended(self._plate.at(attached))
        self._at_points = self._extended(self._plate.at(points))
        free = [n for n, mass in far if mass is not None]
        # Forces of an actuator push its two ends apart.
        self._at_attached[free, len(self._plate.omega) :] = -np.eye(len(free))

    def _extended(self, shapes: FloatArray) -> FloatArray:
        """Shapes of the plate (p, r) in all coordinates, in which free ends are at rest."""
        return np.hstack([shapes, np.zeros((len(shapes), len(self._far_masses)))])

    @property
    def _size(self) -> int:
        """Number of coordinates of plate and free ends."""
        return len(self._plate.omega) + len(self._far_masses)

    @property
    def shared(self) -> int:
        """Number of the first states, which are the same under any fingers."""
        return 2 * self._size + 2 * len(self._truth.rig.eras)

    def under(
        self,
        fingers: Sequence[FingertipLoad] = (),
        *,
        moved: tuple[int, float] | None = None,
        points: FloatArray | None = None,
    ) -> ModelInTime:
        """The plate with fingers on it.

        moved: the only point with an accelerometer now, by its number, and its mass [kg]; points
        (p, 2) [m]: in place of the accelerometers'.
        """
        rig, r = self._truth.rig, self._size
        count = len(rig.eras)
        at_eras, at_masses = self._at_attached[:count], self._at_attached[count:]
        k, c, m, inertance, by_drive, by_rate = (
            np.array([getattr(era.in_time, key) for era in rig.eras])
            for key in ("stiffness", "damping", "mass", "inertance", "by_drive", "by_rate")
        )
        plain = self._extended(at_eras[:, : len(self._plate.omega)])  # of the plate's ends alone
        mass = linalg.block_diag(np.eye(len(self._plate.omega)), np.diag(self._far_masses))
        mass += (plain.T * m) @ plain + (at_eras.T * inertance) @ at_eras
        damping = (at_eras.T * c) @ at_eras
        stiffness = np.diag(self._elastic) + (at_eras.T * k) @ at_eras
        for load, shape in zip(rig.masses, at_masses, strict=True):
            mass += load.mass * np.outer(shape, shape)
            damping += load.damping * np.outer(shape, shape)
            stiffness += load.stiffness * np.outer(shape, shape)
        damping += self._structural(mass, stiffness)
        at_points = self._at_points
        if points is not None:
            at_points = self._extended(self._plate.at(points))
        if moved is not None:
            number, weight = moved
            at_points = at_points[[number]]
            mass += weight * at_points.T @ at_points

        contacts = np.empty((0, r))
        if fingers:
            contacts = self._extended(self._plate.at(footprints_of(fingers)))
        p = len(fingers)
        n = 2 * r + 2 * count + 2 * p
        A, B = np.zeros((n, n)), np.zeros((n, count))
        q, v = slice(0, r), slice(r, 2 * r)
        y, w = (slice(2 * r + i * count, 2 * r + (i + 1) * count) for i in (0, 1))
        x, u = (slice(2 * r + 2 * count + i * p, 2 * r + 2 * count + (i + 1) * p) for i in (0, 1))
        tips = [finger.fingertip for finger in fingers]
        pulp, loss = np.array([t.stiffness for t in tips]), np.array([t.damping for t in tips])
        for tip, shape in zip(tips, contacts, strict=True):
            mass += tip.contact_mass * np.outer(shape, shape)
            damping += tip.damping * np.outer(shape, shape)
            stiffness += tip.stiffness * np.outer(shape, shape)

        force = np.zeros((r, n))
        force[:, q], force[:, v] = -stiffness, -damping
        force[:, y], force[:, w] = at_eras.T * by_drive, at_eras.T * by_rate
        force[:, x], force[:, u] = contacts.T * pulp, contacts.T * loss
        motion = linalg.solve(mass, force, assume_a="pos")
        A[q, v], A[v] = np.eye(r), motion

        omega = 2 * np.pi * np.array([each.resonance for each in self._truth.actuators])
        ratio, gain = (
            np.array([getattr(each, key) for each in self._truth.actuators])
            for key in ("ratio", "gain")
        )
        strokes = np.array([era.full_level for era in rig.eras])
        A[y, w] = np.eye(count)
        A[w, y], A[w, w] = -np.diag(omega**2), -np.diag(2 * ratio * omega)
        B[w] = np.diag(gain * omega**2 * strokes)

        A[x, u] = np.eye(p)
        for row, (tip, shape) in enumerate(zip(tips, contacts, strict=True), start=u.start):
            phalanx = row - p
            A[row, q] = tip.stiffness / tip.phalanx_mass * shape
            A[row, v] = tip.damping / tip.phalanx_mass * shape
            A[row, phalanx] = -(tip.stiffness + tip.joint_stiffness) / tip.phalanx_mass
            A[row, row] = -(tip.damping + tip.joint_damping) / tip.phalanx_mass
        return ModelInTime(A, B, at_points @ motion)

    @property
    def _elastic(self) -> FloatArray:
        """Eigenvalues of the plate [rad²/s²], none of free ends."""
        return np.append(self._plate.omega**2, np.zeros(len(self._far_masses)))

    def _structural(self, mass: FloatArray, stiffness: FloatArray) -> FloatArray:
        """Viscous damping that loses at each resonance of the supported plate what eta does.

        eta K_plate between modes j and k of the supported plate, over sqrt(omega_j omega_k).
        """
        values, modes = linalg.eigh(stiffness, mass)
        elastic = (modes.T * self._elastic) @ modes * self._truth.rig.plate.loss_factor
        roots = np.maximum(values, 1e-3) ** 0.25
        weighted = mass @ modes
        return np.asarray(weighted @ (elastic / np.outer(roots, roots)) @ weighted.T)
