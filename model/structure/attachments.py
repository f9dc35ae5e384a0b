"""Attachments of the plate: actuators (ERAs), masses, feet, frames, and fingertips.

Each acts on the plate with a dynamic stiffness; a source also drives it with a force. The plate on
its attachments is a low-rank correction of the free plate (Woodbury identity).

An ERA is a spring, a damper and a bolt between the plate and a base that moves. A fingertip is a
contact mass that moves with the plate, and a spring and a damper (the pulp) to the phalanx, which a
joint holds. The phalanx is not at rest: at 60, 100 and 250 Hz the real part of the dynamic
stiffness is 69, -87 and -358 N/m where a phalanx at rest gives 972, 921 and 507.
docs/concepts/people.md states their uncertainty.

A bonded frame or foam tape along the edges acts at weighted Gauss-Legendre points of each edge: n
points are exact for products of shapes up to degree 2 n - 1. As points they keep their mass and
stiffness on a plate of any thickness. Each point is a small disc, since a point force dents a plate
with shear deformation without limit, as the logarithm of its size.

Footprints are such discs, or points, at which attachments act. A force on a disc is distributed
evenly over its part on the plate, and the attachment follows the mean deflection there.

Springs support a plate if they hold all of its rigid-body modes.
"""

import cmath
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from itertools import chain
from typing import Any, ClassVar, Literal, Self, TypeAlias, TypeVar

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy import sparse

from model.arrays import ComplexArray, FloatArray, Point
from model.errors import InputError, expect_values
from model.structure.plate import Plate
from model.structure.surface import center_of_surface, moments_of_surface
from registry.limits import HAND_LOAD, MAX_FINGER_LOAD

Gain: TypeAlias = tuple[float, float, float]
"""Frequency [Hz], magnitude, phase [rad]."""

Factor: TypeAlias = float | FloatArray
"""Factor of a parameter, or one for each of several plates."""


@dataclass(frozen=True)
class InTime:
    """Coefficients of a source in time: a spring and a damper from the plate to its far end."""

    mass: float
    """Mass that moves with the plate [kg]."""

    stiffness: float  # N/m
    damping: float  # N s/m
    far_mass: float | None = None
    """Mass of the far end [kg]; None if it is held, or its motion is given."""

    by_drive: float = 0.0
    """Force that pushes the plate and the far end apart, per unit of the drive."""

    by_rate: float = 0.0
    """The same per unit of the rate of the drive."""

    inertance: float = 0.0
    """Force by the relative acceleration of both ends [kg]."""


@dataclass(frozen=True)
class Source(ABC):
    """An actuator: what drives the plate, and supports it.

    Errors of its spring and damper act on the plate with the change of D times the base less the
    plate's motion.
    """

    UNIT: ClassVar[str]
    """Unit of its drive: m for an ERA's base, V for an exciter."""

    name: str
    """Its name in the rig."""

    x: float  # m, as y
    y: float
    stiffness: float  # N/m, of its spring
    damping: float  # N s/m, of its damper
    gains: tuple[Gain, ...] = field(default=(), kw_only=True)
    """Measured complex gain of its drive, at ascending frequencies; empty for a gain of 1."""

    foot: float = field(default=0.0, kw_only=True)
    """Radius of the disc on which it acts [m], 0 for a point."""

    def __post_init__(self) -> None:
        """Keep gains as tuples: a file gives lists, which cannot be compared and hashed."""
        gains = tuple((float(f), float(size), float(phase)) for f, size, phase in self.gains)
        object.__setattr__(self, "gains", gains)

    @property
    @abstractmethod
    def full_level(self) -> float:
        """Amplitude of its drive at level 1."""

    @property
    @abstractmethod
    def support(self) -> "PointLoad":
        """Static equivalent, for a slowly moving plate."""

    @property
    @abstractmethod
    def in_time(self) -> InTime:
        """Its equations in time."""

    @property
    def excursion(self) -> float:
        """Largest motion between its ends [m]; infinite without a limit."""
        return math.inf

    def gain(self, frequencies: FloatArray) -> ComplexArray:
        """Complex gain of its drive at frequencies [Hz], of their shape; 1 without measured gains.

        Linear between measured frequencies, constant outside. At negative frequencies (the lower
        sideband of a fast ramp) it is the conjugate, because the drive is real.
        """
        if not self.gains:
            return np.ones(np.shape(frequencies), dtype=complex)
        measured = [frequency for frequency, _, _ in self.gains]
        values = np.array([cmath.rect(size, phase) for _, size, phase in self.gains])
        gains = np.interp(np.abs(frequencies), measured, values)
        return np.asarray(np.where(np.asarray(frequencies) < 0, gains.conj(), gains))

    @abstractmethod
    def force(self, omega: FloatArray) -> ComplexArray:
        """Force [N] at full level on a plate that is held, at omega [rad/s], of its shape."""

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """D [N/m] at omega [rad/s], of its shape."""
        return self.deviating(omega, 1.0, 1.0)[0]

    @abstractmethod
    def deviating(
        self, omega: FloatArray, stiffness: Factor, damping: Factor
    ) -> tuple[ComplexArray, ComplexArray]:
        """Dynamic stiffness [N/m], and force per drive without gain, with stiffness and damping
        scaled.

        stiffness, damping: factors; all arguments broadcast.
        """

    @abstractmethod
    def base(self, omega: FloatArray) -> ComplexArray:
        """Motion of its base at full level [m] at omega [rad/s], its own gain included."""

    def varied(self, *, stiffness: float = 1.0, damping: float = 1.0) -> Self:
        """The source with another stiffness and damping, by factors."""
        return replace(self, stiffness=stiffness * self.stiffness, damping=damping * self.damping)

    @abstractmethod
    def loosened(self, share: float) -> Self:
        """Return the source held by a fraction of its contact."""

    @property
    @abstractmethod
    def fields(self) -> Mapping[str, str]:
        """Its fields that an identification may change, by the kind of parameter."""

    @abstractmethod
    def slopes(self, omega: FloatArray) -> Mapping[str, tuple[ComplexArray, ComplexArray]]:
        """Changes of D [N/m] and of the force [N] with its values, by kind, each as omega.

        With damping [N s/m] and bolt_mass [kg], of all others with the logarithm.
        """


@dataclass(frozen=True)
class Era(Source):
    """One ERA under the plate; its base moves y(t) = amplitude sin(omega t + phase).

    Its spring has the stiffness k_b, its damper c. An ERA that is not driven still supports and
    damps.
    """

    UNIT: ClassVar[str] = "m"

    bolt_mass: float
    """Mass m_b that moves with the plate [kg]."""

    stroke: float
    """The largest base amplitude [m]."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        expect_values(
            self,
            f"ERA {self.name}",
            above="stiffness stroke",
            at_least="damping bolt_mass foot",
            finite="x y",
        )
        super().__post_init__()

    @property
    def full_level(self) -> float:
        """Amplitude of its base at level 1, its stroke [m]."""
        return self.stroke

    @property
    def support(self) -> "PointLoad":
        """The ERA at rest, as a load of the plate."""
        return PointLoad(self.x, self.y, self.stiffness, self.damping, self.bolt_mass, self.foot)

    @property
    def in_time(self) -> InTime:
        """Its equations in time; the base moves by itself."""
        k, c = self.stiffness, self.damping
        return InTime(self.bolt_mass, k, c, by_drive=k, by_rate=c)

    def deviating(
        self, omega: FloatArray, stiffness: Factor, damping: Factor
    ) -> tuple[ComplexArray, ComplexArray]:
        """D = k_b + i omega c - omega² m_b, and k_b + i omega c [N/m], by factors of k_b and c."""
        spring = stiffness * self.stiffness + 1j * omega * (damping * self.damping)
        return np.asarray(spring - omega**2 * self.bolt_mass), np.asarray(spring)

    def base(self, omega: FloatArray) -> ComplexArray:
        """Amplitude of the base at full stroke [m] at omega [rad/s], its own gain included."""
        return np.asarray(self.stroke * self.gain(omega / (2 * np.pi)))

    def force(self, omega: FloatArray) -> ComplexArray:
        """Force (k_b + i omega c) times the base's motion at full stroke [N] (paper Eq. 25)."""
        return np.asarray((self.stiffness + 1j * omega * self.damping) * self.base(omega))

    def loosened(self, share: float) -> Self:
        """An ERA with a share of its stiffness, which damps less, too."""
        return self.varied(stiffness=share, damping=min(share, 1.0))

    @property
    def fields(self) -> Mapping[str, str]:
        """Its spring, damper and bolt."""
        return {kind: kind for kind in ("stiffness", "damping", "bolt_mass")}

    def slopes(self, omega: FloatArray) -> Mapping[str, tuple[ComplexArray, ComplexArray]]:
        """Changes of D and of the force, which spring and damper pass on from the base."""
        w, base = np.asarray(omega), self.base(omega)
        held = {"stiffness": np.full(np.shape(w), self.stiffness, dtype=complex), "damping": 1j * w}
        bolt = np.asarray(-(w**2) + 0j), np.zeros(w.shape, dtype=complex)
        found = {kind: (np.asarray(own), np.asarray(own * base)) for kind, own in held.items()}
        return found | {"bolt_mass": bolt}


def damping_from_ratio(
    ratio: float, *, stiffness: float, plate_mass: float, era_count: int
) -> float:
    """Damping c = 2 zeta sqrt(k_b m_plate / n_eras) [N s/m], referred to the plate's mass."""
    return 2 * ratio * math.sqrt(stiffness * plate_mass / era_count)


MIN_LOAD = 0.1
"""Least load of a finger relative to the rig's fingertip; the largest is MAX_FINGER_LOAD."""

HAND_STD = 1.1
"""Standard deviation of the logarithm of the load of each patch of a hand, a factor of 3."""

HAND_PATCHES = ((-0.0125, -0.0125), (0.0125, -0.0125), (-0.0125, 0.0125), (0.0125, 0.0125))
"""Patches on which a hand of `HAND_LOAD` rests, each with a quarter of the load, from its center
[m].

Patches of a heavier hand are farther apart, by the square root of its load.
"""


@dataclass(frozen=True)
class Fingertip:
    """Load of a fingertip; the defaults are for a lightly pressing finger."""

    stiffness: float = 1000.0
    """Stiffness of the pulp [N/m]."""
    damping: float = 2.0
    """Damping of the pulp [N s/m]."""
    contact_mass: float = 0.0002
    """Mass that moves with the plate [kg]."""
    phalanx_mass: float = 0.005
    """Mass of the bone behind the pulp [kg]."""
    joint_stiffness: float = 500.0
    """Stiffness of the joint that holds the bone to the rest plane [N/m]."""
    joint_damping: float = 2.0
    """Damping of that joint [N s/m]."""

    def __post_init__(self) -> None:
        """Refuse values not finite or negative, no damping of the pulp, and no phalanx."""
        held = "stiffness contact_mass joint_stiffness joint_damping"
        expect_values(self, "fingertip", above="damping phalanx_mass", at_least=held)

    def dynamic_stiffness(self, omega: FloatArray | ComplexArray) -> ComplexArray:
        """Force on the plate per displacement of the contact at omega [rad/s], of its shape [N/m].

        omega can be complex, with time dependence exp(i omega t). D = -omega² m_c + Z_p Z_b / (Z_p
        + Z_b), with Z_p = k + i omega c of the pulp and Z_b = k_j + i omega c_j - omega² m_p of the
        phalanx on its joint.
        """
        w = np.asarray(omega)
        pulp = self.stiffness + 1j * w * self.damping
        phalanx = self.joint_stiffness + 1j * w * self.joint_damping - w**2 * self.phalanx_mass
        total = pulp + phalanx
        # At omega = 0, a pulp and a joint without stiffness transmit no force.
        in_series = pulp * phalanx / np.where(total == 0, 1.0, total)
        return np.asarray(in_series - w**2 * self.contact_mass)

    def scaled(self, factor: float) -> "Fingertip":
        """The fingertip with a contact larger by a factor: its pulp and contact mass scale.

        Phalanx and joint stay, and so does the ratio of damping to stiffness of the pulp.
        """
        return replace(
            self,
            stiffness=factor * self.stiffness,
            damping=factor * self.damping,
            contact_mass=factor * self.contact_mass,
        )

    def under(self, load: float) -> "Fingertip":
        """Return a finger with a load, or a patch of a hand with this load, whose mass behind is
        also larger."""
        is_finger = load <= MAX_FINGER_LOAD
        return self.scaled(load) if is_finger else self.multiplied(load / len(HAND_PATCHES))

    def multiplied(self, factor: float) -> "Fingertip":
        """The fingertip with a dynamic stiffness larger by a factor at every frequency."""
        return Fingertip(**{key: factor * value for key, value in asdict(self).items()})


OBJECT_STIFFNESS, OBJECT_DAMPING_RATIO = 1e5, 0.1
"""Assumed contact stiffness [N/m] and damping ratio of an object on the plate, such as a cup."""


def object_load(mass: float) -> Fingertip:
    """Return the load of an object of a mass [kg] on the plate: the mass on a contact spring."""
    damping = 2 * OBJECT_DAMPING_RATIO * math.sqrt(OBJECT_STIFFNESS * mass)
    return Fingertip(OBJECT_STIFFNESS, damping, 0.0, mass, 0.0, 0.0)


@dataclass(frozen=True)
class FingertipLoad:
    """A fingertip that rests on the plate at x, y [m]; it acts at a point, of foot 0."""

    x: float
    y: float
    fingertip: Fingertip
    foot: ClassVar[float] = 0.0

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """Dynamic stiffness [N/m] at omega [rad/s], of the same shape."""
        return self.fingertip.dynamic_stiffness(omega)


def check_loads(loads: Iterable[float], *, highest: float = MAX_FINGER_LOAD) -> None:
    """Raise InputError for a load, relative to a fingertip, that no finger has.

    highest: MAX_HAND_LOAD where hands may rest.
    """
    for load in loads:
        if not MIN_LOAD <= load <= highest:  # False for NaN
            raise InputError(
                f"load must be between {MIN_LOAD:g} and {highest:g} times the rig's fingertip, "
                f"got {load}"
            )


def with_patches(
    contacts: Sequence[Point], loads: Sequence[float], size: Point
) -> tuple[list[Point], list[float]]:
    """Return positions [m] and loads of contacts on a plate of a size [m], with hands as patches.

    The first patch of a hand replaces it, the others follow all contacts.
    """
    places, by = [*contacts], [*loads]
    for number, ((x, y), load) in enumerate(zip(contacts, loads, strict=True)):
        if load > MAX_FINGER_LOAD:
            wide = math.sqrt(load / HAND_LOAD)
            places[number], *patches = [
                (min(max(x + wide * a, 0.0), size[0]), min(max(y + wide * b, 0.0), size[1]))
                for a, b in HAND_PATCHES
            ]
            places += patches
            by += [load] * len(patches)
    return places, by


def fingertip_loads(
    fingertip: Fingertip | None,
    contacts: Sequence[tuple[float, float]],
    loads: Sequence[float] = (),
) -> list[FingertipLoad]:
    """Return fingertips at contacts [m]; none if they are massless.

    loads: relative to the fingertip, empty for 1 each.
    """
    if fingertip is None:
        return []
    tips = [fingertip.under(load) for load in loads] or [fingertip] * len(contacts)
    return [FingertipLoad(*at, tip) for at, tip in zip(contacts, tips, strict=True)]


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
        """Refuse values that are not finite, and loads that add energy."""
        held = "stiffness damping mass foot loss_factor"
        expect_values(self, "point load", at_least=held, finite="x y")

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
        """Its part k (1 + i eta) [N/m], of the shape of omega [rad/s]."""
        return np.asarray(self.stiffness * (1 + 1j * self.loss_factor * np.sign(omega)))


Support: TypeAlias = Source | PointLoad | FingertipLoad
"""What reacts to the plate's motion at x, y [m] on a disc of radius foot [m], 0 for a point."""


def feet_of(loads: Iterable[Support]) -> tuple[int, ...]:
    """Numbers of the loads that are feet, in their order."""
    # A diagnosis tries a fingertip among them, which is not a foot.
    return tuple(n for n, load in enumerate(loads) if getattr(load, "is_foot", False))


_Complex = TypeVar("_Complex", bound="np.complexfloating[Any, Any]")


def footprints_of(*attached: Iterable[Support]) -> FloatArray:
    """Return footprints x, y, radius [m] of attachments, one group after the other, (n, 3)."""
    places = [[source.x, source.y, source.foot] for source in chain.from_iterable(attached)]
    return np.array(places, dtype=float).reshape(-1, 3)


def attached_stiffness(omega: FloatArray, *attached: Iterable[Support]) -> ComplexArray:
    """Dynamic stiffness [N/m] at omega (f,) [rad/s], one group after the other, (f, n)."""
    stiffnesses = [source.dynamic_stiffness(omega) for source in chain.from_iterable(attached)]
    return np.array(stiffnesses, dtype=complex).reshape(-1, len(omega)).T.copy()


def drive_forces(omega: FloatArray, sources: Sequence[Source]) -> ComplexArray:
    """Force of each source at full level [N] at omega (f,) [rad/s], (f, sources)."""
    forces = [source.force(omega) for source in sources]
    return np.array(forces, dtype=complex).reshape(-1, len(omega)).T.copy()


def unit_accelerations(
    sources: Sequence[Source],
    loads: Sequence[Support],
    omega: FloatArray,
    moved: Callable[[ComplexArray, ComplexArray], ComplexArray],
) -> ComplexArray:
    """Acceleration [m/s²] of a plate by each source alone at full level, (f, sources, p).

    moved: displacement (f, sources, p) of the plate, of the dynamic stiffnesses of sources and
    loads (f, a) and the forces applied to them (f, a, sources), by omega (f,) [rad/s].
    """
    stiffness = attached_stiffness(omega, sources, loads)
    each_alone = np.eye(stiffness.shape[1], len(sources))
    applied = np.asarray(each_alone * drive_forces(omega, sources)[:, None])
    return np.asarray(-(omega**2)[:, None, None] * moved(stiffness, applied))


def coupled_forces(
    receptance: NDArray[_Complex], dynamic_stiffness: NDArray[_Complex], applied: NDArray[_Complex]
) -> NDArray[_Complex]:
    """Forces F on the free plate [N], from those applied at its attachments: (I + D R) F = P.

    receptance R (..., n, n) [m/N]: of the free plate between its attachments; dynamic_stiffness
    (..., n) [N/m]: the diagonal of D; applied P (..., n, m) [N]. An attachment reacts with -D times
    its displacement R F.
    """
    unit = np.eye(receptance.shape[-1], dtype=receptance.real.dtype)
    system = unit + dynamic_stiffness[..., None] * receptance
    return np.asarray(np.linalg.solve(system, applied))


FootKind: TypeAlias = Literal["foam", "rubber"]
"""Kinds of feet of a rig file."""

FEET: Mapping[FootKind, float] = {"foam": 2e3, "rubber": 30e3}
"""Assumed stiffness of each kind of foot [N/m], for about 2 cm; measure your own by weighing."""

FEET_DEVIATE = 0.3
"""Assumed standard deviation of the logarithm of a foot's stiffness, unless the rig states one.

Also applies to a measured static stiffness: rubber is stiffer in vibration, depending on its
compound.
"""

DEFAULT_POINTS = 7
"""Points of each edge."""

EDGE_FOOT = 1e-3
"""Radius [m] of the discs at these points."""

FOOT_LOSS = 0.15
"""Loss factor of feet of every kind: assumed."""


def edge_points(plate: Plate, count: int) -> Iterator[tuple[float, float, float]]:
    """Yield points x, y of all four edges and the length that each represents [m]; count: per
    edge."""
    nodes, weights = leggauss(count)
    for along, across, is_along_x in (
        (plate.length, plate.width, True),
        (plate.width, plate.length, False),
    ):
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            at = along * (1 + node) / 2
            for edge in (0.0, across):
                yield (*((at, edge) if is_along_x else (edge, at)), along * weight / 2)


def least_points(plate: Plate, frequency: float) -> int:
    """How many an edge must have for natural frequencies within 0.3 % up to a frequency [Hz].

    Two for each wavelength and some more: with 0.05 kg/m on 400 x 300 mm of birch plywood of 6.4 mm
    six are off by 0.33 % at 421 Hz, seven by 0.11 %.
    """
    side = max(plate.length, plate.width)
    return math.ceil(2 * side / plate.bending_wavelength(frequency) + 2.7)


# Gauss points across a disc and along each chord: enough for fields that vary over its radius.
_ACROSS, _ALONG = 10, 8

BasisT = TypeVar("BasisT", FloatArray, NDArray[np.float32], sparse.csr_array)


def as_footprints(places: FloatArray) -> FloatArray:
    """Convert footprints (n, 3) or points (n, 2) to footprints x, y, radius [m], (n, 3)."""
    places = np.atleast_2d(np.asarray(places, dtype=float))
    if places.size == 0:
        return np.empty((0, 3))
    return places if places.shape[1] == 3 else np.column_stack([places, np.zeros(len(places))])


def check_footprints_on_plate(places: FloatArray, *, length: float, width: float) -> None:
    """Check that points (n, 2) or the centers of footprints (n, 3) [m] are on the plate.

    Its edges included; raises InputError.
    """
    sides = np.array([length, width])
    tolerance = 1e-9 * sides.max()
    at = places[:, :2]
    off = ~((at >= -tolerance) & (at <= sides + tolerance)).all(axis=1)
    if off.any():
        x, y = at[np.argmax(off)]
        raise InputError(
            f"point must be on the plate, (0, 0) to ({length:g}, {width:g}) m, got ({x:g}, {y:g}) m"
        )


def mean_over(
    evaluate: Callable[[FloatArray], BasisT], places: FloatArray, *, length: float, width: float
) -> BasisT:
    """Mean of functions (p, m) over footprints (n, 3) or points (n, 2) [m] of a plate, (n, m).

    evaluate: the functions at points (p, 2).
    """
    places = np.atleast_2d(np.asarray(places, dtype=float))
    if places.shape[1] == 2 or not places[:, 2].any():
        return evaluate(places[:, :2])
    is_disc = places[:, 2] > 0
    counts = np.where(is_disc, _ACROSS * _ALONG, 1)
    ends = np.concatenate([[0], np.cumsum(counts)])
    points = np.repeat(places[:, :2], counts, axis=0)
    values = np.ones(len(points))
    on_discs = np.repeat(is_disc, counts)
    points[on_discs], values[on_discs] = _on_discs(places[is_disc], length, width)
    shape = (len(places), len(points))
    weights = sparse.csr_array((values, np.arange(len(points)), ends), shape=shape)
    mean: Any = weights @ evaluate(points)
    return mean  # type: ignore[no-any-return]


def _on_discs(discs: FloatArray, length: float, width: float) -> tuple[FloatArray, FloatArray]:
    """Gauss points (p, 2) on the parts of discs (n, 3) on the plate, and their weights (p,).

    Weights of a disc add up to 1.
    """
    across, across_weights = _gauss(_ACROSS)
    along, along_weights = _gauss(_ALONG)
    x, y, radius = discs[:, :, None].transpose(1, 0, 2)
    # x + radius sin(angle): the ends of the chords are then smooth in the angle.
    first = np.arcsin(np.clip(-x / radius, -1, 1))
    last = np.arcsin(np.clip((length - x) / radius, -1, 1))
    angles = (first + last) / 2 + (last - first) / 2 * across
    half = radius * np.cos(angles)
    low, high = np.maximum(y - half, 0.0), np.minimum(y + half, width)
    chord_y = (low + high)[..., None] / 2 + (high - low)[..., None] / 2 * along
    chord_x = np.broadcast_to((x + radius * np.sin(angles))[..., None], chord_y.shape)
    weights = (across_weights * half * (high - low))[..., None] * along_weights
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    return np.stack([chord_x, chord_y], axis=-1).reshape(-1, 2), weights.ravel()


@lru_cache(maxsize=4)
def _gauss(count: int) -> tuple[FloatArray, FloatArray]:
    return leggauss(count)


GRAVITY = 9.80665
"""Standard acceleration of gravity, g [m/s²]."""

MIN_RIGID_BODY_FREQUENCY = 1.0
"""Hz. Under its own weight a plate moves by g / omega²: 25 cm in a mode of this frequency."""


def rigid_body_frequencies(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Natural frequencies (3,) [Hz] of the rigid plate on its springs, ascending.

    Heave and two tilts: w = q' p with p = (1, x/L - 1/2, y/W - 1/2). K = sum k p p', M = plate +
    sum m p p'. A mode that no spring holds has frequency 0.
    """
    p, stiffness, mass = _attached(plate, eras, loads)
    K = (p * stiffness) @ p.T
    M = (p * mass) @ p.T + _rigid_mass_matrix(plate)
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    eigenvalues = np.linalg.eigvalsh(inverse @ K @ inverse.T)
    return np.asarray(np.sqrt(np.maximum(eigenvalues, 0.0)) / (2 * np.pi))


def _rigid_mass_matrix(plate: Plate) -> FloatArray:
    """Return the mass matrix (3, 3) [kg] of the bare rigid plate in p = (1, x/L - 1/2, y/W - 1/2).

    A surface whose modes show its moments can have its center of mass and its inertia anywhere.
    """
    moments = None if plate.surface is None else moments_of_surface(plate.surface)
    if moments is None:
        return np.diag(plate.rigid_masses)
    to_sides = np.array(
        [[1.0, 0.0, 0.0], [-0.5, 1 / plate.length, 0.0], [-0.5, 0.0, 1 / plate.width]]
    )
    return np.asarray(plate.mass * to_sides @ moments @ to_sides.T)


def static_loads(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> FloatArray:
    """Weight [N] of the rigid plate on each ERA, and then on each spring among the loads.

    An exciter whose magnet is free carries nothing: it is left out, and weighs.

    At least three springs are not in one line. K q = sum of weights p, reactions k p' q.
    """
    p, stiffness, mass = _attached(plate, eras, loads)
    x, y = center_of_mass(plate)
    plate_moments = plate.mass * np.array([1.0, x / plate.length - 0.5, y / plate.width - 0.5])
    weight = GRAVITY * (p @ mass + plate_moments)
    q = np.linalg.solve((p * stiffness) @ p.T, weight)
    return np.asarray((stiffness * (q @ p))[stiffness > 0])


def center_of_mass(plate: Plate) -> Point:
    """Return the center of mass of the bare plate [m]: its center, or a surface's, from its
    modes."""
    if plate.surface is not None:
        center = center_of_surface(plate.surface)
        if center is not None:
            return center
    return plate.length / 2, plate.width / 2


def _attached(
    plate: Plate, eras: Sequence[Source], loads: Sequence[PointLoad]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return factors p (3, n), stiffness [N/m] and mass [kg] (n,) of all attachments.

    In units of the plate's sides, so that both tilts have the size of the heave.
    """
    attached = [*(era.support for era in eras), *loads]
    mounts = [(at.x, at.y, at.stiffness, at.mass) for at in attached]
    x, y, stiffness, mass = np.array(mounts, dtype=float).reshape(-1, 4).T
    p = np.stack([np.ones_like(x), x / plate.length - 0.5, y / plate.width - 0.5])
    return p, stiffness, mass


def support_problem(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> str | None:
    """Why ERAs and loads do not support a plate, with the remedy; None if they do."""
    if plate.surface is not None and not plate.surface.rigid:
        return None  # its modes are of what holds it
    lowest = rigid_body_frequencies(plate, eras, loads=loads)[0]
    if lowest >= MIN_RIGID_BODY_FREQUENCY:
        return None
    return (
        f"the plate is not supported: its lowest rigid-body frequency must be at least "
        f"{MIN_RIGID_BODY_FREQUENCY:g} Hz, got {lowest:.2g} Hz; put at least three ERAs or "
        "supports under it, stiff enough and not in one line; a free exciter holds nothing"
    )


def check_supported(
    plate: Plate, eras: Sequence[Source], *, loads: Sequence[PointLoad] = ()
) -> None:
    """Raise InputError for a plate that its ERAs and loads do not support."""
    if (problem := support_problem(plate, eras, loads=loads)) is not None:
        raise InputError(problem)
