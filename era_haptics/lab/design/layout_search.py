"""Search for ERA positions that maximize the score.

The search adds, one ERA after the other, the candidate that raises the score most. Exchanges then
move one ERA at a time to the best candidate until none improves. Finally every ERA is moved by ever
smaller steps, independently of the candidates. A list of layouts is a search without steps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from era_haptics.lab.design.era_area import ANYWHERE, area_of
from era_haptics.lab.design.problem import MIN_SUPPORTING, SEARCH_FINGERS, DesignProblem
from era_haptics.lab.design.score import PlaceReceptances, Scorer
from model.arrays import FloatArray, best_by
from model.errors import InputError

MAX_SWEEPS = 4
"""Exchanges of every ERA."""

FINEST_STEP = 0.001
"""Last step of freely moved positions [m]."""

_MIN_GAIN = 0.01  # dB; smaller gains do not justify a move
_UNSUPPORTED = -100.0  # dB; below the score of every layout that supports the plate


@dataclass(frozen=True, eq=False)
class ScoredLayout:
    """Layout with positions (n, 2) [m], kept ones first, and its score [dB]."""

    positions: FloatArray
    score_db: float

    @property
    def is_supported(self) -> bool:
        """Return whether it supports the plate."""
        return self.score_db > _UNSUPPORTED

    def is_above(self, other: "ScoredLayout") -> bool:
        """Return whether its score is high enough to justify a move from another layout."""
        return self.score_db > other.score_db + _MIN_GAIN


class LayoutSearch:
    """Searches layouts of a problem; its seed draws the contact sets for the scores."""

    def __init__(self, problem: DesignProblem) -> None:
        """Solve the plate for all candidates; raises InputError for an area without room."""
        self.problem = problem
        kept_positions = problem.kept_positions
        self._kept_count = len(kept_positions)
        self._scorer = Scorer(
            problem.rig,
            problem.searched_frequencies,
            problem.contacts.pooled_sets(SEARCH_FINGERS, seed=problem.seed),
            eras=problem.eras(np.zeros((self._kept_count + 1, 2))),
            contents=problem.contacts.contents,
        )
        self._places = self._scorer.places(np.vstack([kept_positions, problem.candidates]))

    # Searches

    def path(self) -> Iterator[ScoredLayout]:
        """Yield layouts with increasing numbers of ERAs, starting with the kept or the minimum
        number."""
        problem = self.problem
        positions = problem.kept_positions
        while len(positions) < problem.count:
            positions = self.add(positions).positions
            if len(positions) + problem.supports >= MIN_SUPPORTING:
                is_last = len(positions) == problem.count
                positions = self.exchange(positions, sweeps=2 if is_last else 1)
                yield self.refine(positions)
        if len(positions) == self._kept_count:
            yield self.refine(positions)

    def from_random(self, rng: np.random.Generator) -> ScoredLayout:
        """Search from a random layout; raises InputError if there is no room."""
        return self.refine(self.exchange(self.problem.random_layout(rng)))

    def one_more(self, positions: FloatArray) -> ScoredLayout | None:
        """Add the best candidate to positions (n, 2) [m], then move all ERAs; None without room."""
        try:
            return self.refine(self.add(positions).positions)
        except InputError:
            return None

    # Steps

    def add(self, positions: FloatArray) -> ScoredLayout:
        """Add the best candidate to positions (n, 2) [m]; raises InputError without room."""
        trials = [np.vstack([positions, place]) for place in self._open(positions)]
        return best_by(self.scored(trials), _score_of)

    def exchange(self, positions: FloatArray, *, sweeps: int = MAX_SWEEPS) -> FloatArray:
        """Move one ERA after the other to the best candidate, until none gains, (n, 2) [m]."""
        (best,) = self.scored([positions])
        movable = range(self._kept_count, len(positions))
        unchanged = 0
        for number in sweeps * list(movable):
            fixed = np.delete(best.positions, number, axis=0)
            trials = _moved_to(best.positions, number, self._open(fixed))
            candidate = best_by(self.scored(trials), _score_of)
            if candidate.is_above(best):
                best = candidate
                unchanged = 0
            else:
                unchanged += 1
            if unchanged >= len(movable):
                break
        return best.positions

    def refine(self, positions: FloatArray) -> ScoredLayout:
        """Refine positions (n, 2) [m] by ever smaller steps."""
        (best,) = self.scored([positions])
        step = self.problem.spacing / 2
        while step >= FINEST_STEP / 2:
            refined = best
            for number in range(self._kept_count, len(positions)):
                refined = self._best_move(refined, number, step)
            if not refined.is_above(best):
                step /= 2
            best = refined
        return best

    def _best_move(self, layout: ScoredLayout, number: int, step: float) -> ScoredLayout:
        """Return the best layout after moving an ERA by a step [m]; the same if no step gains."""
        places = self.problem.area.moved(layout.positions[number], step)
        trials = _moved_to(layout.positions, number, places)
        best = layout
        for trial in self.scored([trial for trial in trials if self.problem.are_apart(trial)]):
            if trial.is_above(best):
                best = trial
        return best

    def _open(self, positions: FloatArray) -> FloatArray:
        """Return the candidates [m] far enough from positions (n, 2) [m]; raises InputError for
        none."""
        return self.problem.candidates[self.problem.open_candidates(positions)]

    # Scores

    def scored(self, layouts: Sequence[FloatArray]) -> list[ScoredLayout]:
        """Score layouts (n, 2) [m] without changing them."""
        if not layouts:
            return []
        positions = np.unique(np.vstack(layouts), axis=0)
        is_solved = (positions[:, None] == self._places.at).all(axis=-1).any(axis=1).all()
        places = self._places if is_solved else self._scorer.places(positions)
        return [ScoredLayout(layout, self._score_at(places, layout)) for layout in layouts]

    def _score_at(self, places: PlaceReceptances, positions: FloatArray) -> float:
        """Return the score [dB] of positions among `places`, far below 0 if the plate is not
        supported."""
        if len(positions) + self.problem.supports >= MIN_SUPPORTING:
            deficit = self.problem.support_deficit(positions)
            if deficit > 0:
                return _UNSUPPORTED * (1 + deficit)
        numbers = (places.at == positions[:, None]).all(axis=-1).argmax(axis=1)
        return self._scorer.mean(places, numbers)

    def sensitivities(self, positions: FloatArray, *, step: float) -> FloatArray:
        """Return the largest change of the score [dB] per meter for a step [m] of each ERA,
        (n,)."""
        (own,) = self.scored([positions])
        changes = np.zeros(len(positions))
        for number, place in enumerate(positions):
            trials = _moved_to(positions, number, self._steps(place, step))
            supported = [trial for trial in self.scored(trials) if trial.is_supported]
            differences = [abs(trial.score_db - own.score_db) for trial in supported]
            changes[number] = max(differences, default=0.0) / step
        return changes

    def _steps(self, place: FloatArray, step: float) -> FloatArray:
        """Return steps of a position within the area; anywhere on the plate if it is outside the
        area."""
        area = self.problem.area
        if area.contains(place[None])[0]:
            places = area.moved(place, step)
            if len(places):
                return places
        return area_of(ANYWHERE, self.problem.rig.plate).moved(place, step)


def _score_of(layout: ScoredLayout) -> float:
    return layout.score_db


def _moved_to(positions: FloatArray, number: int, places: FloatArray) -> list[FloatArray]:
    """Return positions (n, 2) with one ERA moved to each of the places (m, 2)."""
    is_moved = np.arange(len(positions))[:, None] == number
    return [np.where(is_moved, place, positions) for place in places]
