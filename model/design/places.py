"""The free plate between places of ERAs and the fingertips of contact sets, at a few frequencies.

All that a layout is scored from. The plate is solved once; receptances between any places are
products with its functions there (`model.reduction.free_plate`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray
from model.finger.disc import FIVE_POINTS
from model.finger.fingertip import fingertips_on
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig


@dataclass(frozen=True, eq=False)
class Places:
    """Receptances [m/N] from c places, and their change by one deviation of the thickness.

    None for a thickness that is known exactly.

    at (c, 2) [m]; between (f, c, c); to_tips (f, m p, c): at the points of m fingertips.
    """

    at: FloatArray
    between: Complex64Array
    to_tips: Complex64Array
    between_change: Complex64Array | None
    tips_change: Complex64Array | None


class DesignPlate:
    """A rig's free plate at frequencies (f,) [Hz], with contact sets on it.

    weights (m, p): of a fingertip's points, its centre first, in the mean over it; groups: contact
    sets with the same number of fingers, (s, k), by number, target first; own (f, m, p): receptance
    of a fingertip's points from its centre [m/N].
    """

    def __init__(self, rig: Rig, frequencies: FloatArray, sets: Sequence[FloatArray]) -> None:
        self.rig = rig
        self.frequencies = frequencies
        self.omega = 2 * np.pi * frequencies
        self.era = rig.eras[0]
        self._free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(frequencies.max()))
        centres, numbers = np.unique(np.vstack(sets), axis=0, return_inverse=True)
        points, weights = fingertips_on(
            centres, length=rig.plate.length, width=rig.plate.width, rule=FIVE_POINTS
        )
        self._points = points.reshape(-1, 2)
        self.weights: Float32Array = weights.astype(np.float32)
        self.groups = _grouped([len(each) for each in sets], numbers.ravel())
        _, to_points = self._free.receptances(centres, self._points, frequencies, loads=rig.masses)
        to_tips = to_points.swapaxes(1, 2).reshape(len(frequencies), *weights.shape, -1)
        every = np.arange(len(centres))
        self.own = to_tips[:, every, :, every].swapaxes(0, 1).astype(np.complex64)

    @property
    def point_count(self) -> int:
        """Number of points of a fingertip."""
        return int(self.weights.shape[1])

    def places(self, at: FloatArray) -> Places:
        """Solve for ERAs at places [m] (c, 2)."""
        at = np.atleast_2d(at)
        feet = np.column_stack([at, np.full(len(at), self.era.foot)])
        given = feet, self._points, self.frequencies
        found = _at_tips(*self._free.receptances(*given, loads=self.rig.masses))
        std = self.rig.uncertainty.thickness
        if std == 0:
            return Places(at, *found, None, None)
        between, to_points = self._free.receptance_slopes(*given, loads=self.rig.masses)
        return Places(at, *found, *_at_tips(std * between, std * to_points))


def _at_tips(
    between: ComplexArray, to_points: ComplexArray
) -> tuple[Complex64Array, Complex64Array]:
    """Between places (f, c, c), and at points (f, m p, c) of fingertips."""
    to_tips = np.ascontiguousarray(to_points.swapaxes(1, 2))
    return between.astype(np.complex64), to_tips.astype(np.complex64)


def _grouped(sizes: Sequence[int], numbers: IntArray) -> tuple[IntArray, ...]:
    """Sets of these sizes, one after the other in numbers, as one array (s, k) for each size."""
    first = np.cumsum(sizes) - sizes
    return tuple(
        numbers[first[np.equal(sizes, size)][:, None] + np.arange(size)]
        for size in np.unique(sizes).tolist()
    )
