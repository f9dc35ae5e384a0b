"""How warm a simulated amplifier is: first order, driven by what its channels play.

Not modelled: how the heat follows a fade (it counts what the channels settle at).
"""

import math
from dataclasses import dataclass

AMBIENT = 25.0  # °C
RISE = 30.0  # K above ambient after long at full stroke on every channel
TIME_CONSTANT = 120.0  # s
DERATE_ABOVE = 70.0  # °C; then only half of the level is played
FAULT_ABOVE = 85.0  # °C
GOOD_BELOW = 65.0  # °C; the cause of the fault is gone, and full levels are played again
DERATED = 0.5  # of the level


@dataclass(frozen=True, slots=True)
class Heat:
    """Temperature [°C] that goes from its value at `since` [s] towards `final`, exponentially."""

    since: float
    temperature: float = AMBIENT
    final: float = AMBIENT

    def at(self, time: float) -> float:
        """Temperature [°C] at a time [s] not before since."""
        left = math.exp((self.since - time) / TIME_CONSTANT)
        return self.final + (self.temperature - self.final) * left

    def when(self, threshold: float) -> float:
        """When [s] a threshold [°C] is crossed, either way; infinity for never."""
        before, after = self.temperature - threshold, self.final - threshold
        if before * after >= 0:
            return math.inf
        return self.since + TIME_CONSTANT * math.log((before - after) / -after)

    def driven(self, time: float, *, load: float) -> "Heat":
        """From a time [s] on, with the mean square level of all channels as load."""
        return Heat(time, self.at(time), AMBIENT + RISE * load)
