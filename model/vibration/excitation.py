"""Physical excitation of the plate: a tone per active ERA."""

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np

from model.arrays import ComplexArray
from model.rig.uncertainty import Uncertainty


def random_gains(
    rng: np.random.Generator, uncertainty: Uncertainty, *, draws: int, eras: int
) -> ComplexArray:
    """Draw complex gains of ERAs, normal in size and phase, (draws, eras)."""
    gain = 1 + uncertainty.gain * rng.standard_normal((draws, eras))
    phase = math.radians(uncertainty.phase_deg) * rng.standard_normal((draws, eras))
    return np.asarray(gain * np.exp(1j * phase))


@dataclass(frozen=True)
class Tone:
    """One frequency [Hz], base amplitude a [m] and phase [rad]: y(t) = a sin(2 pi f t + phase)."""

    frequency: float
    amplitude: float
    phase: float = 0.0

    @classmethod
    def from_phasor(cls, frequency: float, phasor: complex) -> Self:
        """Make the tone of a phasor [m] at a frequency [Hz]."""
        return cls(frequency, abs(phasor), cmath.phase(phasor))

    @property
    def phasor(self) -> complex:
        """Complex amplitude a exp(i phase) [m]: y(t) = Im[phasor exp(2 pi i f t)]."""
        return cmath.rect(self.amplitude, self.phase)


Excitation: TypeAlias = Mapping[str, Tone]
"""A tone per active ERA, by the ERA's name; an ERA that is not named is still."""
