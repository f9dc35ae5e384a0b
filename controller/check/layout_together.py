"""Which regions of a layout can be felt apart at the same time: two and three fingers at once."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, TypeAlias

import numpy as np

from controller.check.layout_check import raster
from controller.check.representative import strongest_target
from controller.check.simulated_touch import Position, TouchSimulator
from controller.effects.effect import Region
from controller.effects.layout import SurfaceLayout
from controller.play.intent import Target
from controller.play.joint_answers import fingers_of, selection_of
from controller.play.layer_contents import Selection
from controller.play.selection import ChoiceRequest, Intention
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import MIN_CONTRAST_DB, Answer
from model.answer.plan import answer
from model.arrays import FloatArray, best_of
from model.processes import Progress, unseen
from model.quantities import counted
from model.table.table import LocalizationTable

MAX_PAIRS, MAX_TRIPLES = 150, 150
"""Of a layout with many regions those whose centres are nearest."""

_POSITIONS = 4  # of a region: the middle, and those farthest from it and from each other
_NAMED = 4  # pairs that are close
_NEAREST = 0.02  # m; two fingertips side by side

_Finger: TypeAlias = tuple[Contact, Target]


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
    progress: Progress = unseen,
) -> list[Together]:
    """Answer fingers in every two and every three regions at their worst places.

    Worst, if all were steady, of four places of each of two regions; of three regions of those of
    their pairs.
    progress: called with the number of pairs and triples answered, and of all.
    """
    simulator = TouchSimulator(table)
    targets, places = dict[str, Target](), dict[str, list[Position]]()
    for region in layout.regions:
        target, some = _target_in(layout, region), _some_of(layout, region, table)
        if target is not None and some:
            targets[region.name], places[region.name] = target, some
    regions = [each for each in layout.regions if each.name in targets]
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
        felt = [
            replace(targets[each.name], key=ContactKey("check", at))
            for at, each in enumerate(group)
        ]
        together = _worst(simulator, group, felt, spots)
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


def close_pairs(together: Sequence[Together]) -> str:
    """Say which two regions are felt as one at the same time, hardest to tell apart first.

    Nothing where there are none.
    """
    pairs = [each for each in together if len(each.regions) == 2]
    close = sorted(
        (each for each in pairs if each.worst_db < MIN_CONTRAST_DB), key=lambda each: each.worst_db
    )
    if not close:
        return ""
    named = [f"{' with '.join(each.regions)} {each.worst_db:.1f} dB" for each in close[:_NAMED]]
    more = f" and {len(close) - _NAMED} more" if len(close) > _NAMED else ""
    return (
        f", but {len(close)} of {counted(len(pairs), 'pair')} of regions below "
        f"{MIN_CONTRAST_DB:g} dB at once: {', '.join(named)}{more}"
    )


def _target_in(layout: SurfaceLayout, region: Region) -> Target | None:
    """Return what a finger in a region feels: what lasts rather than what is short."""
    names = [name for name in (region.on_press, region.on_move) if name is not None]
    found = [strongest_target(layout, name, region, at=region.shape.centre) for name in names]
    felt = [each for each in found if each is not None]
    return min(felt, key=lambda each: each.is_short, default=None)


def _some_of(layout: SurfaceLayout, region: Region, table: LocalizationTable) -> list[Position]:
    """Return a few places of a region, the middle first, then each farthest from those before."""
    left, found = raster(layout, region, table.plate)[0], list[Position]()
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
    simulator: TouchSimulator,
    group: Sequence[Region],
    targets: Sequence[Target],
    spots: Sequence[Sequence[Position]],
) -> Together | None:
    """Answer at all combinations of places; None where no fingers fit there at once."""
    free = [replace(target, is_own=False) for target in targets]
    steady = [replace(target, modulation_hz=None) for target in free]
    tried: list[tuple[float, tuple[Position, ...]]] = []
    for at in product(*spots):
        if all(math.dist(*pair) >= _NEAREST for pair in combinations(at, 2)):
            worst = _answered(simulator, _placed(steady, at), []).promised_worst_db
            tried.append((math.inf if worst is None else worst, at))
    if not tried:
        return None
    _, at = tried[best_of([-worst for worst, _ in tried])]
    protected = frozenset(
        target.key for target, each in zip(targets, group, strict=True) if each.is_protected
    )
    worst_db, felt = _felt(simulator, _placed(free, at), None)
    _, served = _felt(simulator, _placed(targets, at), protected)
    return Together(
        tuple(each.name for each in group),
        at,
        tuple(contrast for contrast, _ in felt),
        worst_db,
        tuple(verdict for _, verdict in served),
    )


def _placed(targets: Sequence[Target], at: Sequence[Position]) -> list[_Finger]:
    """Return targets with their contacts."""
    return [
        (Contact(target.key, x, y, since=0.0), target)
        for target, (x, y) in zip(targets, at, strict=True)
    ]


def _felt(
    simulator: TouchSimulator, fingers: Sequence[_Finger], protected: frozenset[ContactKey] | None
) -> tuple[float, list[tuple[float, str]]]:
    """Return the contrast of the worst finger, and of each finger its contrast and verdict.

    What is short plays beside what lasts, one at a time, all other fingers quiet. protected: None
    to play all contents, whatever they reach.
    """
    lasting = [each for each in fingers if not each[1].is_short]
    short = [each for each in fingers if each[1].is_short]
    found: dict[ContactKey, tuple[float, str]] = {}
    worst, beside = math.inf, list[Selection]()
    if lasting:
        quiet = [contact for contact, _ in short]
        together = _answered(simulator, lasting, quiet, protected)
        worst = math.inf if together.promised_worst_db is None else together.promised_worst_db
        beside = [selection_of(simulator.table, together, lasting, quiet, before={})]
        for (contact, _), each in zip(lasting, together.fingers, strict=False):
            found[contact.key] = each.promised_contrast_db or 0.0, each.verdict
    contacts = tuple(contact for contact, _ in fingers)
    for one in short:
        key = one[0].key
        intended = Intention(contacts, (), (one,), protected or frozenset())
        requested = ChoiceRequest(intended, {}, tuple(beside))
        chosen = simulator.chooser.choose(requested, simulator.capabilities).short[key]
        (predicted,) = chosen.beside(beside, simulator.table).predictions
        found[key] = predicted.promised_contrast_db or 0.0, predicted.verdict
        worst = min(worst, found[key][0])
    return worst, [found[contact.key] for contact, _ in fingers]


def _answered(
    simulator: TouchSimulator,
    fingers: Sequence[_Finger],
    quiet: Sequence[Contact],
    protected: frozenset[ContactKey] | None = None,
) -> Answer:
    """Answer fingers that feel what lasts, with its modulation; protected: as of `_felt`."""
    table, capabilities = simulator.table, simulator.capabilities
    every = fingers_of(table, fingers, quiet, capabilities, protected or frozenset())
    least = -math.inf if protected is None else MIN_CONTRAST_DB
    return answer(
        table,
        every,
        drive_mode=capabilities.drive_mode,
        min_contrast_db=least,
        limits=capabilities.limits,
    )
