"""Thermal model of a simulated amplifier: first order, driven by the settled levels."""

import math
from dataclasses import dataclass

AMBIENT = 25.0  # °C
RISE = 30.0  # K above ambient in the steady state at full stroke on every channel
TIME_CONSTANT = 120.0  # s
DERATE_ABOVE = 70.0  # °C
FAULT_ABOVE = 85.0  # °C
GOOD_BELOW = 65.0  # °C; faults can be cleared, and derating ends
DERATED = 0.5  # of the level


@dataclass(frozen=True, slots=True)
class ThermalState:
    """Temperature [°C], exponential from its value at `since` [s] to `final`."""

    since: float
    temperature: float = AMBIENT
    final: float = AMBIENT

    def at(self, time: float) -> float:
        """Temperature [°C] at a time [s] not before since."""
        left = math.exp((self.since - time) / TIME_CONSTANT)
        return self.final + (self.temperature - self.final) * left

    def when(self, threshold: float) -> float:
        """Time [s] at which a threshold [°C] is crossed; infinity for never."""
        before, after = self.temperature - threshold, self.final - threshold
        if before * after >= 0:
            return math.inf
        return self.since + TIME_CONSTANT * math.log((before - after) / -after)

    def driven(self, time: float, *, load: float) -> "ThermalState":
        """The state from a time [s], with the mean square level of all channels as load."""
        return ThermalState(time, self.at(time), AMBIENT + RISE * load)
