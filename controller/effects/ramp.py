"""Ramp: a level that rises or falls in steps."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from controller.effects.effect import (
    DB_SL,
    MAX_DURATION,
    MIN_DURATION,
    Effect,
    EffectRun,
    EffectStimulus,
    NoStimulus,
)
from controller.play.intent import Pulse
from controller.sources.contacts import Contact
from model.config.fields import TIME, Quantity
from model.finger import STRONG_DB_SL

RAMP_STEP_DB = 2.0
"""Step between levels of a ramp [dB], below the just noticeable difference."""


class Ramp(Effect):
    """From one level to another in steps of 2 dB; then over, or held at the last."""

    kind: ClassVar[str] = "ramp"
    is_for_motion: ClassVar[bool] = False

    start_level: Annotated[float, DB_SL] = 6.0
    """First level, in dB SL; the last is `level`."""

    duration: Annotated[float, Quantity(TIME, at_least=0.1, at_most=MAX_DURATION)] = 1.0
    """From the first level to the last."""

    hold: bool = False
    """Whether it holds the last level."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at the first level, in steps of 2 dB, or larger ones where these are too short."""
        end = STRONG_DB_SL if level_db_sl is None else level_db_sl
        span = end - self.start_level
        count = max(1, min(round(abs(span) / RAMP_STEP_DB), int(self.duration / MIN_DURATION) - 1))
        rise = [self.start_level + span * index / count for index in range(count)]
        levels = (*rise, level_db_sl)
        pulse = Pulse(self.duration, now, is_raised=False)
        return _RampRun(pulse, levels, self.duration / len(levels), self.hold)

    @property
    def has_end(self) -> bool:
        """True unless it holds its last level."""
        return not self.hold

    def max_db_sl(self, level_db_sl: float | None) -> float:
        """Return the higher of the first and the last level."""
        return max(self.start_level, super().max_db_sl(level_db_sl))


@dataclass(frozen=True)
class _RampRun(EffectRun):
    """Levels [dB SL] for equal steps of time [s] from the start; the last one may be held."""

    pulse: Pulse
    levels: tuple[float | None, ...]
    step: float
    is_held: bool

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the level of the current step."""
        index = max(0, int((now - self.pulse.start) / self.step))
        if index >= len(self.levels) - 1 and self.is_held:
            return EffectStimulus(self.levels[-1])
        if index >= len(self.levels):
            return None
        until = self.pulse.start + (index + 1) * self.step
        pulse = None if self.is_held else self.pulse
        return EffectStimulus(self.levels[index], until, pulse=pulse)
