"""A surface layout: which parts of the plate have which effects."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from controller.effects.effect import Effect
from controller.effects.shapes import Shape
from controller.effects.timed import Buzz, Click
from model.finger.perception import STRONG_DB_SL


@dataclass(frozen=True)
class Region:
    """A part of the plate and the names of its effects, None for none.

    on_press: when a finger comes down in it or slides in; on_move: while it moves in it;
    on_release: when it slides out of it, felt where it is then. A finger that lifts feels nothing.
    level_db_sl: in place of the effects' own, as an effect has it; has_level: whether it is. Where
    several want to be felt, those of the highest priority are.
    """

    name: str
    shape: Shape
    on_press: str | None = None
    on_move: str | None = None
    on_release: str | None = None
    level_db_sl: float | None = None
    has_level: bool = False
    priority: int = 0

    def drawn(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "name": self.name,
            **self.shape.drawn(),
            "on_press": self.on_press,
            "on_move": self.on_move,
            "on_release": self.on_release,
            "priority": self.priority,
        }


BUZZ = "buzz"
"""The effect that plays where there is no layout."""


def usual_effects(level_db_sl: float = STRONG_DB_SL) -> dict[str, Effect]:
    """Effects that need not be written down, at a level."""
    return {BUZZ: Buzz(level=level_db_sl), "click": Click(level=level_db_sl)}


@dataclass(frozen=True)
class Layout:
    """Regions, of which a later one lies on top of an earlier one, and effects by their names.

    elsewhere: the effect outside of all regions, None for none; most_at_once: how many fingers may
    feel something at once, the newest of them.
    """

    regions: tuple[Region, ...] = ()
    effects: Mapping[str, Effect] = field(default_factory=usual_effects)
    elsewhere: str | None = BUZZ
    most_at_once: int = 1

    def region_at(self, x: float, y: float) -> Region | None:
        """The topmost region at a place [m]; None where there is none."""
        return next(
            (region for region in reversed(self.regions) if region.shape.contains(x, y)), None
        )

    @property
    def strongest_db_sl(self) -> float:
        """The highest level that anything in it can have; infinite for what neighbours allow."""
        levels = [effect.strongest_db_sl(effect.level_db_sl) for effect in self.effects.values()]
        levels += [
            self.effects[name].strongest_db_sl(region.level_db_sl)
            for region in self.regions
            for name in (region.on_press, region.on_move, region.on_release)
            if region.has_level and name is not None
        ]
        return max(levels, default=-math.inf)

    def drawn(self) -> dict[str, Any]:
        """As JSON, for whoever draws it."""
        return {
            "regions": [region.drawn() for region in self.regions],
            "elsewhere": self.elsewhere,
            "most_at_once": self.most_at_once,
        }
