"""Effects that go by themselves once they have begun: click, buzz, ramp."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from controller.effects.effect import (
    HIGHEST_LEVEL,
    LOWEST_LEVEL,
    Course,
    Effect,
    Feeling,
    Nothing,
)
from controller.sources.contacts import Contact
from model.config.sections import Quantity
from model.config.units import RATIO, TIME
from model.finger.perception import STRONG_DB_SL

# The plate needs some 20 ms to follow, see docs/concepts/transients.md; a shorter click would be
# none.
SHORTEST = 0.020
LONGEST = 10.0

RAMP_STEP_DB = 2.0
"""How far apart the levels of a ramp are: less than two levels that can be told apart."""


@dataclass(frozen=True)
class _Steady(Course):
    """A level until a time [s], or as long as the finger is there."""

    level_db_sl: float | None
    end: float | None

    def feel(self, contact: Contact, now: float) -> Feeling | Nothing | None:
        """The level until the end."""
        if self.end is not None and now >= self.end:
            return None
        return Feeling(self.level_db_sl, until=self.end)


class Click(Effect):
    """Once, shortly."""

    kind: ClassVar[str] = "click"
    moves: ClassVar[bool] = False

    duration: Annotated[float, Quantity(TIME, least=SHORTEST, most=0.5)] = 0.040

    def begin(self, contact: Contact, now: float, *, level_db_sl: float | None) -> Course:
        """From now for its duration."""
        return _Steady(level_db_sl, now + self.duration)


class Buzz(Effect):
    """As long as the finger is there, or for a duration."""

    kind: ClassVar[str] = "buzz"
    moves: ClassVar[bool] = False

    duration: Annotated[float, Quantity(TIME, least=SHORTEST, most=LONGEST)] | None = None

    def begin(self, contact: Contact, now: float, *, level_db_sl: float | None) -> Course:
        """From now on."""
        return _Steady(level_db_sl, None if self.duration is None else now + self.duration)

    @property
    def ends(self) -> bool:
        """Only with a duration."""
        return self.duration is not None


@dataclass(frozen=True)
class _Rising(Course):
    """Levels [dB SL] in equal steps of time [s], then the last one or the end."""

    start: float
    levels: tuple[float | None, ...]
    step: float
    holds: bool

    def feel(self, contact: Contact, now: float) -> Feeling | Nothing | None:
        """The level of the step that is on."""
        index = max(0, int((now - self.start) / self.step))
        if index >= len(self.levels) - 1 and self.holds:
            return Feeling(self.levels[-1], or_less=True)
        if index >= len(self.levels):
            return None
        # A rise that broke off at what the plate can do would be felt as an end.
        until = self.start + (index + 1) * self.step
        return Feeling(self.levels[index], until, or_less=True)


class Ramp(Effect):
    """From one level to another, then on at that level while the finger is there, or over."""

    kind: ClassVar[str] = "ramp"
    moves: ClassVar[bool] = False

    start_level: Annotated[float, Quantity(RATIO, least=LOWEST_LEVEL, most=HIGHEST_LEVEL)] = 6.0
    duration: Annotated[float, Quantity(TIME, least=0.1, most=LONGEST)] = 1.0
    hold: bool = False

    def begin(self, contact: Contact, now: float, *, level_db_sl: float | None) -> Course:
        """From the first level, in steps of 2 dB, or of more where these were too short."""
        end = STRONG_DB_SL if level_db_sl is None else level_db_sl
        span = end - self.start_level
        count = max(1, min(round(abs(span) / RAMP_STEP_DB), int(self.duration / SHORTEST) - 1))
        rise = [self.start_level + span * index / count for index in range(count)]
        levels = (*rise, level_db_sl)
        return _Rising(now, levels, self.duration / len(levels), self.hold)

    @property
    def ends(self) -> bool:
        """Unless it holds its last level."""
        return not self.hold

    def strongest_db_sl(self, level_db_sl: float | None) -> float:
        """One that falls begins with its strongest."""
        return max(self.start_level, super().strongest_db_sl(level_db_sl))
