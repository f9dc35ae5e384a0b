"""A run of an effect at one level, for a while or as long as the finger stays."""

from dataclasses import dataclass

from controller.effects.effect import EffectRun, NoSensation, Sensation
from controller.loop.intent import Pulse
from controller.sources.contacts import Contact

MIN_DURATION = 0.020
"""The plate needs about 20 ms to respond (docs/concepts/transients.md); less is not felt [s]."""

MAX_DURATION = 10.0


@dataclass(frozen=True)
class SteadyRun(EffectRun):
    """A level for one pulse, None for as long as the finger stays."""

    level_db_sl: float | None
    pulse: Pulse | None

    def feel(self, contact: Contact, now: float) -> Sensation | NoSensation | None:
        """Return the level until the end of the pulse."""
        if self.pulse is None:
            return Sensation(self.level_db_sl)
        if now >= self.pulse.end:
            return None
        return Sensation(self.level_db_sl, until=self.pulse.end, pulse=self.pulse)
