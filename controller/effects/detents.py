"""Detents: a click at equal distances along the way of the finger."""

import math
from typing import Annotated, ClassVar, Literal

from controller.effects.effect import MIN_DURATION, Effect, EffectRun, EffectStimulus, NoStimulus
from controller.play.intent import Pulse
from controller.sources.contacts import Contact
from model.config.fields import LENGTH, TIME, Quantity

# A finger has passed a detent once it is this far [m] beyond it.
_HYSTERESIS = 0.0005


class Notches:
    """Clicks of a duration [s] at equal distances along a coordinate of one finger.

    It starts halfway between two of them. hysteresis: how far beyond one the finger has passed it.
    """

    def __init__(
        self,
        start: float,
        *,
        spacing: float,
        hysteresis: float,
        duration: float,
        level_db_sl: float | None,
    ) -> None:
        self._middle = start  # of the two notches around the finger
        self._spacing = spacing
        self._hysteresis = hysteresis
        self._duration = duration
        self._level = level_db_sl
        self._pulse: Pulse | None = None  # of the last notch

    def at(self, coordinate: float, now: float) -> EffectStimulus | NoStimulus:
        """Return a click from each passing on; several passed at once are one click."""
        away = coordinate - self._middle
        passed = math.floor((abs(away) - self._hysteresis) / self._spacing + 0.5)
        if passed > 0:
            self._middle += math.copysign(passed * self._spacing, away)
            self._pulse = Pulse(self._duration, now)
        return self.resting(now)

    def resting(self, now: float) -> EffectStimulus | NoStimulus:
        """Return the rest of the last click, without a further notch."""
        if self._pulse is not None and now < self._pulse.end:
            return EffectStimulus(self._level, until=self._pulse.end, pulse=self._pulse)
        return NoStimulus()


class Detents(Effect):
    """A click at each detent that the finger passes along x or y.

    The finger comes down halfway between two of them.
    """

    kind: ClassVar[str] = "detents"
    is_for_motion: ClassVar[bool] = True

    spacing: Annotated[float, Quantity(LENGTH, at_least=0.002, at_most=0.2)] = 0.010
    """Distance between detents."""

    along: Literal["x", "y"] = "x"
    """Direction in which they are spaced."""

    duration: Annotated[float, Quantity(TIME, at_least=MIN_DURATION, at_most=0.2)] = 0.030
    """Of each click."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start halfway between two detents."""
        notches = Notches(
            self.position(contact),
            spacing=self.spacing,
            hysteresis=_HYSTERESIS,
            duration=self.duration,
            level_db_sl=level_db_sl,
        )
        return _DetentsRun(self, notches)

    def position(self, contact: Contact) -> float:
        """Return the position [m] of a finger along the detents."""
        return contact.x if self.along == "x" else contact.y


class _DetentsRun(EffectRun):
    """Follows the position of one finger between detents."""

    def __init__(self, detents: Detents, notches: Notches) -> None:
        self._detents = detents
        self._notches = notches

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return a click from each passing on."""
        return self._notches.at(self._detents.position(contact), now)
