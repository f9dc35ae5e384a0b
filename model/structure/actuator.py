"""The electrostatic resonant actuator (ERA): spring, damper and bolt between plate and base."""

import cmath
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError

Gain: TypeAlias = tuple[float, float, float]
"""Frequency [Hz], magnitude, phase [rad]."""


@dataclass(frozen=True)
class Era:
    """One ERA under the plate; its base moves y(t) = amplitude sin(omega t + phase).

    x, y: position of its bolt [m]; stiffness k_b [N/m]; damping c [N s/m]; bolt_mass m_b [kg];
    stroke: the largest base amplitude [m]; foot [m]: radius of the disc on which it acts, 0 for a
    point. An ERA that is not driven still supports and damps.
    gains: measured complex gain of its base, at ascending frequencies; empty for a gain of 1.
    """

    name: str
    x: float
    y: float
    stiffness: float
    damping: float
    bolt_mass: float
    stroke: float
    gains: tuple[Gain, ...] = ()
    foot: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        for key in ("x", "y", "stiffness", "damping", "bolt_mass", "stroke", "foot"):
            if not math.isfinite(getattr(self, key)):
                raise InputError(f"ERA {self.name}: {key} must be finite, got {getattr(self, key)}")
        for key in ("stiffness", "stroke"):
            if getattr(self, key) <= 0:
                raise InputError(
                    f"ERA {self.name}: {key} must be above zero, got {getattr(self, key)}"
                )
        for key in ("damping", "bolt_mass", "foot"):
            if getattr(self, key) < 0:
                raise InputError(
                    f"ERA {self.name}: {key} must not be negative, got {getattr(self, key)}"
                )
        # A file gives lists; only tuples can be compared and hashed with the rest.
        gains = tuple((float(f), float(size), float(phase)) for f, size, phase in self.gains)
        object.__setattr__(self, "gains", gains)
        for frequency, size, phase in gains:
            if not (math.isfinite(frequency + size + phase) and frequency > 0 and size > 0):
                raise InputError(
                    f"ERA {self.name}: gains must be finite and above zero, got {size} with phase "
                    f"{phase} at {frequency} Hz"
                )
        for (low, *_), (high, *_) in pairwise(gains):
            if low >= high:
                raise InputError(
                    f"ERA {self.name}: frequencies of gains must ascend, got {high} Hz after "
                    f"{low} Hz"
                )

    def gain(self, frequencies: FloatArray) -> ComplexArray:
        """Complex gain at frequencies [Hz], of their shape; 1 without measured gains.

        Linear between measured frequencies, constant outside. At negative frequencies, as in the
        lower sideband of a fast ramp, the conjugate: the base's motion is real.
        """
        if not self.gains:
            return np.ones(np.shape(frequencies), dtype=complex)
        measured = [frequency for frequency, _, _ in self.gains]
        values = np.array([cmath.rect(size, phase) for _, size, phase in self.gains])
        found = np.interp(np.abs(frequencies), measured, values)
        return np.asarray(np.where(np.asarray(frequencies) < 0, found.conj(), found))


def damping_from_ratio(
    ratio: float, *, stiffness: float, plate_mass: float, era_count: int
) -> float:
    """Damping c = 2 zeta sqrt(k_b m_plate / n_eras) [N s/m], referred to the plate's mass."""
    return 2 * ratio * math.sqrt(stiffness * plate_mass / era_count)
