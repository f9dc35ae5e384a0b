"""Pool of distinct layouts for a study: the rig's own, named ones, random ones on a raster."""

import math
from itertools import combinations, islice, permutations

import numpy as np

from model.arrays import FloatArray
from model.rig.layouts import candidate_places, named_layouts
from model.rig.rig import Rig
from model.studies.cases import OWN, VACANT, Cases, Numbers, all_alike

# Up to so many possible layouts are enumerated and shuffled, of more some are drawn. Independent of
# the number wanted, so that a longer study starts with the layouts of a shorter one.
_MAX_ENUMERATED = 100_000

_BLOCK = 4096  # layouts drawn at once


class LayoutPool:
    """Collects distinct layouts on a raster of positions and the positions of the rig."""

    def __init__(self, rig: Rig, raster: tuple[int, int]) -> None:
        self._rig = rig
        self._in_order = not all_alike(rig.eras)
        plate = rig.plate
        self._candidates = candidate_places(*raster) * [plate.length, plate.width]
        self._positions = [tuple(position) for position in self._candidates.tolist()]
        self._places: list[Numbers] = []
        self._names: list[str] = []

    def add(self, era_count: int, wanted: int, rng: np.random.Generator, *, own: bool) -> None:
        """Add up to `wanted` layouts of `era_count` ERAs; own: include that of the rig."""
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
        new = (row for row in drawn if self._key(tuple(row.tolist())) not in known)
        extra = list(islice(new, wanted - len(known)))
        self._names += [name for name, _ in known.values()]
        self._names += [f"{era_count}-{number:06d}" for number in range(1, len(extra) + 1)]
        self._places += [np.array(numbers, dtype=np.int32) for _, numbers in known.values()]
        self._places += extra

    def cases(self) -> Cases:
        """All layouts, with the stiffness of the rig's ERAs."""
        count = max(len(row) for row in self._places)
        places = np.full((len(self._places), count), VACANT, dtype=np.int32)
        for row, numbers in zip(places, self._places, strict=True):
            row[: len(numbers)] = numbers
        return Cases(np.array(self._positions), places, np.ones(len(places)), tuple(self._names))

    def _number(self, position: FloatArray) -> int:
        """Number of a position [m], added unless it is a candidate."""
        distance = np.hypot(*(np.array(self._positions) - position).T)
        nearest = int(distance.argmin())
        if distance[nearest] < 1e-9:
            return nearest
        self._positions.append((float(position[0]), float(position[1])))
        return len(self._positions) - 1

    def _key(self, numbers: tuple[int, ...]) -> tuple[int, ...]:
        """Identity of a layout: equal ERAs may change places."""
        return numbers if self._in_order else tuple(sorted(numbers))

    def _draw(self, era_count: int, wanted: int, rng: np.random.Generator) -> list[Numbers]:
        """Distinct random layouts, at least as many as wanted unless there are fewer."""
        count = len(self._candidates)
        in_order = self._in_order
        possible = math.perm(count, era_count) if in_order else math.comb(count, era_count)
        if possible <= _MAX_ENUMERATED:
            choose = permutations if in_order else combinations
            every = np.array(list(choose(range(count), era_count)), dtype=np.int32)
            return list(rng.permutation(every))
        # Named layouts may be among the drawn ones: draw as many more.
        needed = min(wanted + len(named_layouts(era_count)) + 1, possible)
        rows = np.empty((0, era_count), dtype=np.int32)
        while len(rows) < needed:
            # Whole blocks, so that a longer study draws the same ones first.
            blocks = [
                self._block(era_count, rng, in_order=in_order)
                for _ in range(-(-(needed - len(rows)) // _BLOCK))
            ]
            rows = np.concatenate([rows, *blocks])
            _, first = np.unique(rows, axis=0, return_index=True)
            rows = rows[np.sort(first)]
        return list(rows[:needed])

    def _block(self, era_count: int, rng: np.random.Generator, *, in_order: bool) -> Numbers:
        """Random layouts (_BLOCK, era_count) without repeated positions."""
        keys = rng.random((_BLOCK, len(self._candidates)))
        # A partition's own order is another one on another processor.
        block = np.sort(keys.argpartition(era_count, axis=1)[:, :era_count], axis=1)
        if in_order:
            block = rng.permuted(block, axis=1)
        return np.asarray(block, dtype=np.int32)
