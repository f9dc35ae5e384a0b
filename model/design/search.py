"""Search for the places of ERAs: greedy, then exchange, then places moved freely.

Greedy adds the candidate that raises the score most; an exchange moves one ERA at a time to the
best candidate until none gains; then every ERA is moved by ever smaller steps, no longer bound to
the candidates. A list of layouts is a search without steps.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray, IntArray
from model.choice import best_by
from model.design import problem as design_problem
from model.design.area import ANYWHERE, area_of
from model.design.problem import MIN_SUPPORTING, DesignProblem
from model.design.score import Mounts, Places, Scorer
from model.errors import InputError

MAX_SWEEPS = 4
"""Exchanges of every ERA."""

FINEST_STEP = 0.001
"""Last step [m] of freely moved places."""

_GAIN = 0.01  # dB; smaller ones are not worth a move
_UNSUPPORTED = -100.0  # dB; below every layout that supports the plate


@dataclass(frozen=True, eq=False)
class Found:
    """A layout: positions (n, 2) [m], those kept first, and its score [dB]."""

    positions: FloatArray
    score_db: float

    @property
    def is_supported(self) -> bool:
        """Whether it supports the plate."""
        return self.score_db > _UNSUPPORTED


class LayoutSearch:
    """Searches layouts of one problem; scores are of contact sets drawn by its seed."""

    def __init__(self, problem: DesignProblem) -> None:
        """Solve the plate for all candidates; raises InputError for an area without room."""
        self.problem = problem
        sets = problem.contacts.pooled_sets(design_problem.SEARCH_FINGERS, seed=problem.seed)
        self._scorer = Scorer(
            problem.rig, problem.searched_frequencies, sets, contents=problem.contacts.contents
        )
        kept = problem.kept_positions
        self._k = len(kept)
        self._places = self._scorer.places(np.vstack([kept, problem.candidates]))
        self._mounts: dict[int, Mounts] = {}
        self._known: dict[tuple[int, ...], float] = {}

    def path(self) -> Iterator[Found]:
        """Layouts of ever more ERAs, from those kept or as few as support the plate."""
        problem, layout = self.problem, tuple(range(self._k))
        while len(layout) < problem.count:
            layout = self.add(layout)
            if len(layout) + problem.supports >= MIN_SUPPORTING:
                layout = self.exchange(layout, sweeps=1 + (len(layout) == problem.count))
                yield self.refine(layout)
        if len(layout) == self._k:
            yield self.refine(layout)

    def from_random(self, rng: np.random.Generator) -> Found:
        """The layout found from one at random; raises InputError where there is no room."""
        layout = self._numbers(self.problem.random_layout(rng), self._places)
        return self.refine(self.exchange(layout))

    def add(self, layout: Sequence[int]) -> tuple[int, ...]:
        """Add the best candidate."""
        tried = [(*layout, each) for each in self._open(layout)]
        return best_by(tried, self.value)

    def exchange(self, layout: Sequence[int], *, sweeps: int = MAX_SWEEPS) -> tuple[int, ...]:
        """Move one ERA after the other to the best candidate, until none gains."""
        best = tuple(layout)
        unchanged = 0
        for step in range(sweeps * len(best)):
            number = step % len(best)
            if number < self._k:
                continue
            rest = best[:number] + best[number + 1 :]
            tried = [(*best[:number], each, *best[number + 1 :]) for each in self._open(rest)]
            found = best_by(tried, self.value)
            gains = self.value(found) > self.value(best) + _GAIN
            best, unchanged = (found, 0) if gains else (best, unchanged + 1)
            if unchanged >= len(best) - self._k:
                break
        return best

    def one_more(self, positions: FloatArray) -> Found | None:
        """Add the best candidate to positions (n, 2) [m], then move all; None without room."""
        try:
            open_ = self.problem.open_candidates(positions)
        except InputError:
            return None
        tried = [np.vstack([positions, self.problem.candidates[each]]) for each in open_]
        best = best_by(self.scored(tried), lambda found: found.score_db)
        return self._refined(best.positions)

    def refine(self, layout: Sequence[int]) -> Found:
        """Move the places of a layout freely by ever smaller steps."""
        return self._refined(self._places.at[list(layout)])

    def scored(self, layouts: Sequence[FloatArray]) -> list[Found]:
        """The score of each of some layouts (n, 2) [m], as it is."""
        if not layouts:
            return []
        every = np.unique(np.vstack(layouts), axis=0)
        is_known = (every[:, None] == self._places.at).all(axis=-1).any(axis=1).all()
        places = self._places if is_known else self._scorer.places(every)
        return [
            Found(each, self._value_at(places, self._numbers(each, places))) for each in layouts
        ]

    def sensitivities(self, positions: FloatArray, *, step: float) -> FloatArray:
        """The most that the score [dB] changes by a step [m] of each ERA, per metre, (n,)."""
        (own,) = self.scored([positions])
        changes = np.zeros(len(positions))
        for number, place in enumerate(positions):
            found = self.scored(_replaced(positions, number, self._steps(place, step)))
            supported = [abs(each.score_db - own.score_db) for each in found if each.is_supported]
            changes[number] = max(supported, default=0.0) / step
        return changes

    def value(self, layout: tuple[int, ...]) -> float:
        """Score [dB] of a layout of numbers of places, far below 0 if it does not support."""
        key = layout[: self._k] + tuple(sorted(layout[self._k :]))
        if key not in self._known:
            self._known[key] = self._value_at(self._places, key)
        return self._known[key]

    def _refined(self, positions: FloatArray) -> Found:
        (best,) = self.scored([positions])
        step = self.problem.spacing / 2
        while step >= FINEST_STEP / 2:
            before = best.score_db
            for number in range(self._k, len(positions)):
                moves = self.problem.area.moved(best.positions[number], step)
                tried = _replaced(best.positions, number, moves)
                found = self.scored([each for each in tried if self.problem.are_apart(each)])
                for each in found:
                    if each.score_db > best.score_db + _GAIN:
                        best = each
            if best.score_db <= before + _GAIN:
                step /= 2
        return best

    def _steps(self, place: FloatArray, step: float) -> FloatArray:
        """Steps of a place within the area, or of one outside it anywhere on the plate."""
        area, plate = self.problem.area, self.problem.rig.plate
        if area.contains(place[None])[0]:
            found = area.moved(place, step)
            if len(found):
                return found
        return area_of(ANYWHERE, plate).moved(place, step)

    def _value_at(self, places: Places, chosen: Iterable[int]) -> float:
        numbers = np.asarray(chosen)
        if len(numbers) + self.problem.supports >= MIN_SUPPORTING:
            shortfall = self.problem.shortfall(places.at[numbers])
            if shortfall > 0:
                return _UNSUPPORTED * (1 + shortfall)
        return self._score_at(places, numbers)

    def _score_at(self, places: Places, chosen: IntArray) -> float:
        count = len(chosen)
        if count not in self._mounts:
            self._mounts[count] = self._scorer.mounts(self.problem.eras(np.zeros((count, 2))))
        return self._scorer.mean(places, chosen, self._mounts[count])

    def _open(self, layout: Sequence[int]) -> list[int]:
        """Numbers of places far enough from the ERAs of a layout; raises InputError for none."""
        found = self.problem.open_candidates(self._places.at[list(layout)])
        return [self._k + number for number in found.tolist()]

    @staticmethod
    def _numbers(positions: FloatArray, places: Places) -> list[int]:
        """Numbers of positions (n, 2) [m] among places that have them."""
        return [int((places.at == at).all(axis=1).argmax()) for at in positions]


def _replaced(positions: FloatArray, number: int, places: FloatArray) -> list[FloatArray]:
    """Positions (n, 2) with that of one ERA at each of some places (m, 2)."""
    at = np.arange(len(positions))[:, None] == number
    return [np.where(at, place, positions) for place in places]
