"""Dial: a click at equal angles about the centre of a region."""

import math
from typing import Annotated, ClassVar

from controller.effects.detents import Notches
from controller.effects.effect import MIN_DURATION, Effect, EffectRun, EffectStimulus, NoStimulus
from controller.effects.region import Region
from controller.sources.contacts import Contact
from model.config.fields import ANGLE, TIME, Quantity

# A finger has passed a detent once it is this far [rad] beyond it, or [m] where that is more.
_HYSTERESIS, _HYSTERESIS_LENGTH = 0.02, 0.0005
_DEGREES_15 = 0.26179938779914946  # rad; as the file's units convert it
# Nearer to the centre [m] the angle of a finger is noise, and does not count.
_CENTRE_RADIUS = 0.006


class Dial(Effect):
    """A click at each detent that the finger passes in angle about the centre of its region.

    The finger comes down halfway between two of them. Near the centre it turns nothing.
    """

    kind: ClassVar[str] = "dial"
    is_for_motion: ClassVar[bool] = True
    needs_region: ClassVar[bool] = True

    spacing: Annotated[float, Quantity(ANGLE, at_least=0.05, at_most=3.2)] = _DEGREES_15
    """Angle between detents."""

    duration: Annotated[float, Quantity(TIME, at_least=MIN_DURATION, at_most=0.2)] = 0.030
    """Of each click."""

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start outside of all regions: nothing is felt."""
        return _Nothing()

    def start_in(
        self, region: Region | None, contact: Contact, now: float, *, level_db_sl: float | None
    ) -> EffectRun:
        """Start halfway between two detents."""
        if region is None:
            return self.start(contact, now, level_db_sl=level_db_sl)
        return _DialRun(self, region.shape.centre, level_db_sl)


class _Nothing(EffectRun):
    """Nothing as long as the finger stays."""

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return nothing."""
        return NoStimulus()


class _DialRun(EffectRun):
    """Follows the angle of one finger, turn after turn."""

    def __init__(self, dial: Dial, centre: tuple[float, float], level_db_sl: float | None) -> None:
        self._dial = dial
        self._centre = centre
        self._level = level_db_sl
        self._angle = 0.0  # [rad], with its turns
        self._last: float | None = None  # [rad] within one turn; None before the first
        self._notches: Notches | None = None

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return a click from each passing on."""
        x, y = contact.x - self._centre[0], contact.y - self._centre[1]
        radius = math.hypot(x, y)
        if radius < _CENTRE_RADIUS:
            self._last = None  # it may come out at any angle
            return NoStimulus() if self._notches is None else self._notches.resting(now)
        angle = math.atan2(y, x)
        if self._last is not None:
            self._angle += math.remainder(angle - self._last, math.tau)
        self._last = angle
        if self._notches is None:
            self._notches = Notches(
                self._angle,
                spacing=self._dial.spacing,
                hysteresis=max(_HYSTERESIS, _HYSTERESIS_LENGTH / radius),
                duration=self._dial.duration,
                level_db_sl=self._level,
            )
        return self._notches.at(self._angle, now)
