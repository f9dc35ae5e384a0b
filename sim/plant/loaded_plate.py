"""The plate on its ERAs under a set of contacts, reduced for forces at them and solved in time.

A fingertip acts at a point, and its phalanx moves: a low-rank change and one more coordinate. The
reduced basis is extended by the static vectors of the point, and the small system diagonalized
again; solutions are cached by the set of contacts. Structural damping is that of the plate on its
ERAs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import PointLoad
from model.structure.fingertips import FingertipLoad
from model.structure.sources import Source
from model.transients.plate_in_time import PlateInTime, plate_in_time

TABLE_ROWS = 512
"""Samples per table of exponentials; a power of 2."""

Footprint: TypeAlias = tuple[float, float, float]
"""x, y, radius [m]."""

# s; a point keeps its static vectors for this time after a lift, ten times as long as their motion
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
        """exp(eigenvalue k / sample_rate [Hz]) for k < TABLE_ROWS, (TABLE_ROWS, m)."""
        if sample_rate not in self._tables:
            self._tables.clear()
            self._tables[sample_rate] = exponentials(self.plate.decay, sample_rate)
        return self._tables[sample_rate]


def exponentials(s: ComplexArray, sample_rate: float) -> ComplexArray:
    """exp(s k / sample_rate) for s (n,) [1/s] and k < TABLE_ROWS, (TABLE_ROWS, n)."""
    table = np.ones((TABLE_ROWS, len(s)), dtype=complex)
    count = 1
    while count < TABLE_ROWS:  # doubled, since an exponential costs ten products
        factors = np.exp(s * (count / sample_rate))
        np.multiply(table[:count], factors, out=table[count : 2 * count])
        count *= 2
    return table


@dataclass(frozen=True, eq=False)
class PlateUnderContacts:
    """A loaded plate with its contacts by id of the finger, in the order of its coordinates."""

    loaded: LoadedPlate
    contacts: Mapping[str, FingertipLoad]


def carried_state(
    state: FloatArray, old: PlateUnderContacts, new: PlateUnderContacts
) -> FloatArray:
    """Displacement and velocity of all coordinates, (2 r,), carried to another set of contacts.

    The state of the plate, of magnets and of remaining fingers' phalanges is continuous; a new
    finger's phalanx is at rest.
    """
    projection = None
    if new.loaded.reduced is not old.loaded.reduced:
        projection = new.loaded.reduced.projection_from(old.loaded.reduced)
    carried = [_carried(half, old, new, projection) for half in np.split(state, 2)]
    return np.concatenate(carried)


def _carried(
    coordinates: FloatArray,
    old: PlateUnderContacts,
    new: PlateUnderContacts,
    projection: FloatArray | None,
) -> FloatArray:
    """Displacements or velocities (r,) of plate, magnets and phalanges, as `carried_state`."""
    plate_count = len(old.loaded.reduced.omega)
    first_phalanx = len(coordinates) - len(old.contacts)
    plate = coordinates[:plate_count]
    magnets = coordinates[plate_count:first_phalanx]
    phalanges = dict(zip(old.contacts, coordinates[first_phalanx:], strict=True))
    if projection is not None:
        plate = projection @ plate
    carried_phalanges = [phalanges.get(finger, 0.0) for finger in new.contacts]
    return np.concatenate([plate, magnets, carried_phalanges])


class LoadedPlateCache:
    """Solutions of a plate on its ERAs with its loads, for any contacts.

    reduced: for forces at the ERAs and loads. Raises InputError for ERAs that do not support it.
    """

    def __init__(
        self, reduced: ReducedPlate, eras: Sequence[Source], loads: Sequence[PointLoad]
    ) -> None:
        self._unloaded = reduced
        self._eras = tuple(eras)
        self._loads = tuple(loads)
        # Time of the lift [s] by point, in the order of the lifts.
        self._lifted: dict[Footprint, float] = {}
        self._resting: tuple[Footprint, ...] = ()
        self._solved = lru_cache(_MAX_SOLVED)(self._solve)
        self._reduced_at = lru_cache(_MAX_SOLVED)(self._reduce)

    def solution(
        self, contacts: Sequence[FingertipLoad], *, time: float
    ) -> Callable[[], LoadedPlate]:
        """Return a function that solves the plate under these contacts from a time [s] on.

        The function may run in any thread. Calls of this method must be in order of time.
        """
        for point in self._resting:
            self._lifted.pop(point, None)
            self._lifted[point] = time
        footprints = {(contact.x, contact.y, contact.foot) for contact in contacts}
        self._resting = tuple(sorted(footprints))
        self._forget_old_lifts(time)
        points = (*self._resting, *sorted(self._lifted))
        return partial(self._solved, points, tuple(contacts))

    def _forget_old_lifts(self, time: float) -> None:
        """Keep the latest lifted points at which no finger rests again."""
        recent = []
        for point, lifted_at in self._lifted.items():
            if time - lifted_at < _KEEP_LIFTED and point not in self._resting:
                recent.append(point)
        self._lifted = {point: self._lifted[point] for point in recent[-_MAX_LIFTED:]}

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


@lru_cache(maxsize=2)  # shared by successive benches of the same rig
def _solve_unloaded(
    reduced: ReducedPlate, eras: tuple[Source, ...], loads: tuple[PointLoad, ...]
) -> PlateInTime:
    return plate_in_time(reduced, eras, loads=loads)
