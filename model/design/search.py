"""Search for the places of ERAs: greedy, then exchange, then places moved freely.

Greedy adds the candidate that raises the score most; an exchange moves one ERA at a time to the
best candidate until none gains; then every ERA is moved by ever smaller steps, no longer bound to
the candidates. A list of layouts is a search without steps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray, best_by
from model.design import problem as design_problem
from model.design.area import ANYWHERE, area_of
from model.design.problem import MIN_SUPPORTING, DesignProblem
from model.design.score import Places, Scorer
from model.errors import InputError

MAX_SWEEPS = 4
"""Exchanges of every ERA."""

FINEST_STEP = 0.001
"""Last step [m] of freely moved places."""

_GAIN = 0.01  # dB; smaller ones are not worth a move
_UNSUPPORTED = -100.0  # dB; below every layout that supports the plate


@dataclass(frozen=True, eq=False)
class ScoredLayout:
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
        kept = problem.kept_positions
        self._k = len(kept)
        self._scorer = Scorer(
            problem.rig,
            problem.searched_frequencies,
            problem.contacts.pooled_sets(design_problem.SEARCH_FINGERS, seed=problem.seed),
            eras=problem.eras(np.zeros((self._k + 1, 2))),
            contents=problem.contacts.contents,
        )
        self._places = self._scorer.places(np.vstack([kept, problem.candidates]))

    def path(self) -> Iterator[ScoredLayout]:
        """Layouts of ever more ERAs, from those kept or as few as support the plate."""
        problem, positions = self.problem, self.problem.kept_positions
        while len(positions) < problem.count:
            positions = self.add(positions).positions
            if len(positions) + problem.supports >= MIN_SUPPORTING:
                positions = self.exchange(positions, sweeps=1 + (len(positions) == problem.count))
                yield self.refine(positions)
        if len(positions) == self._k:
            yield self.refine(positions)

    def from_random(self, rng: np.random.Generator) -> ScoredLayout:
        """The layout found from one at random; raises InputError where there is no room."""
        return self.refine(self.exchange(self.problem.random_layout(rng)))

    def add(self, positions: FloatArray) -> ScoredLayout:
        """Add the best candidate to positions (n, 2) [m]; raises InputError without room."""
        tried = [np.vstack([positions, place]) for place in self._open(positions)]
        return best_by(self.scored(tried), _score)

    def exchange(self, positions: FloatArray, *, sweeps: int = MAX_SWEEPS) -> FloatArray:
        """Move one ERA after the other to the best candidate, until none gains, (n, 2) [m]."""
        (best,) = self.scored([positions])
        unchanged, count = 0, len(positions)
        for number in sweeps * list(range(self._k, count)):
            rest = np.delete(best.positions, number, axis=0)
            tried = _replaced(best.positions, number, self._open(rest))
            found = best_by(self.scored(tried), _score)
            gains = found.score_db > best.score_db + _GAIN
            best, unchanged = (found, 0) if gains else (best, unchanged + 1)
            if unchanged >= count - self._k:
                break
        return best.positions

    def one_more(self, positions: FloatArray) -> ScoredLayout | None:
        """Add the best candidate to positions (n, 2) [m], then move all; None without room."""
        try:
            return self.refine(self.add(positions).positions)
        except InputError:
            return None

    def refine(self, positions: FloatArray) -> ScoredLayout:
        """Move positions (n, 2) [m] freely by ever smaller steps."""
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

    def scored(self, layouts: Sequence[FloatArray]) -> list[ScoredLayout]:
        """The score of each of some layouts (n, 2) [m], as it is."""
        if not layouts:
            return []
        every = np.unique(np.vstack(layouts), axis=0)
        is_known = (every[:, None] == self._places.at).all(axis=-1).any(axis=1).all()
        places = self._places if is_known else self._scorer.places(every)
        return [ScoredLayout(each, self._score_at(places, each)) for each in layouts]

    def sensitivities(self, positions: FloatArray, *, step: float) -> FloatArray:
        """The most that the score [dB] changes by a step [m] of each ERA, per metre, (n,)."""
        (own,) = self.scored([positions])
        changes = np.zeros(len(positions))
        for number, place in enumerate(positions):
            found = self.scored(_replaced(positions, number, self._steps(place, step)))
            supported = [abs(each.score_db - own.score_db) for each in found if each.is_supported]
            changes[number] = max(supported, default=0.0) / step
        return changes

    def _steps(self, place: FloatArray, step: float) -> FloatArray:
        """Steps of a place within the area, or of one outside it anywhere on the plate."""
        area, plate = self.problem.area, self.problem.rig.plate
        if area.contains(place[None])[0]:
            found = area.moved(place, step)
            if len(found):
                return found
        return area_of(ANYWHERE, plate).moved(place, step)

    def _score_at(self, places: Places, positions: FloatArray) -> float:
        """Score [dB] of positions among places, far below 0 if they do not support the plate."""
        if len(positions) + self.problem.supports >= MIN_SUPPORTING:
            shortfall = self.problem.shortfall(positions)
            if shortfall > 0:
                return _UNSUPPORTED * (1 + shortfall)
        numbers = (places.at == positions[:, None]).all(axis=-1).argmax(axis=1)
        return self._scorer.mean(places, numbers)

    def _open(self, positions: FloatArray) -> FloatArray:
        """Candidates [m] far enough from positions (n, 2) [m]; raises InputError for none."""
        return self.problem.candidates[self.problem.open_candidates(positions)]


def _score(found: ScoredLayout) -> float:
    return found.score_db


def _replaced(positions: FloatArray, number: int, places: FloatArray) -> list[FloatArray]:
    """Positions (n, 2) with that of one ERA at each of some places (m, 2)."""
    at = np.arange(len(positions))[:, None] == number
    return [np.where(at, place, positions) for place in places]
