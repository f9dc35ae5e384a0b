"""When a plate is no longer the one that is known: tests of the innovations of its patterns.

One pattern that is unlikely, some of the last together, or some of the last along one change: a
spring, a gain, the thickness, or a mass in one of many places. The last is the test of a
generalised likelihood ratio, which finds what fingers and noise hide in the sum (M. Basseville,
I. V. Nikiforov, Detection of Abrupt Changes, 1993, section 2.4.3). Slopes count for a pattern as
it was known before it.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from model.arrays import FloatArray
from model.identification.derivatives import by_mass_at
from model.identification.kalman import State, Updated
from model.identification.settled import Touched

WINDOW: Final = 8
_UNLIKELY_TOGETHER, _UNLIKELY_ALONE = 1e-7, 1e-8
_ALONG = 30.0  # squared standard deviations, of a hundred directions in some thousand patterns
_DEFAULT_SHARE = 0.4  # of nis / count: a change adds more, without one there is mostly less
_PLACES = (9, 7)
_KINDS = ("stiffness", "gain", "phase", "thickness")


@dataclass(frozen=True, eq=False)
class Taken:
    """A pattern with the state before it, when that was updated [s], and its innovation.

    slopes, curvatures (d,): by a change along each direction, of half its squared innovation;
    the last `masses` directions can only be upwards.
    """

    touched: Touched
    before: State
    time: float | None
    nis: float
    count: int
    slopes: FloatArray
    curvatures: FloatArray
    masses: int

    @classmethod
    def of(
        cls, touched: Touched, before: State, time: float | None, found: Updated, at: FloatArray
    ) -> "Taken":
        """That of a pattern after its update; at (m, 2) [m]: places of masses."""
        space = touched.space
        own = np.flatnonzero(space.of(*_KINDS))
        plate = touched.touched.at(np.concatenate([found.state.x, found.fingers]))
        by_mass = np.einsum("snp,n->sp", by_mass_at(plate, at)[0], touched.pattern.bases)
        masses = np.concatenate([by_mass.real, by_mass.imag])
        columns = np.hstack([found.slopes[:, own], masses])
        slopes = columns.T @ (found.precision @ found.innovation)
        curvatures = (columns * (found.precision @ columns)).sum(axis=0)
        return cls(
            touched, before, time, found.nis, found.count, slopes, curvatures, masses.shape[1]
        )


class Alarm:
    """The last patterns of a plate, and whether they are those of the plate as known."""

    def __init__(self) -> None:
        self._recent: deque[Taken] = deque(maxlen=WINDOW)

    def clear(self) -> None:
        """Forget the patterns."""
        self._recent.clear()

    def take(self, taken: Taken) -> list[Taken] | None:
        """Take a pattern; those since the plate has changed, by the last, None if it has not."""
        self._recent.append(taken)
        last = list(self._recent)[::-1]
        squares = np.cumsum([each.nis for each in last])
        numbers = np.cumsum([each.count for each in last])
        along = self._along(last)
        if along.max() > _ALONG:
            return last[: int(np.argmax(along)) + 1][::-1]
        alone = stats.chi2.sf(squares[0], numbers[0]) < _UNLIKELY_ALONE
        if alone or np.any(stats.chi2.sf(squares, numbers) < _UNLIKELY_TOGETHER):
            return last[: int(np.argmax(squares - _DEFAULT_SHARE * numbers)) + 1][::-1]
        return None

    @staticmethod
    def _along(last: list[Taken]) -> FloatArray:
        """Most squared deviations along a direction, by the number of the last patterns."""
        slopes = np.cumsum([each.slopes for each in last], axis=0)
        curvatures = np.cumsum([each.curvatures for each in last], axis=0)
        up = slopes.copy()
        first = slopes.shape[1] - last[0].masses
        up[:, first:] = np.maximum(up[:, first:], 0.0)
        squares = np.divide(up**2, curvatures, out=np.zeros_like(up), where=curvatures > 0)
        return np.asarray(squares.max(axis=1))


def places_on(length: float, width: float) -> FloatArray:
    """Places (m, 2) [m] all over a plate, at which masses are looked for."""
    axes = [
        side * (np.arange(n) + 0.5) / n for side, n in zip((length, width), _PLACES, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
