"""What is attached to the plate at points: passive loads, dynamic stiffness, and the plate on it.

The plate on its attachments is a low-rank correction of the free plate (Woodbury identity).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.actuator import Era
from model.structure.fingertip import FingertipLoad


@dataclass(frozen=True)
class PointLoad:
    """A spring [N/m] and a damper [N s/m] to the ground, and a mass [kg], at x, y [m].

    foot [m]: radius of the disc on which it acts, 0 for a point. It follows the mean deflection;
    its rotary inertia is not modelled.
    """

    x: float
    y: float
    stiffness: float = 0.0
    damping: float = 0.0
    mass: float = 0.0
    foot: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that are not finite, and loads that add energy."""
        for key in ("x", "y", "stiffness", "damping", "mass", "foot"):
            value = getattr(self, key)
            if not math.isfinite(value):
                raise InputError(f"point load: {key} must be finite, got {value}")
            if key not in ("x", "y") and value < 0:
                raise InputError(f"point load: {key} must not be negative, got {value}")

    @property
    def numbers(self) -> dict[str, float]:
        """Its values by name, without stiffness and damping where both are zero."""
        mass = {"x": self.x, "y": self.y, "mass": self.mass, "foot": self.foot}
        mount = {"stiffness": self.stiffness, "damping": self.damping}
        return mass | mount if any(mount.values()) else mass

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """D = k + i omega c - omega² m [N/m], of the shape of omega [rad/s]."""
        return np.asarray(self.stiffness + 1j * omega * self.damping - omega**2 * self.mass)

    @classmethod
    def of_era(cls, era: Era) -> "PointLoad":
        """An ERA at rest, as a load of the plate."""
        return cls(era.x, era.y, era.stiffness, era.damping, era.bolt_mass, era.foot)


Load: TypeAlias = PointLoad | FingertipLoad
"""A passive load of the plate."""


def footprints_of(*attached: Iterable[Era | Load]) -> FloatArray:
    """Footprints x, y, radius [m] of ERAs and loads, one group after the other, (n, 3)."""
    places = [[each.x, each.y, each.foot] for group in attached for each in group]
    return np.array(places, dtype=float).reshape(-1, 3)


def dynamic_stiffness(
    stiffness: FloatArray | float,
    damping: FloatArray | float,
    mass: FloatArray | float,
    omega: FloatArray | float,
) -> ComplexArray:
    """D = k + i omega c - omega² m [N/m]; the arguments broadcast against each other."""
    k, c, m, w = (np.asarray(value, dtype=float) for value in (stiffness, damping, mass, omega))
    return np.asarray(k + 1j * w * c - w**2 * m)


def attached_stiffness(
    eras: Sequence[Era], loads: Sequence[Load], omega: FloatArray
) -> ComplexArray:
    """Dynamic stiffness [N/m] of ERAs and loads at omega (f,) [rad/s], (f, eras + loads)."""
    parameters = [(era.stiffness, era.damping, era.bolt_mass) for era in eras]
    stiffness, damping, mass = np.array(parameters, dtype=float).reshape(-1, 3).T
    at_eras = dynamic_stiffness(stiffness, damping, mass, omega[:, None])
    return np.column_stack([at_eras, *(load.dynamic_stiffness(omega) for load in loads)])


def base_stiffness(eras: Sequence[Era], omega: FloatArray) -> ComplexArray:
    """Force on the plate per displacement of an ERA's base, k_b + i omega c [N/m], (f, eras)."""
    stiffness = np.array([era.stiffness for era in eras], dtype=float)
    damping = np.array([era.damping for era in eras], dtype=float)
    return dynamic_stiffness(stiffness, damping, 0.0, omega[:, None])


def drive_forces(eras: Sequence[Era], omega: FloatArray) -> ComplexArray:
    """Force of each ERA at full stroke, its own gain included [N], (f, eras) (paper Eq. 25)."""
    return np.asarray(base_stiffness(eras, omega) * full_strokes(eras, omega))


def full_strokes(eras: Sequence[Era], omega: FloatArray) -> ComplexArray:
    """Amplitude of each ERA's base at full stroke, its own gain included [m], (f, eras)."""
    strokes = np.array([era.stroke for era in eras])
    gains = np.array([era.gain(omega / (2 * np.pi)) for era in eras], dtype=complex)
    return np.asarray(strokes * gains.reshape(len(eras), len(omega)).T)


def coupled_forces(
    receptance: ComplexArray, dynamic_stiffness: ComplexArray, applied: ComplexArray
) -> ComplexArray:
    """Forces F on the free plate [N], from those applied at its attachments: (I + D R) F = P.

    receptance R (..., n, n) [m/N]: of the free plate between its attachments; dynamic_stiffness
    (..., n) [N/m]: the diagonal of D; applied P (..., n, m) [N]. An attachment reacts with -D times
    its displacement R F.
    """
    system = np.eye(receptance.shape[-1]) + dynamic_stiffness[..., None] * receptance
    return np.asarray(np.linalg.solve(system, applied))


def on_diagonal(values: ComplexArray, *, rows: int) -> ComplexArray:
    """One column for each value (..., m): zero but for the value in its own row, (..., rows, m)."""
    return np.asarray(np.eye(rows, values.shape[-1]) * values[..., None, :])
