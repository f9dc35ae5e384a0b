"""Detents: a click at equal distances along the way of the finger."""

import math
from typing import Annotated, ClassVar, Literal

from controller.effects.effect import Effect, EffectRun, NoSensation, Sensation
from controller.effects.steady import MIN_DURATION
from controller.loop.intent import Pulse
from controller.sources.contacts import Contact
from model.config.sections import Quantity
from model.config.units import LENGTH, TIME

# A finger has passed a detent once it is this far [m] beyond it.
_HYSTERESIS = 0.0005


class Detents(Effect):
    """A click at each of the detents that lie `spacing` apart along x or y of the plate.

    The finger comes down halfway between two of them.
    """

    kind: ClassVar[str] = "detents"
    is_for_motion: ClassVar[bool] = True

    spacing: Annotated[float, Quantity(LENGTH, at_least=0.002, at_most=0.2)] = 0.010
    along: Literal["x", "y"] = "x"
    duration: Annotated[float, Quantity(TIME, at_least=MIN_DURATION, at_most=0.2)] = 0.030

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start halfway between two detents."""
        return _DetentsRun(self, self.position(contact), level_db_sl)

    def position(self, contact: Contact) -> float:
        """Return the position [m] of a finger along the detents."""
        return contact.x if self.along == "x" else contact.y


class _DetentsRun(EffectRun):
    """Follows the position of one finger between detents."""

    def __init__(self, detents: Detents, start: float, level_db_sl: float | None) -> None:
        self._detents = detents
        self._middle = start  # of the two detents around the finger
        self._level = level_db_sl
        self._pulse: Pulse | None = None  # of the last detent

    def feel(self, contact: Contact, now: float) -> Sensation | NoSensation | None:
        """Return a click from each passing on; several passed at once are one click."""
        spacing = self._detents.spacing
        away = self._detents.position(contact) - self._middle
        passed = math.floor((abs(away) - _HYSTERESIS) / spacing + 0.5)
        if passed > 0:
            self._middle += math.copysign(passed * spacing, away)
            self._pulse = Pulse(self._detents.duration, now)
        if self._pulse is not None and now < self._pulse.end:
            return Sensation(self._level, until=self._pulse.end, pulse=self._pulse)
        return NoSensation()
