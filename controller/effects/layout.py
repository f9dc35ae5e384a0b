"""A surface layout: which regions of the plate have which effects."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

from controller.effects.band import Band
from controller.effects.buzz import Buzz
from controller.effects.click import Click
from controller.effects.effect import Effect
from controller.effects.region import Region
from model.finger.perception import STRONG_DB_SL

BUZZ = "buzz"
"""Name of the effect that plays without a layout."""


def default_effects(level_db_sl: float = STRONG_DB_SL) -> dict[str, Effect]:
    """Return the effects that every layout has without defining them, at a level."""
    return {BUZZ: Buzz(level=level_db_sl), "click": Click(level=level_db_sl)}


@dataclass(frozen=True)
class SurfaceLayout:
    """Regions, later ones on top of earlier ones, and effects by name.

    elsewhere: the effect outside of all regions, None for none; most_at_once: number of fingers
    that may feel something at once, the newest ones.
    """

    regions: tuple[Region, ...] = ()
    effects: Mapping[str, Effect] = field(default_factory=default_effects)
    elsewhere: str | None = BUZZ
    most_at_once: int = 1

    def region_at(self, x: float, y: float) -> Region | None:
        """Return the topmost region at a position [m], or None."""
        return next(
            (region for region in reversed(self.regions) if region.shape.contains(x, y)), None
        )

    @property
    def max_db_sl(self) -> float:
        """The highest level of all effects; infinite for what the neighbours allow."""
        levels = [effect.max_db_sl(effect.level_db_sl) for effect in self.effects.values()]
        levels += [
            self.effects[name].max_db_sl(region.level_db_sl)
            for region in self.regions
            for name in (region.on_press, region.on_move, region.on_release)
            if region.has_level and name is not None
        ]
        return max(levels, default=-math.inf)

    def band_of(self, name: str, region: Region | None) -> Band | None:
        """Return the band of an effect [Hz], by name, in a region or outside of all; None: any."""
        own = None if region is None else region.band
        return self.effects[name].tuned_band if own is None else own

    def warnings(self) -> list[str]:
        """Pairs of effects that two fingers can feel at once, but that share no frequency."""
        if self.most_at_once == 1:
            return []
        requested = [(name, effect.tuned_band) for name, effect in self.effects.items()]
        by_priority: dict[int, list[tuple[str, Band | None]]] = {}
        if self.elsewhere is not None:
            by_priority[0] = [(self.elsewhere, self.band_of(self.elsewhere, None))]
        for region in self.regions:
            by_priority.setdefault(region.priority, []).extend(
                (f"{name} in {region.name}", self.band_of(name, region))
                for name in (region.on_press, region.on_move, region.on_release)
                if name is not None
            )
        found = dict.fromkeys(
            f"most_at_once is {self.most_at_once}, but {one} and {other} share no frequency: where "
            "both are due, only the finger that came first feels its own; give both a common band, "
            "or set most_at_once to 1"
            for together in (*by_priority.values(), requested)
            for (one, band), (other, other_band) in combinations(together, 2)
            if band and other_band and max(band[0], other_band[0]) > min(band[1], other_band[1])
        )
        return list(found)

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {
            "regions": [region.as_json() for region in self.regions],
            "elsewhere": self.elsewhere,
            "most_at_once": self.most_at_once,
        }
