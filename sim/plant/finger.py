"""Fingers that rest on the plate and feel it: what each of their points went through, kept a while.

Here a finger is a sensor only; what it does to the plate is the plant's (`sim.plant.contacts`).
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from model.arrays import FloatArray
from model.config.points import in_metres
from model.errors import InputError
from model.finger.fingertip import fingertip_points
from model.reduction.reduced_plate import ReducedPlate
from model.structure.plate import Plate

KEPT = 10.0  # s; what is older is forgotten
FINGERS_MAX = 32  # four people with eight fingers each; what they feel still fits into memory

Position: TypeAlias = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Layout:
    """Which fingers rest where: their points [m] one after the other, and the shapes there.

    shapes (p, r); columns: by finger, which of the p points are its own.
    """

    positions: Mapping[str, Position]
    points: FloatArray
    shapes: FloatArray
    columns: Mapping[str, slice]


@dataclass(frozen=True)
class Record:
    """What one finger went through while it rested in one place.

    points (p, 2) [m]; times (n,) [s]; accelerations (n, p) [m/s²].
    """

    points: FloatArray
    times: FloatArray
    accelerations: FloatArray


def check_position(name: str, position: Position, *, plate: Plate) -> None:
    """Raise InputError for a position [m] where no finger can rest."""
    x, y = position
    if not (math.isfinite(x) and math.isfinite(y) and plate.contains(x, y)):
        raise InputError(
            f"finger {name} is at ({x:g}, {y:g}) m, which is not on the plate: it reaches from "
            f"(0, 0) to ({plate.length:g}, {plate.width:g}) m"
            f"{in_metres(x, y, length=plate.length, width=plate.width)}"
        )


class Fingers:
    """The fingers on a reduced plate, by their ids, and what they felt in the last ten seconds."""

    def __init__(self, reduced: ReducedPlate) -> None:
        self._reduced = reduced
        self._pieces: deque[tuple[Layout, FloatArray, FloatArray]] = deque()
        self.layout = self._lay_out({})

    def place(
        self, positions: Mapping[str, Position], *, reduced: ReducedPlate | None = None
    ) -> None:
        """From now on these fingers rest here [m] and no others; InputError changes nothing.

        reduced: the plate in the coordinates that it vibrates in from now on, where others.
        """
        self.check(positions)
        reduced = reduced or self._reduced
        if dict(positions) != dict(self.layout.positions) or reduced is not self._reduced:
            self._reduced = reduced
            self.layout = self._lay_out(positions)

    def check(self, positions: Mapping[str, Position]) -> None:
        """Raise InputError for fingers that cannot rest here [m], one of them or together."""
        if len(positions) > FINGERS_MAX:
            raise InputError(f"{len(positions)} fingers are too many; at most {FINGERS_MAX}")
        for name, position in positions.items():
            check_position(name, position, plate=self._reduced.plate)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Keep what the points of the present layout went through: (n,) [s], (n, p) [m/s²]."""
        if not len(times):
            return
        if accelerations.shape[1]:
            self._pieces.append((self.layout, times, accelerations.astype(np.float32)))
        while self._pieces and self._pieces[0][1][-1] < times[-1] - KEPT:
            self._pieces.popleft()

    def felt(self, since: float, until: float) -> dict[str, Record]:
        """What each finger went through in since <= t <= until [s], in the place where it was last.

        A finger that moved within the window is judged by the part after its last move; one that
        was not there at all is not in the answer.
        """
        pieces = [piece for piece in self._pieces if piece[1][-1] >= since and piece[1][0] <= until]
        last = {name: layout for layout, _, _ in pieces for name in layout.positions}
        return {
            name: _join(name, layout, pieces, since=since, until=until)
            for name, layout in last.items()
        }

    def _lay_out(self, positions: Mapping[str, Position]) -> Layout:
        columns, parts, start = {}, [np.zeros((0, 2))], 0
        for name, (x, y) in positions.items():
            part = fingertip_points(x, y, self._reduced.plate)
            columns[name] = slice(start, start + len(part))
            start += len(part)
            parts.append(part)
        points = np.concatenate(parts)
        return Layout(dict(positions), points, self._reduced.at(points), columns)


def _join(
    name: str,
    last: Layout,
    pieces: list[tuple[Layout, FloatArray, FloatArray]],
    *,
    since: float,
    until: float,
) -> Record:
    """One finger's record from the pieces in which it rested in its last place."""
    stay: list[tuple[FloatArray, FloatArray]] = []
    for layout, times, accelerations in reversed(pieces):
        if not stay and name not in layout.positions:
            continue  # it was lifted before the window ended
        if layout.positions.get(name) != last.positions[name]:
            break
        inside = (times >= since) & (times <= until)
        stay.append((times[inside], accelerations[inside, layout.columns[name]]))
    stay.reverse()
    return Record(
        points=last.points[last.columns[name]],
        times=np.concatenate([times for times, _ in stay]),
        accelerations=np.concatenate([part for _, part in stay]).astype(np.float64),
    )
