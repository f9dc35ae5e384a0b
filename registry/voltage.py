"""The way from an amplifier's voltage to the motion of an ERA's base, which a rig file states.

The force of an actuator follows its drive term: the voltage (linear law), or the voltage squared
(quadratic law, electrostatic). Its response turns that into motion:

    u(t)   voltage, a share of the full one, bias included
    d(t)   u (linear) or u squared (quadratic)
    y      = response(f) * d for a sinusoidal part of d at f, in full strokes
"""

import cmath
import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import TypeAlias

Response: TypeAlias = tuple[tuple[float, float, float], ...]
"""Rows of frequency [Hz], magnitude, phase [rad]; by ascending frequency."""


class Law(StrEnum):
    """How the force of an actuator follows its voltage."""

    LINEAR = "linear"
    QUADRATIC = "quadratic"


@dataclass(frozen=True)
class VoltageDrive:
    """One ERA behind an amplifier of voltage.

    response: full strokes of its base by a sinusoidal drive term of amplitude 1. bias, maximum: the
    constant part of the voltage, and its highest peak with it, as shares of the full voltage;
    bias only with the quadratic law. frequencies [Hz]: the lowest and highest that are played.
    """

    response: Response
    law: Law = Law.LINEAR
    bias: float = 0.0
    maximum: float = 1.0
    frequencies: tuple[float, float] = (40.0, 500.0)

    @property
    def is_halved(self) -> bool:
        """Whether the voltage has half the frequency of the motion: quadratic without bias."""
        return self.law is Law.QUADRATIC and self.bias == 0

    @property
    def swing(self) -> float:
        """Highest amplitude of the voltage about its bias."""
        return self.maximum - self.bias

    def at(self, frequency: float) -> complex:
        """Response at a frequency [Hz]; linear between rows, constant outside.

        At negative frequencies, as in the lower sideband of a fast ramp, the conjugate.
        """
        rows = self.response
        requested = abs(frequency)
        after = bisect_right(rows, requested, key=lambda row: row[0])
        low, high = rows[max(after - 1, 0)], rows[min(after, len(rows) - 1)]
        found = cmath.rect(*low[1:])
        if low[0] < requested < high[0]:
            part = (requested - low[0]) / (high[0] - low[0])
            found += part * (cmath.rect(*high[1:]) - found)
        return found.conjugate() if frequency < 0 else found

    def drive_amplitude(self, voltage: float) -> float:
        """Amplitude of the drive term at the frequency of motion by that of the voltage."""
        if self.law is Law.LINEAR:
            return voltage
        return voltage**2 / 2 if self.is_halved else 2 * self.bias * voltage

    def voltage_amplitude(self, drive: float) -> float:
        """Amplitude of the voltage by that of the drive term; inverse of `drive_amplitude`."""
        if self.law is Law.LINEAR:
            return drive
        return math.sqrt(2 * drive) if self.is_halved else drive / (2 * self.bias)

    def reach(self) -> tuple[float, float]:
        """Lowest and highest level, over the played frequencies, at the highest voltage."""
        low, high = self.frequencies
        rows = [
            self.at(low),
            *(cmath.rect(size, phase) for f, size, phase in self.response if low < f < high),
            self.at(high),
        ]
        full = self.drive_amplitude(self.swing)
        return full * _least_modulus(rows), full * max(map(abs, rows))


def _least_modulus(path: Iterable[complex]) -> float:
    """Least modulus on the straight lines between successive points."""
    least = math.inf
    for one, other in pairwise(path):
        step = other - one
        length = abs(step) ** 2
        part = min(max(-(one * step.conjugate()).real / length, 0.0), 1.0) if length else 0.0
        least = min(least, abs(one + part * step))
    return least
