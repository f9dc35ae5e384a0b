"""Temperature of a simulated amplifier, which its load heats, and the thresholds that it obeys."""

import math
from dataclasses import dataclass

AMBIENT = 25.0  # °C
_RISE = 30.0  # K above ambient in the steady state at full stroke on every channel
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
        decay = math.exp((self.since - time) / TIME_CONSTANT)
        return self.final + (self.temperature - self.final) * decay

    def when(self, threshold: float) -> float:
        """Time [s] at which the temperature rises to a threshold [°C]; infinity for never."""
        excess_at_start = self.temperature - threshold
        excess_at_end = self.final - threshold
        is_crossed = excess_at_start < 0 < excess_at_end
        if not is_crossed:
            return math.inf
        ratio = (excess_at_start - excess_at_end) / -excess_at_end
        return self.since + TIME_CONSTANT * math.log(ratio)

    def driven(self, time: float, *, load: float) -> "ThermalState":
        """The state from a time [s], with the mean square level of all channels as load."""
        return ThermalState(time, self.at(time), AMBIENT + _RISE * load)
