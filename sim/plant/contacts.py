"""The plate's equations of motion for whatever fingers load it, solved once for each set of them.

A finger is a mass, a spring and a damper at a point: a change of low rank. The reduced plate gets
the static vectors of its point, without which the plate would give too little under it, and the
small system is diagonalised anew. What was solved is kept, since fingers tap where they have tapped
before. Structural damping stays that of the plate on its ERAs.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

import numpy as np

from model.arrays import FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.point_load import PointLoad
from model.transients.time_response import PlateInTime, plate_in_time
from sim.plant.finger import Position

BLOCK = 256  # samples that one table of exponentials serves

# A point that a finger has left keeps its coordinates this long [s], so that nothing is lost of the
# motion under it: they are the quickest of all and die away within a tenth of that.
_KEPT_AFTER = 0.2
_LEFT_MAX = 8  # points; a finger that slides leaves many, and the older ones are still by then
_SOLVED_MAX = 32  # sets of contacts; one takes about a megabyte

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class Carried:
    """The plate with the fingers on it, reduced for forces under them."""

    contacts: tuple[PointLoad, ...]
    reduced: ReducedPlate
    plate: PlateInTime
    _tables: dict[float, FloatArray] = field(default_factory=dict)

    def exponentials(self, sample_rate: float) -> FloatArray:
        """Re and -Im of exp(eigenvalue k / sample_rate [Hz]), k up to a block, (BLOCK, 2 m)."""
        if sample_rate not in self._tables:
            grid = np.exp(np.outer(np.arange(BLOCK) / sample_rate, self.plate.decay))
            self._tables.clear()
            self._tables[sample_rate] = np.hstack([grid.real, -grid.imag])
        return self._tables[sample_rate]


class ContactPlates:
    """One plate on its ERAs, with what is fixed to it, under any fingers.

    reduced: for forces at the ERAs and loads. Raises InputError for ERAs that do not hold it.
    """

    def __init__(
        self, reduced: ReducedPlate, eras: Sequence[Era], loads: Sequence[PointLoad]
    ) -> None:
        self._bare = reduced
        self._eras = tuple(eras)
        self._loads = tuple(loads)
        self._left: dict[Position, float] = {}  # and when [s]
        self._resting: tuple[Position, ...] = ()
        self._reduced: OrderedDict[tuple[Position, ...], ReducedPlate] = OrderedDict({(): reduced})
        self._solved: OrderedDict[tuple[object, ...], Carried] = OrderedDict()

    def carrying(self, contacts: Sequence[PointLoad], *, time: float) -> Carried:
        """The plate under these fingers from a time [s] on, which never goes back."""
        contacts = tuple(contacts)
        resting = tuple(sorted({(contact.x, contact.y) for contact in contacts}))
        for point in self._resting:
            self._left.pop(point, None)
            self._left[point] = time
        self._resting = resting
        recent = [
            point
            for point, when in self._left.items()
            if time - when < _KEPT_AFTER and point not in resting
        ][-_LEFT_MAX:]
        self._left = {point: self._left[point] for point in recent}
        points = (*resting, *sorted(recent))
        key = (points, contacts)
        if key not in self._solved:
            _keep(self._solved, key, self._solve(points, contacts))
        self._solved.move_to_end(key)
        return self._solved[key]

    def _solve(self, points: tuple[Position, ...], contacts: tuple[PointLoad, ...]) -> Carried:
        if not points:
            return Carried(contacts, self._bare, _bare_plate(self._bare, self._eras, self._loads))
        reduced = self._reduced_at(points)
        plate = plate_in_time(reduced, self._eras, loads=self._loads, contacts=contacts)
        return Carried(contacts, reduced, plate)

    def _reduced_at(self, points: tuple[Position, ...]) -> ReducedPlate:
        if points not in self._reduced:
            _keep(self._reduced, points, self._bare.with_forces_at(np.array(points)))
        return self._reduced[points]


@lru_cache(maxsize=2)  # benches are made one after the other, of one rig
def _bare_plate(
    reduced: ReducedPlate, eras: tuple[Era, ...], loads: tuple[PointLoad, ...]
) -> PlateInTime:
    return plate_in_time(reduced, eras, loads=loads)


def _keep(kept: OrderedDict[_Key, _Value], key: _Key, value: _Value) -> None:
    while len(kept) >= _SOLVED_MAX:
        kept.popitem(last=False)
    kept[key] = value
