"""A plate solved by NGSolve, with ERAs and fingertips attached by formulas of its own.

Nothing of the model is used here but the plate's numbers: modes of the free plate from NGSolve's
Reissner-Mindlin elements, the fingertip from its equation of motion, ERAs as springs and dampers.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from benchmarks.plate.peers.meshes import Elements
from benchmarks.plate.peers.ngsolve_plate import Matrices
from benchmarks.plate.problem import PAPER, STROKE
from model.arrays import ComplexArray, FloatArray

Rows: TypeAlias = sparse.csr_array
"""A deflection at each point by degrees of freedom, (p, size)."""

LENGTH, WIDTH = PAPER.plate.length, PAPER.plate.width
MASS = LENGTH * WIDTH * PAPER.plate.thickness * PAPER.plate.material.rho
LOSS_FACTOR, STIFFNESS, DAMPING_RATIO = 0.01, 17_000.0, 0.05
MESH = Elements(5, 10, 8, strips=(0.0015,))
MODES = 80
"""Up to some 4 kHz; what is left out counts by its static deflection at ERAs and fingers."""

CORNERS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
MID_EDGES = ((0.5, 0.0), (1.0, 0.5), (0.5, 1.0), (0.0, 0.5))
PULP, PULP_DAMPING, CONTACT, PHALANX, JOINT, JOINT_DAMPING = 1000.0, 2.0, 2e-4, 5e-3, 500.0, 2.0


@dataclass(frozen=True)
class Spread:
    """Standard deviations of plates, as a rig states them; damping: a factor."""

    gain: float = 0.0
    phase_deg: float = 0.0
    thickness: float = 0.0
    stiffness: float = 0.0
    damping: float = 1.0
    fingertip: float = 0.0


@dataclass(frozen=True, eq=False)
class Plates:
    """Plates that deviate: factors of thickness, damping, loss factor (m,), and so on.

    stiffness (m, eras), load (m, fingers): factors; gain (m, eras): complex.
    """

    thickness: FloatArray
    damping: FloatArray
    loss: FloatArray
    stiffness: FloatArray
    load: FloatArray
    gain: ComplexArray

    @classmethod
    def draw(
        cls, spread: Spread, count: int, *, eras: int, fingers: int, rng: np.random.Generator
    ) -> "Plates":
        """Draw plates of a spread."""
        normal, turn = rng.standard_normal, np.radians(spread.phase_deg)
        gain = 1 + spread.gain * normal((count, eras))
        return cls(
            thickness=1 + spread.thickness * normal(count),
            damping=spread.damping ** normal(count),
            loss=spread.damping ** normal(count),
            stiffness=np.maximum(1 + spread.stiffness * normal((count, eras)), 0.1),
            load=np.exp(spread.fingertip * normal((count, fingers))),
            gain=gain * np.exp(1j * turn * normal((count, eras))),
        )

    def first(self, count: int) -> "Plates":
        """The first of the plates."""
        return Plates(*(getattr(self, name)[:count] for name in self.__dataclass_fields__))


class FreePlate:
    """Modes of the paper's free plate, and the static deflection that they leave out."""

    def __init__(self) -> None:
        self._matrices = Matrices(PAPER, MESH)
        stiffness, mass = self._matrices.real()
        self._shift = (2 * np.pi * 30.0) ** 2
        self._solve = self._matrices.shifted_factor(self._shift)
        inverse = LinearOperator(stiffness.shape, matvec=lambda b: self._solve(np.ravel(b)))
        values, vectors = eigsh(stiffness, MODES, M=mass, sigma=-self._shift, OPinv=inverse)
        self.eigenvalues: FloatArray = np.maximum(values, 0)
        self._vectors: FloatArray = vectors

    def rows(self, points: FloatArray) -> Rows:
        """What deflections at points (p, 2) [m] are read from."""
        within = np.clip(points, 1e-9, np.array([LENGTH, WIDTH]) - 1e-9)
        return self._matrices.at(within)

    def shapes(self, rows: Rows) -> FloatArray:
        """Mode shapes (p, modes)."""
        return np.asarray(rows @ self._vectors)

    def deflections(self, rows: Rows) -> FloatArray:
        """Static deflections (size, p) under unit forces, without those of the modes."""
        under = self._solve(np.ascontiguousarray(rows.toarray().T))
        kept = self._vectors @ ((rows @ self._vectors) / (self.eigenvalues + self._shift)).T
        return np.asarray(under - kept)


@dataclass(frozen=True, eq=False)
class Fingers:
    """ERAs and fingers on the plate; the first finger is the target.

    attached (eras + fingers, modes), points (p, modes): shapes; rest_between, rest_to_points
    (a, a), (p, a) [m/N]: static remainders; finger (p,): whose point; weights (p,): of the mean
    over its disc; loaded: whether fingers weigh on the plate.
    """

    eigenvalues: FloatArray
    attached: FloatArray
    points: FloatArray
    rest_between: FloatArray
    rest_to_points: FloatArray
    finger: FloatArray
    weights: FloatArray
    era_count: int
    loaded: bool

    @cached_property
    def finger_count(self) -> int:
        """Number of fingers."""
        return len(self.attached) - self.era_count

    def accelerations(self, frequency: float, plates: Plates) -> ComplexArray:
        """Acceleration [m/s²] at the points of each ERA at full stroke, (m, p, eras)."""
        w, n = 2 * np.pi * frequency, self.era_count
        thick = plates.thickness[:, None]
        loss = 1 + 1j * LOSS_FACTOR * plates.loss[:, None]
        modal = 1 / (loss * thick**2 * self.eigenvalues - w**2) / thick
        softer = (1 / (loss * thick**3))[:, :, None]
        between = (modal[:, None] * self.attached) @ self.attached.T
        between = between + softer * self.rest_between
        damping = 2 * DAMPING_RATIO * np.sqrt(STIFFNESS * MASS / n)
        mount = STIFFNESS * plates.stiffness + 1j * w * damping * plates.damping[:, None]
        load = plates.load * (_fingertip(w) if self.loaded else 0.0)
        held = np.concatenate([mount, load], axis=1)
        system = np.eye(len(self.attached)) + held[:, :, None] * between
        drive = np.zeros((len(mount), len(self.attached), n), dtype=complex)
        drive[:, np.arange(n), np.arange(n)] = mount * STROKE * plates.gain
        forces = np.linalg.solve(system, drive)
        modal_forces = modal[:, :, None] * (self.attached.T @ forces)
        found = self.points @ modal_forces + softer * (self.rest_to_points @ forces)
        return np.asarray(-(w**2) * found)


def _fingertip(w: float) -> complex:
    """Force per displacement of a contact mass on a pulp whose phalanx moves on its joint."""
    # Two masses: contact on the plate u, phalanx v; k (u - v) and c (u' - v') between them.
    pulp = PULP + 1j * w * PULP_DAMPING
    joint = JOINT + 1j * w * JOINT_DAMPING
    # Phalanx: pulp (u - v) = joint v - w² m v.
    v_per_u = pulp / (pulp + joint - w**2 * PHALANX)
    return complex(-(w**2) * CONTACT + pulp * (1 - v_per_u))


def disc(x: float, y: float, radius: float) -> tuple[FloatArray, FloatArray]:
    """Points of a fingertip on the plate (p, 2), and their weights in the mean over its disc.

    Three rings of nine at Gauss points in the squared radius, and eight without weight on the rim;
    those off the plate are left out.
    """
    nodes, ring_weights = np.polynomial.legendre.leggauss(3)
    points, weights = [], []
    for node, weight in zip(nodes, ring_weights, strict=True):
        angles = 2 * np.pi * (np.arange(9) + 0.5 * (node > 0)) / 9
        r = radius * np.sqrt((node + 1) / 2)
        points.append(np.column_stack([x + r * np.cos(angles), y + r * np.sin(angles)]))
        weights.append(np.full(9, weight / 9))
    rim = radius * np.column_stack([f(2 * np.pi * np.arange(8) / 8) for f in (np.cos, np.sin)])
    points.append(np.add(rim, (x, y)))
    weights.append(np.zeros(8))  # for the maximum only
    at, of = np.concatenate(points), np.concatenate(weights)
    on = ((at >= 0) & (at <= [LENGTH, WIDTH])).all(axis=1)
    return at[on], of[on] / of[on].sum()


def fingers_on(
    free: FreePlate, places: FloatArray, *, eras: int, loaded: bool, radius: float
) -> Fingers:
    """Fingers (n, 2) [m] on the plate with ERAs at its corners, or there and at mid-edges."""
    shares = np.array([*CORNERS, *MID_EDGES][:eras])
    discs = [disc(x, y, radius) for x, y in places]
    attached = free.rows(np.vstack([shares * [LENGTH, WIDTH], places]))
    points = free.rows(np.concatenate([points for points, _ in discs]))
    rest = free.deflections(attached)
    return Fingers(
        eigenvalues=free.eigenvalues,
        attached=free.shapes(attached),
        points=free.shapes(points),
        rest_between=np.asarray(attached @ rest),
        rest_to_points=np.asarray(points @ rest),
        finger=np.repeat(np.arange(len(places)), [len(points) for points, _ in discs]),
        weights=np.concatenate([weights for _, weights in discs]),
        era_count=eras,
        loaded=loaded,
    )
