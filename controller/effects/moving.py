"""Effects of a finger that moves: texture by its speed, detents by its place."""

import math
from collections import deque
from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import model_validator

from controller.effects.effect import Course, Effect, Feeling, Nothing
from controller.effects.timed import SHORTEST
from controller.sources.contacts import Contact
from model.config.sections import Quantity
from model.config.units import LENGTH, RATIO, SPEED, TIME

# Panels report 60 to 200 times a second; over this time [s] speed is told from noise.
_MEMORY = 0.060
# A finger that was not reported elsewhere for so long [s] rests.
_REST = 0.080
# Levels of a texture are this far apart [dB], so that not every report is another command.
_LEVEL_STEP = 2.0
# A level is left when the speed asks for one this far [dB] from it, so that none flutters.
_LEVEL_HOLD = 1.5
# Reports that come together are taken to be this far apart [s]; no panel is faster.
_SHORTEST_REPORT = 0.002
# A finger this far [m] from where it was has moved; less is the panel's noise.
_NOISE = 0.0002
# A finger this far [m] past a detent has passed it.
_HYSTERESIS = 0.0005


class Texture(Effect):
    """The faster the finger, the stronger; nothing at rest.

    level is felt at the speed `fast` and above; at `slow` it is `range` dB less, below it nothing.
    """

    kind: ClassVar[str] = "texture"
    moves: ClassVar[bool] = True

    slow: Annotated[float, Quantity(SPEED, above=0, most=1)] = 0.01
    fast: Annotated[float, Quantity(SPEED, above=0, most=5)] = 0.20
    range: Annotated[float, Quantity(RATIO, least=0, most=40)] = 14.0

    @model_validator(mode="after")
    def _check_speeds(self) -> Self:
        if self.fast <= self.slow:
            raise ValueError(
                f"fast is {self.fast:g} m/s and must be above slow, which is {self.slow:g} m/s"
            )
        return self

    def begin(self, contact: Contact, now: float, *, level_db_sl: float | None) -> Course:
        """From rest."""
        return _Texture(self, contact, now, level_db_sl)


class _Texture(Course):
    """What a finger's speed makes of a texture."""

    def __init__(
        self, texture: Texture, contact: Contact, now: float, level_db_sl: float | None
    ) -> None:
        self._texture = texture
        self._level = level_db_sl
        self._path = deque([(now, contact.x, contact.y)])
        self._below: float | None = None  # what the level was less than at `fast` [dB]

    def feel(self, contact: Contact, now: float) -> Feeling | Nothing | None:
        """By the speed over the last 60 ms; a finger that is not reported elsewhere rests."""
        before, *place = self._path[-1]
        if math.dist((contact.x, contact.y), place) >= _NOISE:
            if now - before >= _REST:  # it has rested there until now
                self._path = deque([(now - _MEMORY, place[0], place[1])])
            self._path.append((now, contact.x, contact.y))
        while len(self._path) > 2 and now - self._path[1][0] >= _MEMORY:
            self._path.popleft()
        rests_from = self._path[-1][0] + _REST
        if now >= rests_from:
            return Nothing()
        speed = self._speed(contact, now)
        if speed < self._texture.slow:
            return Nothing(until=rests_from)
        return Feeling(self._level_at(speed), until=rests_from, or_less=True)

    def _speed(self, contact: Contact, now: float) -> float:
        """Speed [m/s] along the path that is remembered, to where the finger is."""
        places = [*((x, y) for _, x, y in self._path), (contact.x, contact.y)]
        way = sum(math.dist(one, after) for one, after in pairwise(places))
        return way / max(now - self._path[0][0], _SHORTEST_REPORT)

    def _level_at(self, speed: float) -> float | None:
        """The level [dB SL] of a speed [m/s], along its logarithm, in steps of 2 dB."""
        if self._level is None:
            return None
        slow, fast = self._texture.slow, self._texture.fast
        share = math.log(min(speed, fast) / slow) / math.log(fast / slow)
        below = (1 - share) * self._texture.range
        if self._below is None or abs(below - self._below) > _LEVEL_HOLD:
            self._below = round(below / _LEVEL_STEP) * _LEVEL_STEP
        return self._level - self._below


class Detents(Effect):
    """A click each time the finger passes one of the detents, which lie `spacing` apart.

    along: in which direction of the plate they follow each other. They count from where the finger
    came down, halfway between two.
    """

    kind: ClassVar[str] = "detents"
    moves: ClassVar[bool] = True

    spacing: Annotated[float, Quantity(LENGTH, least=0.002, most=0.2)] = 0.010
    along: Literal["x", "y"] = "x"
    duration: Annotated[float, Quantity(TIME, least=SHORTEST, most=0.2)] = 0.030

    def begin(self, contact: Contact, now: float, *, level_db_sl: float | None) -> Course:
        """Where the finger is."""
        return _Detents(self, self.place(contact), level_db_sl)

    def place(self, contact: Contact) -> float:
        """Where a finger is along the detents [m]."""
        return contact.x if self.along == "x" else contact.y


class _Detents(Course):
    """Detents around where a finger came down."""

    def __init__(self, detents: Detents, start: float, level_db_sl: float | None) -> None:
        self._detents = detents
        self._middle = start  # of the two detents that the finger is between
        self._level = level_db_sl
        self._end = -math.inf

    def feel(self, contact: Contact, now: float) -> Feeling | Nothing | None:
        """A click from each passing on; several at once are one."""
        spacing = self._detents.spacing
        away = self._detents.place(contact) - self._middle
        passed = math.floor((abs(away) - _HYSTERESIS) / spacing + 0.5)
        if passed > 0:
            self._middle += math.copysign(passed * spacing, away)
            self._end = now + self._detents.duration
        if now < self._end:
            return Feeling(self._level, until=self._end)
        return Nothing()
