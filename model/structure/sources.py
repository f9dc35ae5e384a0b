"""Sources: the actuators that drive the plate and support it.

`Source` is the base class of all actuators. An ERA (`Era`) is a spring, a damper and a bolt between
the plate and a base that moves; `model.structure.exciter` contains voice coils.
"""

import cmath
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self, TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import expect_values
from model.structure.attachments import Attachment, InTime, PointLoad, attached_stiffness

Gain: TypeAlias = tuple[float, float, float]
"""Frequency [Hz], magnitude, phase [rad]."""

Factor: TypeAlias = float | FloatArray
"""Factor of a parameter, or one for each of several plates."""


@dataclass(frozen=True)
class Source(ABC):
    """An actuator with a spring and a damper between the plate and its base.

    If the spring and damper change, D changes by dD, and the force on the plate by dD times the
    motion of the base relative to the plate.
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
    def support(self) -> PointLoad:
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
        """Force [N] at full level on a plate at rest, at omega [rad/s], of its shape."""

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """D [N/m] at omega [rad/s], of its shape."""
        return self.deviating(omega, 1.0, 1.0)[0]

    @abstractmethod
    def deviating(
        self, omega: FloatArray, stiffness: Factor, damping: Factor
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return D [N/m], and force per drive without gain, with stiffness and damping scaled.

        stiffness, damping: factors; all arguments broadcast.
        """

    @abstractmethod
    def base(self, omega: FloatArray) -> ComplexArray:
        """Motion of its base at full level [m] at omega [rad/s], its own gain included."""

    def varied(self, *, stiffness: float = 1.0, damping: float = 1.0) -> Self:
        """Multiply its stiffness and damping by factors."""
        return replace(self, stiffness=stiffness * self.stiffness, damping=damping * self.damping)

    @abstractmethod
    def loosened(self, share: float) -> Self:
        """Return the source with only a share of its contact to the plate."""

    @property
    @abstractmethod
    def fields(self) -> Mapping[str, str]:
        """Its fields that an identification may change, by the kind of parameter."""

    @abstractmethod
    def slopes(self, omega: FloatArray) -> Mapping[str, tuple[ComplexArray, ComplexArray]]:
        """Derivatives of D [N/m] and of the force [N] by kind of parameter, each as omega.

        By damping [N s/m] and bolt_mass [kg]; by the logarithm of all other parameters.
        """


@dataclass(frozen=True)
class Era(Source):
    """One ERA under the plate; its base moves y(t) = amplitude sin(omega t + phase).

    The spring has the stiffness k_b, the damper c. An ERA that is not driven still supports and
    damps the plate.
    """

    UNIT: ClassVar[str] = "m"

    bolt_mass: float
    """Mass m_b that moves with the plate [kg]."""

    stroke: float
    """The largest base amplitude [m]."""

    def __post_init__(self) -> None:
        """Reject values out of range."""
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
    def support(self) -> PointLoad:
        """The ERA with its base at rest, as a load of the plate."""
        return PointLoad(self.x, self.y, self.stiffness, self.damping, self.bolt_mass, self.foot)

    @property
    def in_time(self) -> InTime:
        """Its equations in time; the motion of the base is prescribed."""
        k = self.stiffness
        c = self.damping
        return InTime(self.bolt_mass, k, c, by_drive=k, by_rate=c)

    def deviating(
        self, omega: FloatArray, stiffness: Factor, damping: Factor
    ) -> tuple[ComplexArray, ComplexArray]:
        """D = k_b + i omega c - omega² m_b, and k_b + i omega c [N/m], by factors of k_b and c."""
        spring = stiffness * self.stiffness + 1j * omega * (damping * self.damping)
        return np.asarray(spring - omega**2 * self.bolt_mass), np.asarray(spring)

    def base(self, omega: FloatArray) -> ComplexArray:
        """Amplitude of the base at full stroke [m] at omega [rad/s], its own gain included."""
        return self.stroke * self.gain(omega / (2 * np.pi))

    def force(self, omega: FloatArray) -> ComplexArray:
        """Force (k_b + i omega c) times the base's motion at full stroke [N] (paper Eq. 25)."""
        return (self.stiffness + 1j * omega * self.damping) * self.base(omega)

    def loosened(self, share: float) -> Self:
        """Return the ERA with a share of its stiffness, and of its damping if that is below 1."""
        return self.varied(stiffness=share, damping=min(share, 1.0))

    @property
    def fields(self) -> Mapping[str, str]:
        """Its spring, damper and bolt."""
        return {kind: kind for kind in ("stiffness", "damping", "bolt_mass")}

    def slopes(self, omega: FloatArray) -> Mapping[str, tuple[ComplexArray, ComplexArray]]:
        """Derivatives of D and of the force; spring and damper pass on the motion of the base."""
        w = np.asarray(omega)
        base = self.base(w)
        by_stiffness = np.full(w.shape, self.stiffness, dtype=complex)
        by_damping = 1j * w
        by_mass = -(w**2) + 0j
        return {
            "stiffness": (by_stiffness, np.asarray(by_stiffness * base)),
            "damping": (by_damping, np.asarray(by_damping * base)),
            "bolt_mass": (by_mass, np.zeros(w.shape, dtype=complex)),
        }


def damping_from_ratio(
    ratio: float, *, stiffness: float, plate_mass: float, era_count: int
) -> float:
    """Damping c = 2 zeta sqrt(k_b m_plate / n_eras) [N s/m], referred to the plate's mass."""
    return 2 * ratio * math.sqrt(stiffness * plate_mass / era_count)


def drive_forces(omega: FloatArray, sources: Sequence[Source]) -> ComplexArray:
    """Force of each source at full level [N] at omega (f,) [rad/s], (f, sources)."""
    forces = [source.force(omega) for source in sources]
    return np.array(forces, dtype=complex).reshape(-1, len(omega)).T.copy()


def unit_accelerations(
    sources: Sequence[Source],
    loads: Sequence[Attachment],
    omega: FloatArray,
    moved: Callable[[ComplexArray, ComplexArray], ComplexArray],
) -> ComplexArray:
    """Acceleration [m/s²] of a plate by each source alone at full level, (f, sources, p).

    moved: function that returns the displacement (f, sources, p) of the plate, from the dynamic
    stiffnesses of sources and loads (f, a) and the forces applied to them (f, a, sources), at omega
    (f,) [rad/s].
    """
    stiffness = attached_stiffness(omega, sources, loads)
    each_alone = np.eye(stiffness.shape[1], len(sources))
    applied = each_alone * drive_forces(omega, sources)[:, None]
    return -(omega**2)[:, None, None] * moved(stiffness, applied)
