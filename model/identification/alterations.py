"""What no parameter of a plate stands for: a hand that rests on it, and a crack.

Both act on few coordinates of the plate, each a combination of its deflection at points about a
place, by dynamic stiffnesses Z there. With T of the plate without them, between its attachments and
those coordinates c, the receptance becomes

    T' = T - T_c (1 + Z T_cc)^-1 Z T_c^T.

A crack loses bending energy: over an area a, as far as none of its stiffness is left there, a plate
of rigidity D loses a D / 2 ((k_xx + k_yy)² (1 + nu) / 2 + ((k_xx - k_yy)² / 2 + 2 k_xy²) (1 - nu)),
k its curvatures, so that Z is -a D (1 + nu) and twice -a D (1 - nu). To first order that is the
change of the modal stiffness (P. Cawley, R. D. Adams, The location of defects in structures from
measurements of natural frequencies, J. Strain Analysis 14, 1979, 49-57); truncated modes are left
out. Its direction is not modelled: cracks begin at edges, where only the moment along the edge is
left.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import jacobian
from model.identification.forward import PlateAt
from model.identification.settled import Touched
from model.reduction.receptance import TERMS, combined
from model.structure.attachments import coupled_forces
from model.structure.plate import Plate

# Of parameters, for slopes (by places no closed form: `model.reduction.place_slopes`): right to
# 0.1 %, and rounding stays below 1e-6 of them.
_STEP = 1e-4
_MIN_STENCIL = 0.004  # m
_MIN_SIZE = 0.2  # to start from, of the usual one
_LEAST = -6.0  # of logarithms


class Alteration(ABC):
    """A kind of what may have come; parameters (e,) are x, y in thirds of the sides, then its own.

    own: names of its own parameters, logarithms of parts of its stiffness over usual ones;
    is_of_modes: whether truncated modes are left out.
    """

    name: ClassVar[str]
    own: ClassVar[tuple[str, ...]]
    is_of_modes: ClassVar[bool] = False

    @property
    def size(self) -> int:
        """Number of its parameters e."""
        return 2 + len(self.own)

    @abstractmethod
    def stencil(self, plate: Plate, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (m, 2) [m] about a place [m], and its coordinates by their deflections (c, m)."""

    @abstractmethod
    def stiffness(self, plate: Plate, theta: FloatArray, omega: float) -> ComplexArray:
        """Its dynamic stiffness at omega [rad/s] for its own parameters, (c,)."""

    @abstractmethod
    def described(self, theta: FloatArray) -> str:
        """What its own parameters say."""

    def start(self, size: float) -> FloatArray:
        """Its own parameters (e - 2,) for so many usual ones."""
        return np.full(len(self.own), np.log(max(size, _MIN_SIZE)))


class Hand(Alteration):
    """A hand, or a finger that no panel reports: a mass, a damper and a spring to the ground.

    Its parameters are logarithms of them over usual ones of one to five fingertips: a hand without
    damping would be a mass.
    """

    name = "a hand"
    own = ("mass", "damping", "stiffness")
    units: ClassVar[FloatArray] = np.array([1e-3, 5.0, 1000.0])  # kg, N s/m, N/m

    def stencil(self, plate: Plate, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The place itself."""
        return place[None], np.ones((1, 1))

    def stiffness(self, plate: Plate, theta: FloatArray, omega: float) -> ComplexArray:
        """-omega² m + i omega c + k."""
        mass, damping, spring = self.units * np.exp(theta)
        return np.array([spring - omega**2 * mass + 1j * omega * damping])

    def described(self, theta: FloatArray) -> str:
        """Its damping."""
        return f"{self.units[1] * np.exp(theta[1]):.2g} N s/m"


class Crack(Alteration):
    """A local loss of bending stiffness, by the logarithm of the area without any over 3 cm²."""

    name = "a crack"
    own = ("area",)
    is_of_modes = True
    unit: ClassVar[float] = 3e-4  # m²

    def stencil(self, plate: Plate, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Curvatures by differences over some millimetres, moved inwards at edges."""
        sides = np.array([plate.length, plate.width])
        h = max(0.03 * sides.min(), _MIN_STENCIL)
        middle = np.clip(place, h, sides - h)
        steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=float)
        second = np.array([1, -2, 1]) / h**2
        first, none = np.array([-1, 0, 1]) / (2 * h), np.array([0, 1, 0])
        xx, yy, xy = np.outer(second, none), np.outer(none, second), np.outer(first, first)
        coordinates = [(xx + yy) / np.sqrt(2), (xx - yy) / np.sqrt(2), np.sqrt(2) * xy]
        return middle + h * steps, np.array([each.ravel() for each in coordinates])

    def stiffness(self, plate: Plate, theta: FloatArray, omega: float) -> ComplexArray:
        """Less than none, of each of the three coordinates."""
        nu = plate.material.nu
        lost = self.unit * np.exp(theta[0]) * plate.flexural_rigidity
        return np.asarray(-lost * np.array([1 + nu, 1 - nu, 1 - nu]), dtype=complex)

    def described(self, theta: FloatArray) -> str:
        """The area."""
        return f"{1e4 * self.unit * np.exp(theta[0]):.2g} cm² without bending stiffness"


@dataclass(frozen=True, eq=False)
class Altered(Touched):
    """A pattern on a plate that is altered; space: of the plate, then those of the alteration."""

    alteration: Alteration = field(kw_only=True)

    @classmethod
    def by(cls, alteration: Alteration, touched: Touched) -> Self:
        """A pattern whose plate was altered."""
        names = [f"{each} of {alteration.name}" for each in ("x", "y", *alteration.own)]
        free = len(alteration.own)
        low, high = [-1.5] * 2 + [_LEAST] * free, [1.5] * 2 + [np.inf] * free
        wider = touched.space.and_further("alteration", names, 1.0, low, high)
        return cls(touched.pattern, wider, touched.touched, touched.noise, alteration=alteration)

    @property
    def _sides(self) -> FloatArray:
        plate = self.touched.rig.plate
        return np.array([plate.length, plate.width])

    def place(self, theta: FloatArray) -> FloatArray:
        """Where parameters (e,) of the alteration have it [m]."""
        return np.asarray(self._sides * (0.5 + theta[:2] / 3))

    def parameters(self, place: FloatArray, own: FloatArray) -> FloatArray:
        """Parameters (e,) of the alteration at a place [m]."""
        return np.concatenate([3 * (place / self._sides - 0.5), own])

    def predicted(self, x: FloatArray, fingers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Numbers that the pattern is expected to give, and their derivatives (2 s, p + e + q).

        Derivatives by plate and fingers are those without the alteration.
        """
        p, bases = self.space.size - self.alteration.size, self.pattern.bases
        plate, theta = self.touched.at(np.concatenate([x[:p], fingers])), x[p:]

        def accelerations(theta: FloatArray) -> ComplexArray:
            return altered(plate, self.alteration, self.place(theta), theta[2:]) @ bases

        values, inwards = accelerations(theta), np.where(theta > 0, -_STEP, _STEP)
        by_theta = [
            (accelerations(theta + step) - values) / step.sum() for step in np.diag(inwards)
        ]
        J = np.einsum("snp,n->sp", jacobian(plate)[0], bases)
        return self.as_numbers(values, np.column_stack([J[:, :p], *by_theta, J[:, p:]]))


def scores(
    touched: Touched, plate: PlateAt, alteration: Alteration, places: FloatArray
) -> FloatArray:
    """Numbers of a pattern (2 s, m) by an alteration of usual size at places (m, 2) [m]."""
    stencils = [alteration.stencil(plate.model.rig.plate, place) for place in places]
    points = np.concatenate([each for each, _ in stencils])
    reach = plate.left[0] @ _receptance(plate, alteration, plate.located.footprints, points)
    reach = reach.reshape(len(reach), len(places), -1)
    coordinates = np.array([each for _, each in stencils])
    columns = np.einsum("amk,mck->amc", reach, coordinates)
    Z = alteration.stiffness(plate.model.rig.plate, alteration.start(1.0), plate.model.omega[0])
    n, observed, bases = plate.base.shape[1], plate.model.observed, touched.pattern.bases
    left, right = columns[observed] * Z, columns[:n]
    changes = -np.einsum("smc,nmc,sn,n->sm", left, right, plate.scale[0], bases)
    return touched.as_numbers(plate.responses[0] @ bases, changes)[1]


def altered(
    plate: PlateAt, alteration: Alteration, place: FloatArray, own: FloatArray
) -> ComplexArray:
    """Responses of a plate at one frequency that is altered at a place [m], (s, n) [1/s²].

    own: parameters of its alteration.
    """
    theory = plate.model.rig.plate
    points, coordinates = alteration.stencil(theory, place)
    Z = alteration.stiffness(theory, own, plate.model.omega[0])
    A = _receptance(plate, alteration, plate.located.footprints, points) @ coordinates.T
    within = coordinates @ _receptance(plate, alteration, points, points) @ coordinates.T
    T = plate.left[0] @ A
    within = within - A.T @ (plate.stiffness[0][:, None] * T)
    columns = T @ coupled_forces(within, Z, np.eye(len(Z), dtype=complex))
    change = (columns[plate.model.observed] * Z) @ T[: plate.base.shape[1]].T
    return np.asarray(plate.responses[0] - plate.scale[0] * change)


def _receptance(
    plate: PlateAt, alteration: Alteration, points: FloatArray, others: FloatArray
) -> ComplexArray:
    """Of the free plate between points and others, (n, m), truncated modes included if need be."""
    modes = plate.model.modes
    found = modes.shapes_at(points) @ plate.solved(modes.shapes_at(others))[0]
    if alteration.is_of_modes:
        return np.asarray(found)
    truncated = combined(plate.functions.truncated(TERMS), modes.truncated_terms(points, others))
    return np.asarray(found + truncated[0])
