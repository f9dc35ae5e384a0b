"""What is sought: a number of ERAs, where they may stand, and the contacts they serve.

A layout supports the plate by its lowest rigid-body mode, and with weight on every ERA. Layouts to
be ranked are those of a file, or the rig's own, those with a name, and random ones.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from model.arrays import FloatArray, IntArray, least_gap
from model.config.document import read_document
from model.config.fields import PointSection, Section, Validation
from model.design.area import EDGE, Area, candidates_of
from model.design.contacts import ContactRule
from model.errors import InputError
from model.rig.rig import Rig, named_layouts
from model.structure.attachments import rigid_body_frequencies, static_loads
from model.structure.exciter import Actuator
from model.table.table import default_drive_frequencies

DEFAULT_LOWEST = 20.0
"""Lowest natural frequency [Hz] of the plate on its ERAs: it sags by 0.6 mm under its weight."""

MIN_SUPPORTING = 3
"""ERAs, and other mounts, that can support a plate."""

_ROUNDING = 1e-9  # share of the mean load below which a pull is none: an ERA may carry nothing


def shortfall(rig: Rig, eras: Sequence[Actuator], *, lowest: float) -> float:
    """How far ERAs are from supporting a rig's plate, 0 if they do.

    lowest [Hz]: least rigid-body frequency. No mount may be pulled upwards by the plate's weight,
    so that the centre of mass is within them and the plate does not tip.
    """
    frequency = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    if frequency < 1e-3:
        return 2.0
    loads = static_loads(rig.plate, eras, loads=rig.masses)
    pulled = -float(loads.min() / loads.mean())
    return max(0.0, 1 - frequency / lowest) + (pulled if pulled > _ROUNDING else 0.0)


CANDIDATES = {True: 48, False: 80}
"""Candidates along the edge, and over an area."""

SEARCH_FINGERS, SEARCH_FREQUENCIES = 32, 16

JUDGED_SETS = 200
"""Contact sets by which layouts are judged, other than those of the search."""

DEFAULT_APART = 0.03
"""Least distance [m] of two ERAs."""

_JUDGED_SEED = 0x5EED  # added to that of a search, whose own sets are others


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What is sought.

    kept: ERAs of the rig that stay, by name; count: of all ERAs; apart [m]: least distance of two;
    lowest [Hz]: least rigid-body frequency; stiffness [N/m]: of ERAs that do not stay, None: that
    of the rig's. Raises InputError for fewer ERAs than can support the plate.
    """

    rig: Rig
    count: int
    area: Area
    contacts: ContactRule
    kept: tuple[str, ...] = ()
    apart: float = DEFAULT_APART
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

    @property
    def supports(self) -> int:
        """Mounts beside the ERAs."""
        return sum(load.stiffness > 0 for load in self.rig.masses)

    @property
    def kept_positions(self) -> FloatArray:
        """Places [m] of the ERAs that stay, (k, 2)."""
        eras = [self.rig.era(name) for name in self.kept]
        return np.array([[era.x, era.y] for era in eras]).reshape(-1, 2)

    @property
    def own_positions(self) -> FloatArray:
        """Places [m] of the rig's own ERAs, (eras, 2)."""
        return np.array([[era.x, era.y] for era in self.rig.eras])

    @property
    def like(self) -> Actuator:
        """The rig's ERA like which those are that do not stay."""
        return next((era for era in self.rig.eras if era.name not in self.kept), self.rig.eras[0])

    def eras(self, positions: FloatArray) -> tuple[Actuator, ...]:
        """ERAs at positions [m] (n, 2): those kept, and more like the first of the others.

        Named E1, E2, ... by names that no kept ERA has.
        """
        like = self.like
        if self.stiffness is not None:
            like = replace(like, stiffness=self.stiffness)
        names = (name for number in range(1, 999) if (name := f"E{number}") not in self.kept)
        return tuple(self.rig.era(name) for name in self.kept) + tuple(
            replace(like, name=next(names), x=float(x), y=float(y))
            for x, y in positions[len(self.kept) :]
        )

    def rig_with(self, positions: FloatArray) -> Rig:
        """The rig with ERAs at positions, without wiring."""
        return replace(self.rig, eras=self.eras(positions), wiring={}, amplifiers={})

    def shortfall(self, positions: FloatArray) -> float:
        """How far ERAs at positions are from supporting the plate, 0 if they do."""
        return shortfall(self.rig, self.eras(positions), lowest=self.lowest)

    @property
    def searched_frequencies(self) -> FloatArray:
        """Frequencies [Hz] of the scores, some of those of the rig's tables, (f,).

        As many times more as there are contents, each of which needs some of its own: three at
        all 47 follow answers with a correlation of 0.83, at 16 of 0.49 (16 layouts of four ERAs).
        """
        every = default_drive_frequencies(self.rig.limits)
        count = min(len(every), SEARCH_FREQUENCIES * self.contacts.contents)
        chosen = np.linspace(0, len(every) - 1, count).round()
        return np.asarray(every[chosen.astype(int)])

    def judged_sets(self) -> list[FloatArray]:
        """Contact sets that no search has seen, (fingers, 2) [m] each."""
        return self.contacts.sets(JUDGED_SETS, seed=self.seed + _JUDGED_SEED)

    @property
    def candidates(self) -> FloatArray:
        """Places [m] from which a search begins, (c, 2); raises InputError where there are none."""
        return self._raster[0]

    @property
    def spacing(self) -> float:
        """Distance [m] of candidates."""
        return self._raster[1]

    @cached_property
    def _raster(self) -> tuple[FloatArray, float]:
        return candidates_of(self.area, count=CANDIDATES[self.area.text == EDGE])

    def open_candidates(self, positions: FloatArray) -> IntArray:
        """Numbers of candidates far enough from positions (n, 2) [m].

        Raises InputError where there are none.
        """
        gaps = np.linalg.norm(self.candidates[:, None] - positions, axis=-1)
        found = np.flatnonzero(gaps.min(axis=1, initial=np.inf) >= self.apart)
        if not len(found):
            raise InputError(
                f"where must have room for {self.count} ERAs {1000 * self.apart:g} mm apart, got "
                f"room for {len(positions)}; enlarge it, or reduce eras or apart"
            )
        return found

    def are_apart(self, positions: FloatArray) -> bool:
        """Whether positions (n, 2) [m] keep the least distance."""
        return least_gap(positions) >= self.apart

    def random_layout(self, rng: np.random.Generator) -> FloatArray:
        """ERAs at candidates by chance, those kept first, far enough apart: (count, 2) [m].

        Raises InputError where there is no room for so many.
        """
        found = self.kept_positions
        while len(found) < self.count:
            place = self.candidates[rng.choice(self.open_candidates(found))]
            found = np.vstack([found, place])
        return found


OWN = "own"
"""Name of the rig's own layout."""

MAX_LAYOUTS = 1_000_000

_RANDOM = re.compile(r"random:(\d{1,9})")
_TRIES = 20  # draws for each layout, of which some are there already

NamedLayouts = dict[str, FloatArray]
"""Positions [m] (n, 2) of the ERAs by the name of a layout, those kept first."""


class _LayoutsSection(Section):
    """Places of the ERAs that are not kept, by the name of the layout."""

    layouts: Annotated[
        dict[str, Annotated[list[PointSection], Field(min_length=1, max_length=32)]],
        Field(min_length=1),
    ]


def supported_layouts(
    text: str, problems: Sequence[DesignProblem]
) -> dict[DesignProblem, NamedLayouts]:
    """The `layouts_of` each problem; raises InputError where none supports the plate."""
    given = {problem: layouts_of(text, problem) for problem in problems}
    if not any(
        problem.shortfall(each) == 0 for problem in given for each in given[problem].values()
    ):
        raise InputError(
            f"a given layout must support the plate with its lowest rigid-body frequency at "
            f"least {problems[0].lowest:g} Hz and weight on each ERA, got none that does; add ERAs "
            "or stiffer ones, widen where, or reduce lowest"
        )
    return given


def layouts_of(text: str, problem: DesignProblem) -> NamedLayouts:
    """The layouts of `random:N` or of a file; raises InputError for what is wrong in it."""
    found = _RANDOM.fullmatch(text)
    if found is None:
        return _layouts_of_file(Path(text), problem)
    count = int(found[1])
    if not 1 <= count <= MAX_LAYOUTS:
        raise InputError(f"layouts must be random:1 to random:{MAX_LAYOUTS}, got {text}")
    return random_layouts(problem, count)


def random_layouts(problem: DesignProblem, count: int) -> NamedLayouts:
    """A number of different layouts: the rig's own, those with a name, others at candidates.

    The first two where they are in the area. Fewer where there are no more; a longer list starts
    with a shorter one.
    """
    found: NamedLayouts = {}
    known: set[bytes] = set()
    for name, positions in _drawn(problem, count):
        key = np.unique(positions.round(9), axis=0).tobytes()
        if key not in known:
            known.add(key)
            found[name or f"{problem.count}-{len(found) + 1:06d}"] = positions
        if len(found) == count:
            break
    return found


def _drawn(problem: DesignProblem, count: int) -> Iterator[tuple[str, FloatArray]]:
    """Names, empty for random ones, and positions."""
    if len(problem.rig.eras) == problem.count and not problem.kept:
        yield OWN, problem.own_positions
    kept = problem.kept_positions
    for layout in named_layouts(problem.count - len(kept)):
        others = layout.positions(problem.rig.plate)
        positions = np.vstack([kept, others])
        if problem.area.contains(others).all() and problem.are_apart(positions):
            yield layout.name, positions
    rng = np.random.default_rng(problem.seed)
    for _ in range(_TRIES * count):
        yield "", problem.random_layout(rng)


def _layouts_of_file(path: Path, problem: DesignProblem) -> NamedLayouts:
    document = read_document(path, if_empty="it must have layouts, each a name with places")
    validation = Validation(document, _LayoutsSection)
    plate, found = problem.rig.plate, {}
    for name, places in validation.finish().layouts.items():
        positions = np.vstack([problem.kept_positions, np.array(places)])
        where = f"{path}: layouts.{name}"
        for x, y in places:
            if not plate.contains(x, y):
                raise InputError(
                    f"{where} must be on the plate, from (0, 0) to ({plate.length:g}, "
                    f"{plate.width:g}) m, got ({x:g}, {y:g}) m"
                )
        if len(positions) + problem.supports < MIN_SUPPORTING:
            raise InputError(
                f"{where} must have at least {MIN_SUPPORTING} mounts to support the plate, got "
                f"{len(positions) + problem.supports}"
            )
        if not problem.are_apart(positions):
            raise InputError(
                f"{where} must have ERAs at least {1000 * problem.apart:g} mm apart; move them, or "
                "reduce apart"
            )
        found[name] = positions
    return found
