"""What drives the plate, in physics: a tone per active ERA."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

GAIN_ERROR = 0.05
"""Standard deviation of what an ERA does against what it was told, relative."""

PHASE_ERROR = math.radians(5)
"""The same for its phase [rad]."""


@dataclass(frozen=True)
class Tone:
    """One frequency [Hz], base amplitude a [m] and phase [rad]: y(t) = a sin(2 pi f t + phase)."""

    frequency: float
    amplitude: float
    phase: float = 0.0


Excitation: TypeAlias = Mapping[str, Tone]
"""A tone per active ERA, by the ERA's name; an ERA that is not named is still."""
