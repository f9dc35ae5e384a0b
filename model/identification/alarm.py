"""When a plate is no longer the one that is known: tests of the innovations of its patterns.

Some of the last are unlikely together, or along one change: a spring, a gain, the thickness, or a
mass in one of many places. The latter is the test of a generalised likelihood ratio, which finds
what fingers and noise hide in the sum (M. Basseville, I. V. Nikiforov, Detection of Abrupt Changes,
1993, section 2.4.3). One pattern alone raises no alarm, since a finger may be unlike any other, but
no state is updated by it either.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtrc

from model.arrays import FloatArray
from model.choice import best_of
from model.finger.grid import Grid
from model.identification.settled import PatternModel, State, StateUpdate

WINDOW: Final = 8
_UNLIKELY_TOGETHER, _UNLIKELY_ALONE, _UNLIKELY_REST = 1e-7, 1e-6, 1e-2
_ALONG_REST = 8.0  # without the pattern that deviates most
_ALONG = 22.0  # squared standard deviations, of a hundred directions in some thousand patterns
_REFERENCE = 0.4  # of nis / count: a change adds more, without one there is less most of the time
PLACES: Final = Grid(9, 7)
"""Cells in whose middles masses are looked for."""

_KINDS = ("stiffness", "gain", "phase", "thickness")


@dataclass(frozen=True, eq=False)
class Observation:
    """A pattern with the state before it, when that was updated [s], and its innovation.

    slopes, curvatures (d,): by a change along each direction, of half its squared innovation;
    the last `masses` directions can only be upwards.
    """

    model: PatternModel
    before: State
    time: float | None
    nis: float
    count: int
    slopes: FloatArray
    curvatures: FloatArray
    masses: int

    @classmethod
    def of(
        cls,
        model: PatternModel,
        before: State,
        time: float | None,
        found: StateUpdate,
        at: FloatArray,
    ) -> "Observation":
        """That of a pattern after its update; at (m, 2) [m]: places of masses."""
        space = model.space
        own = np.flatnonzero(space.of(*_KINDS))
        plate = model.forward.at(np.concatenate([found.state.x, found.fingers]))
        masses = model.by_mass_at(plate, at)
        columns = np.hstack([found.slopes[:, own], masses])
        slopes = columns.T @ (found.precision @ found.innovation)
        curvatures = (columns * (found.precision @ columns)).sum(axis=0)
        return cls(model, before, time, found.nis, found.count, slopes, curvatures, masses.shape[1])


class Alarm:
    """The last patterns of a plate, and whether they are those of the plate as known.

    By chi² with `scipy.special`: `scipy.stats` takes a second to load.
    """

    def __init__(self) -> None:
        self._recent: deque[Observation] = deque(maxlen=WINDOW)

    @property
    def is_full(self) -> bool:
        """Whether as many patterns as it looks at have come without an alarm."""
        return len(self._recent) == WINDOW

    def clear(self) -> None:
        """Forget the patterns."""
        self._recent.clear()

    def take(self, observation: Observation) -> list[Observation] | None:
        """Take a pattern; those since the plate has changed, by the last, None if it has not."""
        self._recent.append(observation)
        last = list(self._recent)[::-1]
        along, confirmed = self._along(last)
        if confirmed.max() > _ALONG:
            return last[: best_of(along) + 1][::-1]
        squares = np.cumsum([each.nis for each in last])
        numbers = np.cumsum([each.count for each in last])
        largest = np.maximum.accumulate([each.nis for each in last])
        unlikely = chdtrc(numbers, squares) < _UNLIKELY_TOGETHER
        rest = (
            chdtrc(np.maximum(numbers - observation.count, 1), squares - largest) < _UNLIKELY_REST
        )
        if np.any(unlikely & rest):
            return last[: best_of(squares - _REFERENCE * numbers) + 1][::-1]
        return None

    @property
    def is_odd(self) -> bool:
        """Whether the last pattern is unlikely on its own, as under a finger unlike any other."""
        last = self._recent[-1]
        is_unlikely = chdtrc(last.count, last.nis) < _UNLIKELY_ALONE
        return bool(
            is_unlikely or _squares(last.slopes, last.curvatures, last.masses).max() > _ALONG
        )

    @staticmethod
    def _along(last: list[Observation]) -> tuple[FloatArray, FloatArray]:
        """Most squared deviations along a direction, by the number of the last patterns.

        Of any direction, and of those along which the rest deviates without any one of them.
        """
        slopes = np.array([each.slopes for each in last])
        curvatures = np.array([each.curvatures for each in last])
        masses, along, confirmed = last[0].masses, np.zeros(len(last)), np.zeros(len(last))
        for number in range(len(last)):
            own, weights = slopes[: number + 1], curvatures[: number + 1]
            total, weight = own.sum(axis=0), weights.sum(axis=0)
            rest = _squares(total - own, weight - weights, masses).min(axis=0)
            squares = _squares(total, weight, masses)
            along[number] = squares.max()
            confirmed[number] = np.where(rest > _ALONG_REST, squares, 0.0).max()
        return along, confirmed


def _squares(slopes: FloatArray, curvatures: FloatArray, masses: int) -> FloatArray:
    """Squared deviations along directions (..., d), of which the last can only be upwards."""
    up = slopes.copy()
    first = slopes.shape[-1] - masses
    up[..., first:] = np.maximum(up[..., first:], 0.0)
    return np.divide(up**2, curvatures, out=np.zeros_like(up), where=curvatures > 1e-12)
