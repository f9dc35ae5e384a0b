"""What every kind of effect is: parameters in a layout, and how it goes at a finger."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import BeforeValidator

from controller.sources.contacts import Contact
from model.config.sections import Quantity, Section
from model.config.units import RATIO
from model.finger.perception import STRONG_DB_SL

NEIGHBOURS: Literal["neighbours"] = "neighbours"
"""A level: as strong as the neighbours allow."""

LOWEST_LEVEL, HIGHEST_LEVEL = -20.0, 60.0  # dB SL
_DB_SL = Quantity(RATIO, least=LOWEST_LEVEL, most=HIGHEST_LEVEL)


def _level(value: object) -> object:
    if value == NEIGHBOURS:
        return NEIGHBOURS
    if isinstance(value, str):
        raise ValueError(f"{value[:40]!r} is no level; write a number of dB SL, or {NEIGHBOURS}")
    return _DB_SL.read(value)


Level: TypeAlias = Annotated[float | Literal["neighbours"], BeforeValidator(_level)]
"""dB above the threshold of feeling, or `neighbours`."""


@dataclass(frozen=True, slots=True)
class Feeling:
    """What a finger shall feel from now on.

    level_db_sl: None for as strong as the neighbours allow. until: when [s] that may change though
    the finger does nothing; None for never. or_less: where the plate cannot reach the level, as
    strong as the neighbours allow instead of nothing.
    """

    level_db_sl: float | None
    until: float | None = None
    or_less: bool = False


@dataclass(frozen=True, slots=True)
class Nothing:
    """A finger shall feel nothing now; until as in `Feeling`."""

    until: float | None = None


class Course(ABC):
    """One play of an effect at one finger, from when it began."""

    @abstractmethod
    def feel(self, contact: Contact, now: float) -> Feeling | Nothing | None:
        """What the finger shall feel at a time [s]; None when the play is over, and stays so.

        Called at every change of the contact, and when the last answer ran out, in order of time.
        """


class Effect(Section, ABC):
    """The parameters of an effect; a kind of effect is a subclass of this.

    kind: its name in layouts; moves: whether it is about a finger that moves (then it belongs under
    `on_move`), or goes by itself.
    """

    kind: ClassVar[str]
    moves: ClassVar[bool]

    level: Level = STRONG_DB_SL

    @abstractmethod
    def begin(self, contact: Contact, now: float, *, level_db_sl: float | None) -> Course:
        """Begin at a finger, at a time [s], at a level; None for as strong as neighbours allow."""

    @property
    def ends(self) -> bool:
        """Whether it ends by itself, so that it may be played where nothing else would end it."""
        return True

    @property
    def level_db_sl(self) -> float | None:
        """The level; None for as strong as the neighbours allow."""
        return None if isinstance(self.level, str) else self.level

    def strongest_db_sl(self, level_db_sl: float | None) -> float:
        """The highest level [dB SL] that is felt of a play at a level; infinite for None."""
        return math.inf if level_db_sl is None else level_db_sl
