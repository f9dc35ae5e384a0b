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
    for number, pair in enumerate(pairs):
        progress(number, total)
        joint_touch = _worst(simulator, pair)
        if joint_touch is not None:
            joint_touches.append(joint_touch)
            first, second = joint_touch.regions
            first_position, second_position = joint_touch.at
            worst_in_pairs[first][second] = first_position
            worst_in_pairs[second][first] = second_position
    for number, triple in enumerate(triples, start=len(pairs)):
        progress(number, total)
        joint_touch = _worst(simulator, _at_worst_of_pairs(triple, worst_in_pairs))
        if joint_touch is not None:
            joint_touches.append(joint_touch)
    progress(total, total)
    return joint_touches


def matrix_of(together: Sequence[JointTouch]) -> tuple[list[str], FloatArray]:
    """Return the regions' names, and the promised contrast of the worst finger (n, n) [dB].

    Below the diagonal: pairs. Above: triples with the worst third region. NaN if not checked.
    """
    names: list[str] = []
    for touch in together:
        names += [name for name in touch.regions if name not in names]
    matrix = np.full((len(names), len(names)), np.nan)
    for touch in together:
        numbers = sorted(map(names.index, touch.regions))
        for low, high in combinations(numbers, 2):
            is_pair = len(numbers) == 2
            cell = (high, low) if is_pair else (low, high)
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
        regions = " with ".join(pair.regions)
        rows.append(f"{regions} {pair.worst_db:.1f} dB")
    unnamed = len(close) - len(rows)
    remainder = f" and {unnamed} more" if unnamed else ""
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
            distances = [_distance_to_nearest(at, positions) for at in candidates]
        else:
            distances = [-math.dist(at, center) for at in candidates]
        positions.append(candidates.pop(best_of(distances)))
    return positions


def _distance_to_nearest(at: Point, positions: Sequence[Point]) -> float:
    """Return the distance [m] from a point to the nearest of several positions."""
    return min(math.dist(at, position) for position in positions)


def _closest(
    groups: Iterable[tuple[_TouchedRegion, ...]], count: int
) -> list[tuple[_TouchedRegion, ...]]:
    """Return the groups of regions whose centers are closest, in the order of the layout."""
    candidates = [*groups]
    sizes = []
    for group in candidates:
        centers = [touched.region.shape.center for touched in group]
        distances = [math.dist(*pair) for pair in combinations(centers, 2)]
        sizes.append(sum(distances))
    by_size = sorted(range(len(sizes)), key=sizes.__getitem__)
    numbers = sorted(by_size[:count])
    return [candidates[number] for number in numbers]


def _at_worst_of_pairs(
    group: Sequence[_TouchedRegion], worst_in_pairs: Mapping[str, Mapping[str, Point]]
) -> list[_TouchedRegion]:
    """Return a group at the worst positions of its pairs; at the center if none has a result."""
    names = {touched.name for touched in group}
    at_worst = []
    for touched in group:
        positions: list[Point] = []
        for partner, position in worst_in_pairs[touched.name].items():
            if partner in names and position not in positions:
                positions.append(position)
        if not positions:
            positions = touched.positions[:1]
        at_worst.append(touched._replace(positions=positions))
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
    free_targets = [replace(target, is_own=False) for target in targets]
    worst_at = _worst_positions(simulator, group, free_targets)
    if worst_at is None:
        return None
    worst_db, all_contents = _felt(simulator, _placed(free_targets, worst_at), None)
    _, served_contents = _felt(simulator, _placed(targets, worst_at), frozenset(protected))
    return JointTouch(
        regions=tuple(touched.name for touched in group),
        at=worst_at,
        contrasts=tuple(content.contrast_db for content in all_contents),
        worst_db=worst_db,
        verdicts=tuple(content.verdict for content in served_contents),
    )


def _worst_positions(
    simulator: TouchSimulator, group: Sequence[_TouchedRegion], targets: Sequence[Target]
) -> tuple[Point, ...] | None:
    """Return the positions with the lowest contrast of steady effects; None if fingers never
    fit."""
    steady = [replace(target, modulation_hz=None) for target in targets]
    placements = []
    scores = []
    for at in product(*(touched.positions for touched in group)):
        distances = [math.dist(*pair) for pair in combinations(at, 2)]
        if min(distances) < _MIN_DISTANCE:
            continue
        worst_db = _answered(simulator, _placed(steady, at), []).promised_worst_db
        placements.append(at)
        scores.append(-math.inf if worst_db is None else -worst_db)
    if not scores:
        return None
    return placements[best_of(scores)]


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
