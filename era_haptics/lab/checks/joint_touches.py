"""Promised contrast between simultaneously touched regions of a layout."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np

from controller.effects.effect import Region
from controller.effects.layout import SurfaceLayout
from controller.play.intent import FingerTarget, Target
from controller.play.joint_answers import fingers_of, selection_of
from controller.play.selected_contents import Question, Selection
from controller.sources.touch import Contact, ContactKey
from era_haptics.lab.checks.layout_check import touch_positions
from era_haptics.lab.checks.strongest_target import strongest_target
from era_haptics.lab.checks.touch_simulator import TouchSimulator
from model.answer.answer import MIN_CONTRAST_DB, Answer
from model.answer.plan import answer
from model.arrays import FloatArray, Point, best_of
from model.processes import Progress, unseen
from model.quantities import counted
from model.table.table import LocalizationTable

MAX_PAIRS = 150
"""In layouts with many regions, only the closest pairs are checked."""

MAX_TRIPLES = 150
"""In layouts with many regions, only the closest triples are checked."""

_POSITIONS = 4  # per region: the center, then points farthest from it and from each other
_MAX_NAMED = 4  # pairs that are close
_MIN_DISTANCE = 0.02  # m; two fingertips next to each other


@dataclass(frozen=True)
class JointTouch:
    """Simultaneous fingers in two or three regions, at the positions with the lowest contrast.

    at [m]: finger positions; contrasts [dB]: promised contrast of each content with the others
    there, if all play; worst_db: lowest contrast of all fingers on the same plates; verdicts: after
    the rule that mixes, shares or holds back.
    """

    regions: tuple[str, ...]
    at: tuple[Point, ...]
    contrasts: tuple[float, ...]
    worst_db: float
    verdicts: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era layout check --json`."""
        return {
            "regions": [*self.regions],
            "at_m": [[*at] for at in self.at],
            "promised_contrast_db": [*self.contrasts],
            "promised_worst_db": self.worst_db,
            "promised_verdicts": [*self.verdicts],
        }


class _TouchedRegion(NamedTuple):
    """A region with its target, and the positions [m] that are tried in it."""

    region: Region
    target: Target
    positions: list[Point]

    @property
    def name(self) -> str:
        """Name of the region."""
        return self.region.name


def check_together(
    layout: SurfaceLayout,
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> list[JointTouch]:
    """Answer fingers in all pairs and triples of regions at their worst positions.

    For a pair, these are the worst of four positions per region, with all effects taken as steady;
    for a triple, the worst of the positions of its pairs. progress: called with the number of pairs
    and triples answered and the total.
    """
    simulator = TouchSimulator(table)
    touched = _touched_regions(layout, table)
    pairs = _closest(combinations(touched, 2), MAX_PAIRS)
    triples = _closest(combinations(touched, 3), MAX_TRIPLES)
    total = len(pairs) + len(triples)
    joint_touches = []
    worst_in_pairs: dict[str, dict[str, Point]] = {region.name: {} for region in touched}
    for number, group in enumerate((*pairs, *triples)):
        progress(number, total)
        if len(group) > 2:
            group = tuple(_at_worst_of_pairs(group, worst_in_pairs))
        joint_touch = _worst(simulator, group)
        if joint_touch is None:
            continue
        joint_touches.append(joint_touch)
        if len(group) == 2:
            first, second = group
            worst_in_pairs[first.name][second.name] = joint_touch.at[0]
            worst_in_pairs[second.name][first.name] = joint_touch.at[1]
    progress(total, total)
    return joint_touches


def matrix_of(together: Sequence[JointTouch]) -> tuple[list[str], FloatArray]:
    """Return the regions' names, and the promised contrast of the worst finger (n, n) [dB].

    Below the diagonal: pairs. Above: triples with the worst third region. NaN if not checked.
    """
    names = [*dict.fromkeys(name for touch in together for name in touch.regions)]
    matrix = np.full((len(names), len(names)), np.nan)
    for touch in together:
        numbers = sorted(names.index(name) for name in touch.regions)
        for low, high in combinations(numbers, 2):
            cell = (high, low) if len(numbers) == 2 else (low, high)
            matrix[cell] = np.fmin(matrix[cell], touch.worst_db)
    return names, matrix


def close_pairs(together: Sequence[JointTouch]) -> str:
    """Format the pairs of regions felt as one, lowest contrast first; empty without any."""
    pairs = [touch for touch in together if len(touch.regions) == 2]
    close = [pair for pair in pairs if pair.worst_db < MIN_CONTRAST_DB]
    close.sort(key=lambda pair: pair.worst_db)
    if not close:
        return ""
    rows = []
    for pair in close[:_MAX_NAMED]:
        rows.append(f"{' with '.join(pair.regions)} {pair.worst_db:.1f} dB")
    remainder = f" and {len(close) - _MAX_NAMED} more" if len(close) > _MAX_NAMED else ""
    return (
        f", but {len(close)} of {counted(len(pairs), 'pair')} of regions below "
        f"{MIN_CONTRAST_DB:g} dB together: {', '.join(rows)}{remainder}; move these regions apart, "
        "or widen or remove their bands"
    )


# Regions and positions


def _touched_regions(layout: SurfaceLayout, table: LocalizationTable) -> list[_TouchedRegion]:
    """Return the regions with an effect and positions that no later region covers."""
    touched = []
    for region in layout.regions:
        target = _target_in(layout, region)
        positions = _distant_positions(layout, region, table)
        if target is not None and positions:
            touched.append(_TouchedRegion(region, target, positions))
    return touched


def _target_in(layout: SurfaceLayout, region: Region) -> Target | None:
    """Return the target of a finger in a region; continuous effects come first."""
    targets = []
    for name in (region.on_press, region.on_move):
        if name is not None:
            target = strongest_target(layout, name, region, at=region.shape.center)
            if target is not None:
                targets.append(target)
    return min(targets, key=lambda target: target.is_short, default=None)


def _distant_positions(
    layout: SurfaceLayout, region: Region, table: LocalizationTable
) -> list[Point]:
    """Return a few positions in a region: the center, then each the farthest from the previous
    ones."""
    candidates, _ = touch_positions(layout, region, table.plate)
    center = region.shape.center
    positions: list[Point] = []
    while candidates and len(positions) < _POSITIONS:
        if positions:
            distances = [min(math.dist(at, other) for other in positions) for at in candidates]
        else:
            distances = [-math.dist(at, center) for at in candidates]
        positions.append(candidates.pop(best_of(distances)))
    return positions


def _closest(
    groups: Iterable[tuple[_TouchedRegion, ...]], count: int
) -> list[tuple[_TouchedRegion, ...]]:
    """Return the groups of regions whose centers are closest, in the order of the layout."""
    candidates = [*groups]
    sizes = []
    for group in candidates:
        centers = [touched.region.shape.center for touched in group]
        sizes.append(sum(math.dist(*pair) for pair in combinations(centers, 2)))
    smallest = sorted(range(len(sizes)), key=sizes.__getitem__)[:count]
    return [candidates[number] for number in sorted(smallest)]


def _at_worst_of_pairs(
    group: Sequence[_TouchedRegion], worst_in_pairs: Mapping[str, Mapping[str, Point]]
) -> list[_TouchedRegion]:
    """Return a group at the worst positions of its pairs; at the center if none has a result."""
    names = {touched.name for touched in group}
    at_worst = []
    for touched in group:
        worst = worst_in_pairs[touched.name]
        positions = [at for other, at in worst.items() if other in names]
        distinct = [*dict.fromkeys(positions)]
        at_worst.append(touched._replace(positions=distinct or touched.positions[:1]))
    return at_worst


# Answers


def _worst(simulator: TouchSimulator, group: Sequence[_TouchedRegion]) -> JointTouch | None:
    """Answer at all combinations of positions; None if the fingers never fit."""
    targets = []
    protected = set[ContactKey]()
    for number, touched in enumerate(group):
        key = ContactKey("check", number)
        targets.append(replace(touched.target, key=key))
        if touched.region.is_protected:
            protected.add(key)
    free = [replace(target, is_own=False) for target in targets]
    steady = [replace(target, modulation_hz=None) for target in free]
    combination = []
    contrasts = []
    for at in product(*(touched.positions for touched in group)):
        if all(math.dist(*pair) >= _MIN_DISTANCE for pair in combinations(at, 2)):
            worst_db = _answered(simulator, _placed(steady, at), []).promised_worst_db
            combination.append(at)
            contrasts.append(math.inf if worst_db is None else worst_db)
    if not combination:
        return None
    worst_at = combination[best_of([-contrast for contrast in contrasts])]
    worst_db, felt = _felt(simulator, _placed(free, worst_at), None)
    _, served = _felt(simulator, _placed(targets, worst_at), frozenset(protected))
    return JointTouch(
        tuple(touched.name for touched in group),
        worst_at,
        tuple(finger.contrast_db for finger in felt),
        worst_db,
        tuple(finger.verdict for finger in served),
    )


def _placed(targets: Sequence[Target], at: Sequence[Point]) -> list[FingerTarget]:
    """Return targets with their contacts."""
    fingers = []
    for target, (x, y) in zip(targets, at, strict=True):
        fingers.append(FingerTarget(Contact(target.key, x, y, since=0.0), target))
    return fingers


class _FeltContent(NamedTuple):
    """Promised contrast [dB] and verdict of a finger."""

    contrast_db: float
    verdict: str


def _felt(
    simulator: TouchSimulator,
    fingers: Sequence[FingerTarget],
    protected: frozenset[ContactKey] | None,
) -> tuple[float, list[_FeltContent]]:
    """Return the contrast of the worst finger, and the contrast and verdict of each finger.

    Short effects play on top of continuous ones, one at a time, with all other fingers quiet. If
    protected is None, all contents play, even below the minimum contrast.
    """
    lasting = tuple(finger for finger in fingers if not finger.target.is_short)
    short = tuple(finger for finger in fingers if finger.target.is_short)
    felt: dict[ContactKey, _FeltContent] = {}
    selections: list[Selection] = []
    worst_db = math.inf
    if lasting:
        quiet = [finger.contact for finger in short]
        joint_answer = _answered(simulator, lasting, quiet, protected)
        contacts = [finger.contact for finger in lasting]
        question = Question((*contacts, *quiet), lasting, short)
        selections = [selection_of(simulator.table, question, joint_answer, lasting)]
        if joint_answer.promised_worst_db is not None:
            worst_db = joint_answer.promised_worst_db
        for contact, sensation in zip(contacts, joint_answer.fingers, strict=False):
            contrast = sensation.promised_contrast_db or 0.0
            felt[contact.key] = _FeltContent(contrast, sensation.verdict)
    all_contacts = tuple(finger.contact for finger in fingers)
    for finger in short:
        question = Question(
            all_contacts, (), (finger,), protected or frozenset(), kept=tuple(selections)
        )
        (selection,) = simulator.chooser.choose(question, simulator.capabilities)
        (finger_sensation,) = selection.beside(selections, simulator.table).finger_sensations
        sensation = finger_sensation.sensation
        content = _FeltContent(sensation.promised_contrast_db or 0.0, sensation.verdict)
        felt[finger.contact.key] = content
        worst_db = min(worst_db, content.contrast_db)
    return worst_db, [felt[finger.contact.key] for finger in fingers]


def _answered(
    simulator: TouchSimulator,
    fingers: Sequence[FingerTarget],
    quiet: Sequence[Contact],
    protected: frozenset[ContactKey] | None = None,
) -> Answer:
    """Answer fingers with continuous effects, including modulation; protected: see `_felt`."""
    table = simulator.table
    capabilities = simulator.capabilities
    all_fingers = fingers_of(table, fingers, quiet, capabilities, protected or frozenset())
    return answer(
        table,
        all_fingers,
        drive_mode=capabilities.drive_mode,
        min_contrast_db=-math.inf if protected is None else MIN_CONTRAST_DB,
        limits=capabilities.limits,
    )
