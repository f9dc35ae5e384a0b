"""Buzz: a steady vibration, as long as the finger stays or for a duration."""

from typing import Annotated, ClassVar

from controller.effects.effect import (
    MAX_DURATION,
    MIN_DURATION,
    Effect,
    EffectRun,
    Modulation,
    SteadyRun,
)
from controller.play.intent import Pulse
from controller.sources.contacts import Contact
from model.config.fields import TIME, Quantity


class Buzz(Effect):
    """As long as the finger stays, or for a duration."""

    kind: ClassVar[str] = "buzz"
    is_for_motion: ClassVar[bool] = False
    needs_entry: ClassVar[bool] = False

    duration: (
        Annotated[float, Quantity(TIME, at_least=MIN_DURATION, at_most=MAX_DURATION)] | None
    ) = None
    """None: as long as the finger stays."""

    modulation: Modulation = None
    """How often a second it comes and goes; none: steady."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start a steady vibration."""
        pulse = None if self.duration is None else Pulse(self.duration, now)
        return SteadyRun(level_db_sl, pulse, self.modulation)

    @property
    def has_end(self) -> bool:
        """True with a duration."""
        return self.duration is not None
