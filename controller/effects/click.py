"""Click: one short vibration."""

from typing import Annotated, ClassVar

from controller.effects.effect import MIN_DURATION, Effect, EffectRun, SteadyRun
from controller.play.intent import Pulse
from controller.sources.contacts import Contact
from model.config.fields import TIME, Quantity


class Click(Effect):
    """One short vibration."""

    kind: ClassVar[str] = "click"
    is_for_motion: ClassVar[bool] = False
    needs_entry: ClassVar[bool] = False

    duration: Annotated[float, Quantity(TIME, at_least=MIN_DURATION, at_most=0.5)] = 0.040
    """The plate needs 20 ms to follow."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start a vibration of its duration."""
        return SteadyRun(level_db_sl, Pulse(self.duration, now))
