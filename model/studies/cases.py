"""What a study compares: layouts of ERAs, each with a stiffness."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from model.actuator import Era
from model.arrays import FloatArray, IntArray
from model.errors import InputError
from model.layouts import alike, candidate_places, named_layouts, place_eras
from model.rig import Rig

VACANT = -1
"""Stands after the last ERA of a layout in an array that holds larger ones too."""

OWN = "own"
"""Name of the layout that the rig has now."""

STIFFNESS_FACTORS = 2.0 ** np.arange(-4, 5)
"""A stiffness study multiplies the stiffness of the rig's ERAs by 1/16 to 16."""

MOST_ERAS = 6
"""A count study goes from one ERA to so many."""

# So few possible layouts are all listed and shuffled; of more, some are drawn. Not by how many are
# wanted, so that asking for more keeps those that were solved before.
_FEW = 100_000

_BLOCK = 4096  # layouts drawn at once

_Numbers = NDArray[np.int32]


@dataclass(frozen=True)
class Cases:
    """Layouts chosen from positions, each with a factor on the stiffness of its ERAs.

    positions (c, 2) [m]; places (n, most eras) numbers of positions, VACANT after the last;
    stiffness_factors (n,); names: of the n layouts.
    """

    positions: FloatArray
    places: _Numbers
    stiffness_factors: FloatArray
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.places)

    def part(self, start: int, stop: int) -> "Cases":
        """Cases start to stop - 1."""
        return Cases(
            self.positions,
            self.places[start:stop],
            self.stiffness_factors[start:stop],
            self.names[start:stop],
        )

    def places_of(self, case: int) -> IntArray:
        """Numbers of the positions of one case's ERAs, (eras,)."""
        places = self.places[case]
        return np.asarray(places[places != VACANT], dtype=np.int64)

    def positions_of(self, case: int) -> FloatArray:
        """Positions [m] of the ERAs of one case, (eras, 2)."""
        return np.asarray(self.positions[self.places_of(case)])

    def eras_of(self, case: int, like: Sequence[Era]) -> tuple[Era, ...]:
        """The ERAs of one case, like those of a rig.

        Where the rig's are alike they are named E1, E2, ... anew, unless they stay where they are;
        where they differ each keeps its name. Stiffness times its factor, and damping so that the
        damping ratio, c / 2 sqrt(k_b m_plate / eras), stays.
        """
        positions = self.positions_of(case)
        stay = self.names[case] == OWN or not all_alike(like)
        eras = place_eras(like, positions) if stay else alike(like[0], positions)
        factor = float(self.stiffness_factors[case])
        damping = math.sqrt(factor * len(like) / len(positions))
        return tuple(
            replace(era, stiffness=era.stiffness * factor, damping=era.damping * damping)
            for era in eras
        )


def placement_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """The rig's ERAs in other places: its own layout, those with a name, random ones."""
    if layouts < 1:
        raise InputError(f"{layouts} layouts are none to study; ask for one at least")
    pool = _Pool(rig, raster)
    pool.add(len(rig.eras), layouts, np.random.default_rng(seed), own=True)
    return pool.cases()


def count_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """One to MOST_ERAS ERAs like the rig's, the layouts shared out evenly among the counts."""
    if not all_alike(rig.eras):
        raise InputError(
            "the rig's ERAs differ, so more or fewer of them cannot be told; give all of them the "
            "same stiffness, damping, bolt_mass and stroke for a study of their count"
        )
    most = max(MOST_ERAS, len(rig.eras))
    if layouts < most:
        raise InputError(
            f"{layouts} layouts are too few to compare 1 to {most} ERAs; ask for at least {most}"
        )
    pool = _Pool(rig, raster)
    rng = np.random.default_rng(seed)
    for count in range(1, most + 1):
        share = layouts // most + (count <= layouts % most)
        pool.add(count, share, rng, own=count == len(rig.eras))
    return pool.cases()


def stiffness_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """Every layout of a placement study with each of the STIFFNESS_FACTORS."""
    placed = placement_cases(rig, layouts=layouts, seed=seed, raster=raster)
    count = len(STIFFNESS_FACTORS)
    return Cases(
        placed.positions,
        np.repeat(placed.places, count, axis=0),
        np.tile(STIFFNESS_FACTORS, len(placed)),
        tuple(name for name in placed.names for _ in range(count)),
    )


STUDIES: dict[str, Callable[..., Cases]] = {
    "placement": placement_cases,
    "count": count_cases,
    "stiffness": stiffness_cases,
}
"""What each study compares, by its name."""


def all_alike(eras: Sequence[Era]) -> bool:
    """Whether ERAs differ in nothing but their names and places."""
    return len({(e.stiffness, e.damping, e.bolt_mass, e.stroke) for e in eras}) == 1


class _Pool:
    """Gathers distinct layouts on a raster of positions and on those that the rig has."""

    def __init__(self, rig: Rig, raster: tuple[int, int]) -> None:
        self._rig = rig
        plate = rig.plate
        self._candidates = candidate_places(*raster) * [plate.length, plate.width]
        self._positions = [tuple(position) for position in self._candidates.tolist()]
        self._places: list[_Numbers] = []
        self._names: list[str] = []

    def add(self, era_count: int, wanted: int, rng: np.random.Generator, *, own: bool) -> None:
        """Add so many layouts of so many ERAs, fewer where there are no more."""
        named = [
            (layout.name, layout.positions(self._rig.plate)) for layout in named_layouts(era_count)
        ]
        if own:
            rig_positions = np.array([[era.x, era.y] for era in self._rig.eras])
            named.insert(0, (OWN, rig_positions))
        known: dict[tuple[int, ...], tuple[str, tuple[int, ...]]] = {}
        for name, positions in named[:wanted]:
            numbers = tuple(self._number(position) for position in positions)
            known.setdefault(self._key(numbers), (name, numbers))
        drawn = self._draw(era_count, wanted, rng)
        extra = [row for row in drawn if self._key(tuple(row.tolist())) not in known]
        extra = extra[: wanted - len(known)]
        self._names += [name for name, _ in known.values()]
        self._names += [f"{era_count}-{number:06d}" for number in range(1, len(extra) + 1)]
        self._places += [np.array(numbers, dtype=np.int32) for _, numbers in known.values()]
        self._places += extra

    def cases(self) -> Cases:
        """All layouts that were added, with the stiffness that the rig's ERAs have."""
        most = max(len(row) for row in self._places)
        places = np.full((len(self._places), most), VACANT, dtype=np.int32)
        for row, numbers in zip(places, self._places, strict=True):
            row[: len(numbers)] = numbers
        return Cases(np.array(self._positions), places, np.ones(len(places)), tuple(self._names))

    def _number(self, position: FloatArray) -> int:
        """Number of a position [m]; a candidate's where one is there."""
        distance = np.hypot(*(np.array(self._positions) - position).T)
        nearest = int(distance.argmin())
        if distance[nearest] < 1e-9:
            return nearest
        self._positions.append((float(position[0]), float(position[1])))
        return len(self._positions) - 1

    def _key(self, numbers: tuple[int, ...]) -> tuple[int, ...]:
        """What two equal layouts share: ERAs that are alike may change places."""
        return tuple(sorted(numbers)) if all_alike(self._rig.eras) else numbers

    def _draw(self, era_count: int, wanted: int, rng: np.random.Generator) -> list[_Numbers]:
        """Distinct random layouts, at least as many as wanted unless there are fewer."""
        count = len(self._candidates)
        in_order = not all_alike(self._rig.eras)
        possible = math.perm(count, era_count) if in_order else math.comb(count, era_count)
        if possible <= _FEW:
            choose = permutations if in_order else combinations
            every = np.array(list(choose(range(count), era_count)), dtype=np.int32)
            return list(rng.permutation(every))
        # Known layouts may be among the drawn ones: draw as many more.
        needed = min(wanted + len(named_layouts(era_count)) + 1, possible)
        rows = np.empty((0, era_count), dtype=np.int32)
        while len(rows) < needed:
            # Whole blocks, for the same reason.
            blocks = [
                self._block(era_count, rng, in_order=in_order)
                for _ in range(-(-(needed - len(rows)) // _BLOCK))
            ]
            rows = np.concatenate([rows, *blocks])
            _, first = np.unique(rows, axis=0, return_index=True)
            rows = rows[np.sort(first)]
        return list(rows[:needed])

    def _block(self, era_count: int, rng: np.random.Generator, *, in_order: bool) -> _Numbers:
        """Random layouts (_BLOCK, era_count), no position twice in one."""
        keys = rng.random((_BLOCK, len(self._candidates)))
        block = keys.argpartition(era_count, axis=1)[:, :era_count]
        block = rng.permuted(block, axis=1) if in_order else np.sort(block, axis=1)
        return np.asarray(block, dtype=np.int32)
