"""The plate's equations of motion under fingers, solved once for each set of contacts.

A fingertip acts at a point, and its phalanx moves: a low-rank change and one more coordinate. The
reduced basis is extended by the static vectors of the point, and the small system diagonalised
again. Solutions are cached. Structural damping remains that of the plate on its ERAs.

Fingers that come to rest are solved apart: a large plate takes a tenth of a second, in which its
amplifiers must go on replying.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import FingertipLoad, PointLoad, Source
from model.transients.time_response import PlateInTime, plate_in_time
from sim.plant.fingers import Position

Footprint: TypeAlias = tuple[float, float, float]
"""x, y, radius [m]."""

BLOCK = 512  # samples per table of exponentials; a power of 2

# s; a point keeps its static vectors for so long after a lift, ten times as long as their motion
# takes to decay.
_KEEP_LIFTED = 0.2
_MAX_LIFTED = 8  # points; a sliding finger leaves many
_MAX_SOLVED = 32  # sets of contacts, of about a megabyte each


@dataclass(frozen=True, eq=False)
class LoadedPlate:
    """The plate under a set of contacts, reduced for forces at them."""

    reduced: ReducedPlate
    plate: PlateInTime
    _tables: dict[float, ComplexArray] = field(default_factory=dict)

    def exponentials(self, sample_rate: float) -> ComplexArray:
        """exp(eigenvalue k / sample_rate [Hz]), k up to a block, (BLOCK, m)."""
        if sample_rate not in self._tables:
            self._tables.clear()
            self._tables[sample_rate] = exponentials(self.plate.decay, sample_rate)
        return self._tables[sample_rate]


def exponentials(s: ComplexArray, sample_rate: float) -> ComplexArray:
    """exp(s k / sample_rate) for s (n,) [1/s] and k up to a block, (BLOCK, n)."""
    table = np.ones((BLOCK, len(s)), dtype=complex)
    done = 1
    while done < BLOCK:  # doubled, since an exponential costs ten products
        np.multiply(table[:done], np.exp(s * (done / sample_rate)), out=table[done : 2 * done])
        done *= 2
    return table


Under: TypeAlias = tuple[LoadedPlate, Mapping[str, FingertipLoad]]
"""A loaded plate with its contacts by id of the finger, in the order of its coordinates."""


def carried_state(state: FloatArray, before: Under, after: Under) -> FloatArray:
    """Displacement and velocity of all coordinates, (2 r,), carried to another set of contacts.

    Those of the plate and of magnets, and of the phalanges of fingers that stay, are continuous; a
    new finger's phalanx is at rest.
    """
    (plate, contacts), (other, wanted) = before, after
    halves, count = np.split(state, 2), len(plate.reduced.omega)
    fixed = len(halves[0]) - len(contacts)
    moving = dict(zip(contacts, np.transpose([half[fixed:] for half in halves]), strict=True))
    phalanges = np.reshape([moving.get(id, (0.0, 0.0)) for id in wanted], (-1, 2)).T
    motion = [half[:count] for half in halves]
    if other.reduced is not plate.reduced:
        carried = other.reduced.projection_from(plate.reduced)
        motion = [carried @ half for half in motion]
    magnets = [half[count:fixed] for half in halves]
    return np.concatenate([*chain.from_iterable(zip(motion, magnets, phalanges, strict=True))])


class LoadedPlateCache:
    """Solutions of one plate on its ERAs with its loads, under any contacts.

    reduced: for forces at the ERAs and loads. Raises InputError for ERAs that do not support it.
    """

    def __init__(
        self, reduced: ReducedPlate, eras: Sequence[Source], loads: Sequence[PointLoad]
    ) -> None:
        self._unloaded = reduced
        self._eras = tuple(eras)
        self._loads = tuple(loads)
        self._lifted: dict[Footprint, float] = {}  # by point: when [s]
        self._resting: tuple[Footprint, ...] = ()
        self._solved = lru_cache(_MAX_SOLVED)(self._solve)
        self._reduced_at = lru_cache(_MAX_SOLVED)(self._reduce)

    def solution(
        self, contacts: Sequence[FingertipLoad], *, time: float
    ) -> Callable[[], LoadedPlate]:
        """What solves the plate under these contacts from a time [s] on, in any thread.

        Calls must be in order of time.
        """
        resting = tuple(sorted({(each.x, each.y, each.foot) for each in contacts}))
        for point in self._resting:
            self._lifted.pop(point, None)
            self._lifted[point] = time
        self._resting = resting
        recent = [
            point
            for point, when in self._lifted.items()
            if time - when < _KEEP_LIFTED and point not in resting
        ][-_MAX_LIFTED:]
        self._lifted = {point: self._lifted[point] for point in recent}
        return partial(self._solved, (*resting, *sorted(recent)), tuple(contacts))

    def _solve(
        self, points: tuple[Footprint, ...], contacts: tuple[FingertipLoad, ...]
    ) -> LoadedPlate:
        if not points:
            unloaded = _solve_unloaded(self._unloaded, self._eras, self._loads)
            return LoadedPlate(self._unloaded, unloaded)
        reduced = self._reduced_at(points)
        plate = plate_in_time(reduced, self._eras, loads=self._loads, contacts=contacts)
        return LoadedPlate(reduced, plate)

    def _reduce(self, points: tuple[Footprint, ...]) -> ReducedPlate:
        return self._unloaded.with_attachments_at(np.array(points))


@lru_cache(maxsize=2)  # successive benches of one rig share it
def _solve_unloaded(
    reduced: ReducedPlate, eras: tuple[Source, ...], loads: tuple[PointLoad, ...]
) -> PlateInTime:
    return plate_in_time(reduced, eras, loads=loads)


class Placement:
    """Positions [m] and loads of all fingers by id from a time [s] on.

    solve: returns the plate under them, may be called in any thread, and is called once; None where
    what loads the plate stays.
    """

    def __init__(
        self,
        time: float,
        positions: Mapping[str, Position],
        contacts: Mapping[str, FingertipLoad],
        solve: Callable[[], LoadedPlate] | None,
    ) -> None:
        self.time = time
        self.positions = dict(positions)
        self.contacts = contacts
        self.is_solved = solve is None
        self._is_started = False
        self._solve = solve
        self._lock = threading.Lock()
        self._loaded: LoadedPlate | None = None

    def supersedes(self, before: "Placement", last: "Placement") -> bool:
        """Whether the last one can be left out, as of fingers that slide faster than is solved.

        Its solution has not begun, and it only moved the same fingers.
        """
        is_slide = self.positions.keys() == last.positions.keys() == before.positions.keys()
        return is_slide and not (last.is_solved or last._is_started)

    def solved(self) -> LoadedPlate | None:
        """The plate under these fingers, solved if it is not yet; raises what solving raises."""
        self._is_started = True
        with self._lock:
            try:
                if self._loaded is None and self._solve is not None:
                    self._loaded = self._solve()
                return self._loaded
            finally:
                self.is_solved = True
