"""Texture: a vibration whose level follows the speed of the finger."""

import math
from collections import deque
from itertools import pairwise
from typing import Annotated, ClassVar, Self

from pydantic import model_validator

from controller.effects.effect import (
    Effect,
    EffectRun,
    EffectStimulus,
    Modulation,
    NoStimulus,
)
from controller.sources.contacts import Contact
from model.config.fields import LEVEL, SPEED, Quantity

# Speed is measured over this time [s]; panels report 60 to 200 times a second.
_SPEED_WINDOW = 0.060
# A finger without movement for so long [s] is at rest.
_REST_TIMEOUT = 0.080
# Levels are this far apart [dB], so that not every report is another command.
_LEVEL_STEP = 2.0
# The level changes when the speed asks for one this far [dB] from it: hysteresis.
_LEVEL_HYSTERESIS = 1.5
# Reports closer together [s] are treated as this far apart; no panel is faster.
_MIN_REPORT_INTERVAL = 0.002
# Movement below this distance [m] is sensor noise.
_NOISE = 0.0002


class Texture(Effect):
    """The faster the finger, the stronger, proportional to the logarithm of the speed.

    Nothing is felt at rest.
    """

    kind: ClassVar[str] = "texture"
    is_for_motion: ClassVar[bool] = True

    slow: Annotated[float, Quantity(SPEED, above=0, at_most=1)] = 0.01
    """Nothing is felt below it."""

    fast: Annotated[float, Quantity(SPEED, above=0, at_most=5)] = 0.20
    """`level` is reached at it; above `slow`."""

    range: Annotated[float, Quantity(LEVEL, at_least=0, at_most=40)] = 14.0
    """How many dB below `level` at `slow`."""

    modulation: Modulation = None
    """As of `buzz`."""

    @model_validator(mode="after")
    def _check_speeds(self) -> Self:
        if self.fast <= self.slow:
            raise ValueError(
                f"fast must be above slow, which is {self.slow:g} m/s, got {self.fast:g} m/s"
            )
        return self

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start from rest."""
        return _TextureRun(self, contact, now, level_db_sl)


class _TextureRun(EffectRun):
    """Follows the path of one finger."""

    def __init__(
        self, texture: Texture, contact: Contact, now: float, level_db_sl: float | None
    ) -> None:
        self._texture = texture
        self._level = level_db_sl
        self._path = deque([(now, contact.x, contact.y)])
        self._attenuation: float | None = None  # below the level at `fast` [dB]

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus | None:
        """Return the level of the speed over the last 60 ms."""
        before, *position = self._path[-1]
        if math.dist((contact.x, contact.y), position) >= _NOISE:
            if now - before >= _REST_TIMEOUT:  # it was at rest there until now
                self._path = deque([(now - _SPEED_WINDOW, position[0], position[1])])
            self._path.append((now, contact.x, contact.y))
        while len(self._path) > 2 and now - self._path[1][0] >= _SPEED_WINDOW:
            self._path.popleft()
        rests_from = self._path[-1][0] + _REST_TIMEOUT
        if now >= rests_from:
            return NoStimulus()
        speed = self._speed(contact, now)
        if speed < self._texture.slow:
            return NoStimulus(until=rests_from)
        return EffectStimulus(
            self._level_at(speed),
            until=rests_from,
            modulation_hz=self._texture.modulation,
        )

    def _speed(self, contact: Contact, now: float) -> float:
        """Return the mean speed [m/s] along the stored path up to the finger."""
        positions = [*((x, y) for _, x, y in self._path), (contact.x, contact.y)]
        distance = sum(math.dist(one, after) for one, after in pairwise(positions))
        return distance / max(now - self._path[0][0], _MIN_REPORT_INTERVAL)

    def _level_at(self, speed: float) -> float | None:
        """Return the level [dB SL] of a speed [m/s], linear in log speed, in steps of 2 dB."""
        if self._level is None:
            return None
        slow, fast = self._texture.slow, self._texture.fast
        fraction = math.log(min(speed, fast) / slow) / math.log(fast / slow)
        attenuation = (1 - fraction) * self._texture.range
        if self._attenuation is None or abs(attenuation - self._attenuation) > _LEVEL_HYSTERESIS:
            self._attenuation = round(attenuation / _LEVEL_STEP) * _LEVEL_STEP
        return self._level - self._attenuation
