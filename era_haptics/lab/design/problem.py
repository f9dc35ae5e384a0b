"""Design problem: a rig's plate, the number of its ERAs, their area, and the contacts they serve.

A layout supports the plate if the lowest rigid-body mode is high enough and every ERA carries
weight.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from era_haptics.lab.design.contact_rule import ContactRule
from era_haptics.lab.design.era_area import EDGE, Area, candidates_of
from model.arrays import FloatArray, IntArray, least_gap
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.exciter import Actuator
from model.structure.statics import rigid_body_frequencies, static_loads
from model.table.table import default_drive_frequencies

DEFAULT_LOWEST = 20.0
"""Minimum natural frequency of the plate on its ERAs [Hz]; it sags by 0.6 mm under its weight."""

DEFAULT_ERA_GAP = 0.03
"""Minimum distance between two ERAs [m]."""

MIN_SUPPORTING = 3
"""Minimum number of ERAs and other mounts that support a plate."""

EDGE_CANDIDATES, AREA_CANDIDATES = 48, 80
"""Number of candidates along the edge, and over any other area."""

SEARCH_FINGERS, SEARCH_FREQUENCIES = 32, 16

JUDGED_SETS = 200
"""Number of contact sets for full evaluation, separate from the search's sets."""

_JUDGED_SEED = 0x5EED  # any fixed number: added to the seed, so that sets differ from the search's
_ROUNDING = (
    1e-9  # of the mean load; smaller negative loads count as zero, since an ERA can be unloaded
)
_UNSTABLE_FREQUENCY = 1e-3  # Hz; below this frequency, the plate falls or tips
_UNSTABLE_DEFICIT = 2.0
_MAX_NAMES = 999


def support_deficit(rig: Rig, eras: Sequence[Actuator], *, lowest: float) -> float:
    """Return by how much ERAs fail to support a rig's plate, 0 if they support it.

    lowest [Hz]: minimum rigid-body frequency. The plate's weight must not pull any mount upwards,
    so that the center of mass is within them and the plate does not tip. The deficit is the missing
    fraction of the frequency, plus the largest pull relative to the mean load.
    """
    frequency = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    if frequency < _UNSTABLE_FREQUENCY:
        return _UNSTABLE_DEFICIT
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    pull = -float(loads.min() / loads.mean())
    if pull <= _ROUNDING:
        pull = 0.0
    return max(0.0, 1 - frequency / lowest) + pull


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """Requested design.

    - kept: names of the rig's ERAs that keep their positions.
    - count: number of all ERAs.
    - apart [m]: minimum distance between ERAs.
    - lowest [Hz]: minimum rigid-body frequency.
    - seed: of the search's contact sets and of random layouts; the sets for full evaluation, and
      every random start of a search, have a seed that is derived from it.
    - stiffness [N/m]: stiffness of ERAs that are not kept; None: the rig's.

    Raises InputError for too few ERAs to support the plate.
    """

    rig: Rig
    count: int
    area: Area
    contacts: ContactRule
    kept: tuple[str, ...] = ()
    apart: float = DEFAULT_ERA_GAP
    lowest: float = DEFAULT_LOWEST
    seed: int = 0
    stiffness: float | None = None

    def __post_init__(self) -> None:
        """Check the number of ERAs."""
        if self.count + self.supports < MIN_SUPPORTING:
            raise InputError(
                f"eras must be at least {MIN_SUPPORTING - self.supports} to support the plate, "
                f"got {self.count}"
            )

    # ERAs

    @property
    def supports(self) -> int:
        """Number of mounts other than the ERAs."""
        return sum(load.stiffness > 0 for load in self.rig.masses)

    @property
    def kept_positions(self) -> FloatArray:
        """Positions of the kept ERAs [m], (k, 2)."""
        eras = [self.rig.era(name) for name in self.kept]
        return np.array([[era.x, era.y] for era in eras]).reshape(-1, 2)

    @property
    def own_positions(self) -> FloatArray:
        """Positions of the rig's own ERAs [m], (eras, 2)."""
        return np.array([[era.x, era.y] for era in self.rig.eras])

    @property
    def like(self) -> Actuator:
        """The rig's ERA that serves as the template for new ones."""
        return next((era for era in self.rig.eras if era.name not in self.kept), self.rig.eras[0])

    def eras(self, positions: FloatArray) -> tuple[Actuator, ...]:
        """Return ERAs at positions [m] (n, 2): the kept ones, then copies of the first that is not
        kept.

        Copies are named E1, E2, ..., skipping names of kept ERAs.
        """
        template = self.like
        if self.stiffness is not None:
            template = replace(template, stiffness=self.stiffness)
        eras = [self.rig.era(name) for name in self.kept]
        names = self._new_names()
        for x, y in positions[len(self.kept) :].tolist():
            eras.append(replace(template, name=next(names), x=x, y=y))
        return tuple(eras)

    def _new_names(self) -> Iterator[str]:
        """Yield names of new ERAs."""
        for number in range(1, _MAX_NAMES):
            name = f"E{number}"
            if name not in self.kept:
                yield name

    def rig_with(self, positions: FloatArray) -> Rig:
        """The rig with ERAs at positions, without wiring."""
        return replace(self.rig, eras=self.eras(positions), wiring={}, amplifiers={})

    def support_deficit(self, positions: FloatArray) -> float:
        """Return by how much ERAs at positions fail to support the plate, 0 if they support it."""
        return support_deficit(self.rig, self.eras(positions), lowest=self.lowest)

    # Evaluation

    @property
    def searched_frequencies(self) -> FloatArray:
        """Frequencies of the scores [Hz], a subset of the rig's table frequencies, (f,).

        Their number is proportional to the number of contents, since each content needs separate
        frequencies: for three contents, scores at all 47 frequencies correlate with answers by
        0.83, at 16 by 0.49 (16 layouts of four ERAs).
        """
        frequencies = default_drive_frequencies(self.rig.limits)
        count = min(len(frequencies), SEARCH_FREQUENCIES * self.contacts.contents)
        numbers = np.linspace(0, len(frequencies) - 1, count).round()
        return np.asarray(frequencies[numbers.astype(int)])

    def judged_sets(self) -> list[FloatArray]:
        """Contact sets that no search has used, (fingers, 2) [m] each."""
        return self.contacts.sets(JUDGED_SETS, seed=self.seed + _JUDGED_SEED)

    # Candidates

    @property
    def candidates(self) -> FloatArray:
        """Start positions of a search [m], (c, 2); raises InputError for an empty set."""
        return self._raster[0]

    @property
    def spacing(self) -> float:
        """Distance [m] of candidates."""
        return self._raster[1]

    @cached_property
    def _raster(self) -> tuple[FloatArray, float]:
        is_edge = self.area.text == EDGE
        return candidates_of(self.area, count=EDGE_CANDIDATES if is_edge else AREA_CANDIDATES)

    def open_candidates(self, positions: FloatArray) -> IntArray:
        """Return the numbers of candidates far enough from positions (n, 2) [m].

        Raises InputError without any.
        """
        gaps = np.linalg.norm(self.candidates[:, None] - positions, axis=-1)
        numbers = np.flatnonzero(gaps.min(axis=1, initial=np.inf) >= self.apart)
        if not len(numbers):
            raise InputError(
                f"where must have room for {self.count} ERAs {1000 * self.apart:g} mm apart, found "
                f"room for {len(positions)}; enlarge it, or reduce eras or apart"
            )
        return numbers

    def are_apart(self, positions: FloatArray) -> bool:
        """Return whether positions (n, 2) [m] keep the minimum distance."""
        return least_gap(positions) >= self.apart

    def random_layout(self, rng: np.random.Generator) -> FloatArray:
        """Draw a layout at candidates far enough apart, kept ERAs first: (count, 2) [m].

        Raises InputError if there is no room for that many.
        """
        positions = self.kept_positions
        while len(positions) < self.count:
            number = rng.choice(self.open_candidates(positions))
            positions = np.vstack([positions, self.candidates[number]])
        return positions
