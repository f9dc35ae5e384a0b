"""Which regions of a layout can be felt apart at the same time: two and three fingers at once."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from controller.effects.layout import SurfaceLayout
from controller.effects.layout_check import raster
from controller.effects.region import Region
from controller.effects.simulated_touch import Position
from controller.loop.intent import Target
from controller.loop.joint_answer import requests_of
from controller.sources.contacts import Contact, ContactKey
from model.arrays import FloatArray
from model.choice import best_of
from model.table.answer import answer
from model.table.request import MIN_CONTRAST_DB, Answer
from model.table.table import LocalizationTable

MAX_PAIRS, MAX_TRIPLES = 150, 150
"""Of a layout with many regions those whose centres are nearest."""

_POSITIONS = 4  # of a region: the middle, and those farthest from it and from each other
_NEAREST = 0.02  # m; two fingertips side by side


@dataclass(frozen=True)
class Together:
    """Fingers in two or three regions at once, where the worst one has least contrast.

    at [m]: of each; contrasts [dB]: promised of each content above those of the others there, all
    played; worst_db: of all fingers on the same plates; verdicts: what the rule makes of them.
    """

    regions: tuple[str, ...]
    at: tuple[Position, ...]
    contrasts: tuple[float, ...]
    worst_db: float
    verdicts: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it as `era layout check --json` prints it."""
        return {
            "regions": [*self.regions],
            "at_m": [[*at] for at in self.at],
            "promised_contrast_db": [*self.contrasts],
            "promised_worst_db": self.worst_db,
            "promised_verdicts": [*self.verdicts],
        }


def check_together(
    layout: SurfaceLayout,
    table: LocalizationTable,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Together]:
    """Answer fingers in every two and every three regions at their worst places, effects lasting.

    Worst of four places of each of two regions; of three regions where they are worst in pairs.
    progress: called with the number of pairs and triples answered, and of all.
    """
    regions = [each for each in layout.regions if _effect_of(each)]
    places = {each.name: _some_of(raster(layout, each, table.plate)[0], each) for each in regions}
    regions = [each for each in regions if places[each.name]]
    pairs = _nearest(combinations(regions, 2), MAX_PAIRS)
    triples = _nearest(combinations(regions, 3), MAX_TRIPLES)
    total, found = len(pairs) + len(triples), []
    worst_in: dict[str, dict[str, Position]] = {each.name: {} for each in regions}
    for number, group in enumerate((*pairs, *triples)):
        progress(number, total)
        spots = [places[each.name] for each in group]
        if len(group) > 2:
            names = {each.name for each in group}
            spots = [
                [*dict.fromkeys(at for other, at in worst_in[name].items() if other in names)]
                or places[name][:1]
                for name in (each.name for each in group)
            ]
        together = _worst(layout, table, group, spots)
        if together is None:
            continue
        found.append(together)
        if len(group) == 2:
            for one, other, at in zip(group, reversed(group), together.at, strict=True):
                worst_in[one.name][other.name] = at
    progress(total, total)
    return found


def matrix_of(together: Sequence[Together]) -> tuple[list[str], FloatArray]:
    """Return the regions' names, and the promise of the worst finger in every two of them [dB].

    (n, n): below the diagonal two at once, above it three, with the worst third; NaN for none.
    """
    names = [*dict.fromkeys(name for each in together for name in each.regions)]
    found = np.full((len(names), len(names)), np.nan)
    for each in together:
        rows = sorted(names.index(name) for name in each.regions)
        for one, other in combinations(rows, 2):
            at = (other, one) if len(rows) == 2 else (one, other)
            found[at] = np.fmin(found[at], each.worst_db)
    return names, found


def _effect_of(region: Region) -> str:
    """Return the name of the effect under a finger in a region, empty for none."""
    return region.on_press or region.on_move or ""


def _some_of(places: Sequence[Position], region: Region) -> list[Position]:
    """Return a few places of a region, the middle first, then each farthest from those before."""
    left, found = [*places], list[Position]()
    while left and len(found) < _POSITIONS:
        if found:
            away = [min(math.dist(at, other) for other in found) for at in left]
        else:
            away = [-math.dist(at, region.shape.centre) for at in left]
        found.append(left.pop(best_of(away)))
    return found


def _nearest(groups: Iterable[tuple[Region, ...]], count: int) -> list[tuple[Region, ...]]:
    """Return the groups of regions whose centres are nearest, in the order of the layout."""
    every = [*groups]

    def size(number: int) -> float:
        centres = [each.shape.centre for each in every[number]]
        return sum(math.dist(*pair) for pair in combinations(centres, 2))

    return [every[number] for number in sorted(sorted(range(len(every)), key=size)[:count])]


def _worst(
    layout: SurfaceLayout,
    table: LocalizationTable,
    group: Sequence[Region],
    spots: Sequence[Sequence[Position]],
) -> Together | None:
    """Answer at all combinations of places; None where no fingers fit there at once."""
    tried: list[tuple[float, tuple[Position, ...], Answer]] = []
    for at in product(*spots):
        if all(math.dist(*pair) >= _NEAREST for pair in combinations(at, 2)):
            found = _answered(layout, table, group, at, is_bounded=False)
            worst = found.promised_worst_db
            tried.append((math.inf if worst is None else worst, at, found))
    if not tried:
        return None
    worst_db, at, found = tried[best_of([-worst for worst, _, _ in tried])]
    served = _answered(layout, table, group, at, is_bounded=True)
    return Together(
        tuple(each.name for each in group),
        at,
        tuple(layer.promised_contrast_db or 0.0 for layer in found.layers),
        worst_db,
        tuple(layer.verdict for layer in served.layers),
    )


def _answered(
    layout: SurfaceLayout,
    table: LocalizationTable,
    group: Sequence[Region],
    at: Sequence[Position],
    *,
    is_bounded: bool,
) -> Answer:
    """Answer fingers in regions; unless it is bounded all contents play, whatever they reach."""
    keys = [ContactKey("check", number) for number in range(len(group))]
    targets = []
    for key, region, (x, y) in zip(keys, group, at, strict=True):
        name = _effect_of(region)
        own = layout.effects[name].level_db_sl
        target = Target(
            key,
            region.level_db_sl if region.has_level else own,
            band=layout.band_of(name, region),
            priority=region.priority,
            content=name,
            is_own=region.is_own and is_bounded,
            may_share=region.may_share,
        )
        targets.append((Contact(key, x, y, since=0.0), target))
    protected = frozenset(
        key for key, region in zip(keys, group, strict=True) if region.is_protected and is_bounded
    )
    playable = float(table.frequencies[0]), float(table.frequencies[-1])
    requests = requests_of(table, targets, playable, protected)
    return answer(table, requests, min_contrast_db=MIN_CONTRAST_DB if is_bounded else -math.inf)
