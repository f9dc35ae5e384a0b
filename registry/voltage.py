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

HIGHEST_FELT = 1000.0
"""Hz; the end of the detection thresholds, beyond which no harmonic counts."""


class Law(StrEnum):
    """How the force of an actuator follows its voltage."""

    LINEAR = "linear"
    QUADRATIC = "quadratic"


@dataclass(frozen=True)
class VoltageDrive:
    """One ERA behind an amplifier of voltage.

    response: full strokes of its base by a sinusoidal drive term of amplitude 1; static: by a
    constant one of 1, None where unknown. bias, maximum: the constant part of the voltage, and its
    highest peak with it, as shares of the full voltage; minimum: its lowest with a bias; without
    one the supply is bipolar. bias, static: only with the quadratic law. frequencies [Hz]: the
    lowest and highest that are played.
    """

    response: Response
    law: Law = Law.LINEAR
    bias: float = 0.0
    maximum: float = 1.0
    frequencies: tuple[float, float] = (40.0, 500.0)
    minimum: float = 0.0
    static: float | None = None

    @property
    def is_halved(self) -> bool:
        """Whether the voltage has half the frequency of the motion: quadratic without bias."""
        return self.law is Law.QUADRATIC and self.bias == 0

    @property
    def swing(self) -> float:
        """Highest amplitude of the voltage about its bias."""
        if not self.bias:
            return self.maximum
        return min(self.maximum - self.bias, self.bias - self.minimum)

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

    def second_harmonic(self, level: complex, frequency: float) -> complex:
        """Motion at twice the frequency [Hz] beside a tone of a complex level, with a bias.

        (b + U sin wt)^2 has U^2 / 2 sin(2 wt - 90 degrees), with U = level / (2 b response).
        """
        voltage = level / (2 * self.bias * self.at(frequency))
        return -0.5j * voltage**2 * self.at(2 * frequency)

    def reach(self) -> tuple[float, float]:
        """Lowest and highest level, over the played frequencies, at the highest voltage."""
        full = self.drive_amplitude(self.swing)
        least, greatest = self._moduli()
        return full * least, full * greatest

    def level_max(self) -> float:
        """Highest level at every played frequency, by the voltage, and by the stroke if known.

        The square of the voltage has a constant part, which deflects the base; deflection and tone,
        the harmonic of a bias left out, stay within a full stroke.
        """
        reached, _ = self.reach()
        if self.static is None or self.law is Law.LINEAR or not reached:
            return reached
        least, _ = self._moduli()
        if self.is_halved:
            return min(reached, least / (least + self.static))
        # level + static (bias^2 + U^2 / 2) = 1 with U = level / (2 bias least)
        room = max(1 - self.static * self.bias**2, 0.0)
        curvature = self.static / (8 * (self.bias * least) ** 2)
        return min(reached, 2 * room / (1 + math.sqrt(1 + 4 * curvature * room)))

    def constant_term(self, level: float) -> float:
        """Mean of the squared voltage at a level, where the response is least."""
        least, _ = self._moduli()
        return self.bias**2 + self.voltage_amplitude(level / least) ** 2 / 2

    def _moduli(self) -> tuple[float, float]:
        """Least and greatest modulus of the response, over the played frequencies."""
        low, high = self.frequencies
        rows = [
            self.at(low),
            *(cmath.rect(size, phase) for f, size, phase in self.response if low < f < high),
            self.at(high),
        ]
        return _least_modulus(rows), max(map(abs, rows))


def _least_modulus(path: Iterable[complex]) -> float:
    """Least modulus on the straight lines between successive points."""
    least = math.inf
    for one, other in pairwise(path):
        step = other - one
        length = abs(step) ** 2
        part = min(max(-(one * step.conjugate()).real / length, 0.0), 1.0) if length else 0.0
        least = min(least, abs(one + part * step))
    return least
