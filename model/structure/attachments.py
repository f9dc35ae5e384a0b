"""Attachments of the plate: point loads, feet, frames, and the coupling of all attachments.

Each attachment reacts to the plate's motion with a dynamic stiffness D; a source
(`model.structure.sources`) also drives the plate with a force. The plate on its attachments is a
low-rank correction of the free plate (Woodbury identity, `coupled_forces`).

A bonded frame or foam tape along the edges acts at weighted Gauss-Legendre points of each edge: n
points are exact for products of shapes up to degree 2 n - 1. As points they keep their mass and
stiffness on a plate of any thickness. Each point is a small disc, since a point force dents a plate
with shear deformation without limit, as the logarithm of its size.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, Literal, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import expect_values
from model.structure.plate import Plate


class Attachment(Protocol):
    """A source, a point load or a fingertip, which reacts to the plate's motion at a footprint."""

    @property
    def x(self) -> float:
        """Center of the footprint [m], as y."""

    @property
    def y(self) -> float:
        """Center of the footprint [m]."""

    @property
    def foot(self) -> float:
        """Radius of the disc on which it acts [m], 0 for a point."""

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """D [N/m] at omega [rad/s], of its shape."""


@dataclass(frozen=True)
class InTime:
    """Coefficients of an attachment in time: a spring and a damper from the plate to its far end.

    The far end is the ground, the base of an ERA, or the magnet of an exciter.
    """

    mass: float
    """Mass that moves with the plate [kg]."""

    stiffness: float  # N/m
    damping: float  # N s/m
    far_mass: float | None = None
    """Mass of the far end [kg]; None if its motion is prescribed, for example zero."""

    by_drive: float = 0.0
    """Force that pushes the plate and the far end apart, per unit of the drive."""

    by_rate: float = 0.0
    """The same force per unit of the rate of the drive."""

    inertance: float = 0.0
    """The same force per relative acceleration of both ends [kg]."""


@dataclass(frozen=True)
class PointLoad:
    """A spring and a damper to the ground, and a mass, on a point or a disc of the plate.

    It follows the mean deflection of a disc; its rotary inertia is not modeled.
    """

    x: float  # m, as y
    y: float
    stiffness: float = 0.0  # N/m
    damping: float = 0.0  # N s/m
    mass: float = 0.0  # kg
    foot: float = 0.0
    """Radius of the disc on which it acts [m], 0 for a point."""

    loss_factor: float = 0.0
    """Loss factor eta of the spring, k (1 + i eta), for example of foam."""

    is_foot: bool = False
    """Whether it is a foot, to whose stiffness `Uncertainty.supports` applies."""

    def __post_init__(self) -> None:
        """Reject values that are not finite, and loads that add energy."""
        not_negative = "stiffness damping mass foot loss_factor"
        expect_values(self, "point load", at_least=not_negative, finite="x y")

    @property
    def in_time(self) -> InTime:
        """Its equations in time."""
        return InTime(self.mass, self.stiffness, self.damping)

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """D = k (1 + i eta) + i omega c - omega² m [N/m], of the shape of omega [rad/s].

        At negative frequencies (the lower sideband of a fast ramp), the conjugate.
        """
        spring = self.spring(omega)
        return np.asarray(spring + 1j * omega * self.damping - omega**2 * self.mass)

    def spring(self, omega: FloatArray) -> ComplexArray:
        """The term k (1 + i eta) of D [N/m], of the shape of omega [rad/s]."""
        return self.stiffness * (1 + 1j * self.loss_factor * np.sign(omega))


FootKind: TypeAlias = Literal["foam", "rubber"]
"""Kinds of feet of a rig file."""

FEET: Mapping[FootKind, float] = {"foam": 2e3, "rubber": 30e3}
"""Assumed stiffness of each kind of foot [N/m], for about 2 cm; measure your own by weighing."""

FEET_DEVIATE = 0.3
"""Assumed standard deviation of the logarithm of a foot's stiffness, unless the rig states one.

Also applies to a measured static stiffness: rubber is stiffer in vibration, depending on its
compound.
"""

FOOT_LOSS = 0.15
"""Assumed loss factor of feet of every kind."""

DEFAULT_POINTS = 7
"""Number of points at which a frame acts on each edge."""

EDGE_FOOT = 1e-3
"""Radius [m] of the discs at these points."""


def feet_of(loads: Iterable[Attachment]) -> tuple[int, ...]:
    """Numbers of the loads that are feet, in ascending order."""
    return tuple(n for n, load in enumerate(loads) if isinstance(load, PointLoad) and load.is_foot)


def edge_points(plate: Plate, count: int) -> Iterator[tuple[float, float, float]]:
    """Yield points x, y of all four edges, and the length that each represents [m].

    count: number of points of an edge.
    """
    nodes, weights = leggauss(count)
    positions = ((1 + nodes) / 2).tolist()
    shares = (weights / 2).tolist()
    for position, share in zip(positions, shares, strict=True):
        for y in (0.0, plate.width):
            yield plate.length * position, y, plate.length * share
    for position, share in zip(positions, shares, strict=True):
        for x in (0.0, plate.length):
            yield x, plate.width * position, plate.width * share


def least_points(plate: Plate, frequency: float) -> int:
    """Number of points of an edge for natural frequencies within 0.3 % up to a frequency [Hz].

    Two for each wavelength, and 2.7 more: with a frame of 0.05 kg/m on 400 x 300 mm of birch
    plywood of 6.4 mm, frequencies differ by 0.33 % at 421 Hz with six points, by 0.11 % with seven.
    """
    side = max(plate.length, plate.width)
    return math.ceil(2 * side / plate.bending_wavelength(frequency) + 2.7)


_Complex = TypeVar("_Complex", bound="np.complexfloating[Any, Any]")


def footprints_of(*attached: Iterable[Attachment]) -> FloatArray:
    """Return footprints x, y, radius [m] of attachments, one group after the other, (n, 3)."""
    footprints = [[at.x, at.y, at.foot] for at in chain.from_iterable(attached)]
    return np.array(footprints, dtype=float).reshape(-1, 3)


def attached_stiffness(omega: FloatArray, *attached: Iterable[Attachment]) -> ComplexArray:
    """Dynamic stiffness [N/m] at omega (f,) [rad/s], one group after the other, (f, n)."""
    stiffnesses = [at.dynamic_stiffness(omega) for at in chain.from_iterable(attached)]
    return np.array(stiffnesses, dtype=complex).reshape(-1, len(omega)).T.copy()


def coupled_forces(
    receptance: NDArray[_Complex], dynamic_stiffness: NDArray[_Complex], applied: NDArray[_Complex]
) -> NDArray[_Complex]:
    """Forces F on the free plate [N] that follow from applied forces: (I + D R) F = P.

    receptance R (..., n, n) [m/N]: of the free plate between its attachments; dynamic_stiffness
    (..., n) [N/m]: the diagonal of D; applied P (..., n, m) [N]: at the attachments. An attachment
    reacts with -D times its displacement R F.
    """
    unit = np.eye(receptance.shape[-1], dtype=receptance.real.dtype)
    system = unit + dynamic_stiffness[..., None] * receptance
    return np.asarray(np.linalg.solve(system, applied))
