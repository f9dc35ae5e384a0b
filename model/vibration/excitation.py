"""What drives the plate, in physics: a tone per active ERA."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True)
class Tone:
    """One frequency [Hz], base amplitude a [m] and phase [rad]: y(t) = a sin(2 pi f t + phase)."""

    frequency: float
    amplitude: float
    phase: float = 0.0


Excitation: TypeAlias = Mapping[str, Tone]
"""A tone per active ERA, by the ERA's name; an ERA that is not named is still."""
