"""Search for the places of ERAs: greedy, then exchange, then places moved freely.

Greedy adds the candidate that raises the score most; an exchange moves one ERA at a time to the
best candidate until none gains; then every ERA is moved by ever smaller steps, no longer bound to
the candidates.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import FloatArray, IntArray
from model.choice import best_by, best_of
from model.design.area import Area, Within, candidates_of, everywhere
from model.design.contacts import ContactRule
from model.design.places import DesignPlate, Places
from model.design.score import Mounts, Scorer
from model.design.support import MIN_SUPPORTING, SupportRule
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.actuator import Era
from model.table.table import default_drive_frequencies

CANDIDATES = {True: 48, False: 80}
"""Candidates along the edge, and over an area."""

SEARCH_FINGERS, SEARCH_FREQUENCIES = 32, 16

MAX_SWEEPS = 4
"""Exchanges of every ERA."""

FINEST_STEP = 0.001
"""Last step [m] of freely moved places."""

_GAIN = 0.01  # dB; smaller ones are not worth a move
_UNSUPPORTED = -100.0  # dB; below every layout that supports the plate


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What is sought.

    kept: ERAs of the rig that stay, by name; count: of all ERAs; apart [m]: least distance of two;
    lowest [Hz]: least rigid-body frequency; stiffness [N/m]: of ERAs that do not stay, None: that
    of the rig's. Raises InputError for fewer ERAs than can support the plate.
    """

    rig: Rig
    count: int
    kept: tuple[str, ...]
    area: Area
    contacts: ContactRule
    apart: float
    lowest: float
    seed: int
    stiffness: float | None = None

    def __post_init__(self) -> None:
        """Check the number of ERAs."""
        if self.count + self.supports < MIN_SUPPORTING:
            raise InputError(
                f"--eras must be at least {MIN_SUPPORTING - self.supports} to support the plate, "
                f"got {self.count}"
            )

    @property
    def supports(self) -> int:
        """Mounts beside the ERAs."""
        return sum(load.stiffness > 0 for load in self.rig.masses)

    @property
    def kept_eras(self) -> tuple[Era, ...]:
        """ERAs that stay."""
        return tuple(self.rig.era(name) for name in self.kept)

    @property
    def like(self) -> Era:
        """The rig's ERA like which those are that do not stay."""
        return next((era for era in self.rig.eras if era.name not in self.kept), self.rig.eras[0])

    def eras(self, positions: FloatArray) -> tuple[Era, ...]:
        """ERAs at positions [m] (n, 2): those kept, and more like the first of the others.

        Named E1, E2, ... by names that no kept ERA has.
        """
        kept, like = self.kept_eras, self.like
        if self.stiffness is not None:
            like = replace(like, stiffness=self.stiffness)
        names = (name for number in range(1, 999) if (name := f"E{number}") not in self.kept)
        return kept + tuple(
            replace(like, name=next(names), x=float(x), y=float(y))
            for x, y in positions[len(kept) :]
        )

    def rig_with(self, positions: FloatArray) -> Rig:
        """The rig with ERAs at positions, without wiring."""
        return replace(self.rig, eras=self.eras(positions), wiring={}, amplifiers={})


@dataclass(frozen=True, eq=False)
class Found:
    """A layout: positions (n, 2) [m], those kept first, and its score [dB]."""

    positions: FloatArray
    score_db: float

    @property
    def is_supported(self) -> bool:
        """Whether it supports the plate."""
        return self.score_db > _UNSUPPORTED


def search_frequencies(rig: Rig) -> FloatArray:
    """Frequencies [Hz] of the scores of a rig's layouts, some of those of its tables, (f,)."""
    every = default_drive_frequencies(rig.limits)
    chosen = np.linspace(0, len(every) - 1, min(len(every), SEARCH_FREQUENCIES)).round()
    return np.asarray(every[chosen.astype(int)])


class LayoutSearch:
    """Searches layouts of one problem; scores are of contact sets drawn by its seed."""

    def __init__(self, problem: DesignProblem) -> None:
        """Solve the plate for all candidates; raises InputError for an area without room."""
        self.problem = problem
        rig = problem.rig
        sets = problem.contacts.pooled_sets(SEARCH_FINGERS, seed=problem.seed)
        self._plate = DesignPlate(rig, search_frequencies(rig), sets)
        self._scorer = Scorer(self._plate)
        self._rule = SupportRule(rig, problem.lowest)
        is_area = isinstance(problem.area, Within)
        self._candidates = candidates_of(problem.area, rig.plate, count=CANDIDATES[not is_area])
        self.spacing = _spacing(self._candidates)
        kept = np.array([[era.x, era.y] for era in problem.kept_eras]).reshape(-1, 2)
        self._k = len(kept)
        self._places = self._plate.places(np.vstack([kept, self._candidates]))
        self._mounts: dict[int, Mounts] = {}
        self._known: dict[tuple[int, ...], float] = {}

    def kept_layout(self) -> tuple[int, ...]:
        """Only what is kept, as numbers of places."""
        return tuple(range(self._k))

    def random_layout(self, rng: np.random.Generator) -> tuple[int, ...]:
        """Candidates at random, far enough apart.

        Raises InputError where there is no room for so many.
        """
        layout = self.kept_layout()
        while len(layout) < self.problem.count:
            open_ = self._open(layout)
            layout = (*layout, int(rng.choice(open_)))
        return layout

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
            found = best_by(tried, self.value) if tried else best
            gains = self.value(found) > self.value(best) + _GAIN
            best, unchanged = (found, 0) if gains else (best, unchanged + 1)
            if unchanged >= len(best) - self._k:
                break
        return best

    def one_more(self, positions: FloatArray) -> Found | None:
        """Add the best candidate to positions (n, 2) [m], then move all; None without room."""
        every = np.vstack([positions, self._candidates])
        gaps = np.linalg.norm(every[:, None] - positions, axis=-1).min(axis=1)
        open_ = np.flatnonzero(gaps >= self.problem.apart)
        if not len(open_):
            return None
        places = self._plate.places(every)
        own = np.arange(len(positions))
        best = open_[best_of([self._value_at(places, [*own, each]) for each in open_.tolist()])]
        return self._refined(np.vstack([positions, every[best]]))

    def refine(self, layout: Sequence[int]) -> Found:
        """Move the places of a layout freely by ever smaller steps."""
        return self._refined(self._places.at[list(layout)])

    def _refined(self, positions: FloatArray) -> Found:
        value = self.at(positions)
        step = self.spacing / 2
        while step >= FINEST_STEP / 2:
            positions, moved = self._moved(positions, step)
            if moved <= value + _GAIN:
                step /= 2
            value = max(value, moved)
        return Found(positions, value)

    def sensitivities(self, positions: FloatArray, *, step: float) -> FloatArray:
        """The most that the score [dB] changes by a step [m] of each ERA, per metre, (n,)."""
        moves = [self._steps(place, step) for place in positions]
        places = self._plate.places(np.vstack([positions, *moves]))
        layout = np.arange(len(positions))
        own = self._value_at(places, layout)
        changes, start = np.zeros(len(positions)), len(positions)
        for number, options in enumerate(moves):
            for row in range(start, start + len(options)):
                tried = np.where(layout == number, row, layout)
                change = abs(self._score_at(places, tried) - own)
                changes[number] = max(changes[number], change / step)
            start += len(options)
        return changes

    def value(self, layout: tuple[int, ...]) -> float:
        """Score [dB] of a layout of numbers of places, far below 0 if it does not support."""
        key = layout[: self._k] + tuple(sorted(layout[self._k :]))
        if key not in self._known:
            self._known[key] = self._value_at(self._places, np.array(key))
        return self._known[key]

    def at(self, positions: FloatArray) -> float:
        """Score [dB] of any positions [m] (n, 2)."""
        return self._value_at(self._plate.places(positions), np.arange(len(positions)))

    def _moved(self, positions: FloatArray, step: float) -> tuple[FloatArray, float]:
        """Positions after at most one step of each ERA that is not kept, and their value."""
        moves = [
            self.problem.area.moved(place, step) if number >= self._k else np.empty((0, 2))
            for number, place in enumerate(positions)
        ]
        places = self._plate.places(np.vstack([positions, *moves]))
        layout = np.arange(len(positions))
        value, start = self._value_at(places, layout), len(positions)
        for number, options in enumerate(moves):
            for row in range(start, start + len(options)):
                tried = layout.copy()
                tried[number] = row
                if not self._far_enough(places.at[tried]):
                    continue
                worth = self._value_at(places, tried)
                if worth > value + _GAIN:
                    value, layout = worth, tried
            start += len(options)
        return places.at[layout], value

    def _steps(self, place: FloatArray, step: float) -> FloatArray:
        """Steps of a place within the area, or of one outside it anywhere on the plate."""
        area, plate = self.problem.area, self.problem.rig.plate
        if area.contains(place[None])[0]:
            found = area.moved(place, step)
            if len(found):
                return found
        return Within(plate.length, plate.width, everywhere).moved(place, step)

    def _value_at(self, places: Places, chosen: Iterable[int]) -> float:
        numbers = np.asarray(chosen)
        if len(numbers) + self.problem.supports >= MIN_SUPPORTING:
            shortfall = self._rule.shortfall(self.problem.eras(places.at[numbers]))
            if shortfall > 0:
                return _UNSUPPORTED * (1 + shortfall)
        return self._score_at(places, numbers)

    def _score_at(self, places: Places, chosen: IntArray) -> float:
        count = len(chosen)
        if count not in self._mounts:
            eras = self.problem.eras(np.zeros((count, 2)))
            self._mounts[count] = self._scorer.mounts(eras)
        return self._scorer.mean(places, chosen, self._mounts[count])

    def _open(self, layout: Sequence[int]) -> list[int]:
        """Numbers of candidates far enough from the ERAs of a layout.

        Raises InputError where there are none.
        """
        every = self._places.at
        gaps = np.linalg.norm(every[:, None] - every[list(layout)], axis=-1)
        is_open = gaps.min(axis=1, initial=np.inf) >= self.problem.apart
        is_open[: self._k] = False
        found = np.flatnonzero(is_open).tolist()
        if not found:
            raise InputError(
                f"--where must have room for {self.problem.count} ERAs "
                f"{1000 * self.problem.apart:g} mm apart, got room for {len(layout)}; enlarge it, "
                "or lower --eras or --apart"
            )
        return found

    def _far_enough(self, positions: FloatArray) -> bool:
        gaps = np.linalg.norm(positions[:, None] - positions, axis=-1)
        return bool(gaps[np.triu_indices(len(gaps), 1)].min(initial=np.inf) >= self.problem.apart)


def _spacing(places: FloatArray) -> float:
    """Median distance [m] of a place to its nearest neighbour."""
    gaps = np.linalg.norm(places[:, None] - places, axis=-1)
    np.fill_diagonal(gaps, np.inf)
    nearest = np.minimum(gaps.min(axis=1), 0.1)
    return float(np.median(nearest))
