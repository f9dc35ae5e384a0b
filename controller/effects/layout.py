"""A surface layout: which regions of the plate have which effects."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

from controller.effects.effect import Effect
from controller.effects.file import named_effects
from controller.effects.kinds import BUILT_IN
from controller.effects.region import USES, Region
from controller.play.intent import Band, band_problem
from model.arrays import FloatArray
from model.finger import STRONG_DB_SL

BUZZ = "buzz"
"""Name of the effect that plays without a layout."""

ELSEWHERE = "elsewhere"
"""Key of the effect outside of all regions, and what reports call the plate there."""


def default_effects(level_db_sl: float = STRONG_DB_SL) -> dict[str, Effect]:
    """Return the effects that every layout has without defining them, at a level."""
    effects = [each for each in BUILT_IN if not each.needs_entry]
    plain = {each.kind: each.model_construct(set(), level=level_db_sl) for each in effects}
    return {**named_effects(level_db_sl), **plain}


@dataclass(frozen=True)
class SurfaceLayout:
    """Regions, later ones on top of earlier ones, and effects by name.

    elsewhere: the effect outside of all regions, of the newest finger there; None for none.
    """

    regions: tuple[Region, ...] = ()
    effects: Mapping[str, Effect] = field(default_factory=default_effects)
    elsewhere: str | None = BUZZ

    def region_at(self, x: float, y: float) -> Region | None:
        """Return the topmost region at a position [m], or None."""
        for region in reversed(self.regions):
            if region.shape.contains(x, y):
                return region
        return None

    def uses(self) -> Iterator[tuple[Region | None, str, str]]:
        """Yield every effect of every region: the region, None outside of all, key and name."""
        for region in self.regions:
            for on in USES:
                if (name := getattr(region, on)) is not None:
                    yield region, on, name
        if self.elsewhere is not None:
            yield None, ELSEWHERE, self.elsewhere

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return it as it is played at the frequencies of a table [Hz], prepared at its levels."""
        effects = {name: each.for_table(frequencies) for name, each in self.effects.items()}
        for each in effects.values():
            each.prepare(each.level_db_sl)
        for region, _, name in self.uses():
            effects[name].prepare(self.level_of(name, region))
        return replace(self, effects=effects)

    @property
    def max_db_sl(self) -> float:
        """The highest level of all effects; infinite for what the neighbours allow."""
        levels = [effect.max_db_sl(effect.level_db_sl) for effect in self.effects.values()]
        levels += [
            self.effects[name].max_db_sl(self.level_of(name, region))
            for region, _, name in self.uses()
            if region is not None
        ]
        return max(levels, default=-math.inf)

    def level_of(self, name: str, region: Region | None) -> float | None:
        """Return the level [dB SL] of an effect, by name, in a region or outside of all.

        None for as strong as the neighbours allow.
        """
        if region is not None and region.has_level:
            return region.level_db_sl
        return self.effects[name].level_db_sl

    def gives_level(self, name: str, region: Region | None) -> bool:
        """Whether it gives an effect, by name, a level of its own in a region."""
        return self.effects[name].gives_level_in(region)

    def band_of(self, name: str, region: Region | None) -> Band | None:
        """Return the band of an effect [Hz], by name, in a region or outside of all; None: any."""
        return self.effects[name].band_in(region)

    def band_problems(self, frequencies: FloatArray) -> list[str]:
        """Return what a table of frequencies [Hz] plays instead of bands that it lacks."""
        problems = [
            f"{ELSEWHERE if region is None else region.name}: {problem}"
            for region, _, name in self.uses()
            if (band := self.band_of(name, region)) is not None
            and (problem := band_problem(band, frequencies)) is not None
        ]
        return [*dict.fromkeys(problems)]

    def as_json(self) -> dict[str, Any]:
        """Return it as the API describes it."""
        return {
            "regions": [region.as_json() for region in self.regions],
            "elsewhere": self.elsewhere,
        }
