"""Levels that come and go, and how far magnets of exciters move along them.

A level that swings as often as drive and magnet beat, 10 to 60 times a second, pumps the free
vibration of the magnets: its side band is at their resonance. In the eigenvectors near the drive
that follows step by step, exactly for straight lines; those far above follow the level at once.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from model.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from model.transients.time_response import PlateInTime

DECAYED = 0.25
"""Time [s] after which little is left of a free vibration of magnets."""

CLICKS_APART = 0.060
"""Time [s] between the starts of clicks at least, at one finger or at several: nearer ones would be
one."""

_STEP = 0.002  # s; between samples: the beat with a magnet's own vibration takes 5 ms or more
_PACES = 0.060  # s; from the shortest to the longest pause between what begins anew
_NEAR, _BESIDE = 1.5, 50.0  # up to so many times the frequency of a drive, and so much above [Hz]


@dataclass(frozen=True)
class Swing:
    """A level over time: shares of full level, the first 0, a step [s] apart, lines between.

    again: time [s] after which it may begin anew while it rings, infinite for never.
    """

    shares: tuple[float, ...]
    step: float
    again: float = math.inf


def motions_along(
    plate: "PlateInTime", rows: ComplexArray, frequency: float, swing: Swing
) -> FloatArray:
    """Largest motions (m,) [m] by drives at a frequency [Hz] whose full level swings, from rest.

    rows (m, 2 r): motion of each in each eigenvector. Of all drives together, in those phases in
    which the motions by each add; of what may begin anew over and over at the worst pace.
    """
    s = 2j * math.pi * frequency
    settled = plate.following(np.array([s]))[0][0].T[:, :, None] * rows.T[:, None, :]
    near = np.abs(plate.eigenvalues) < 2 * math.pi * (_NEAR * frequency + _BESIDE)
    parts = math.ceil(swing.step / _STEP)
    step, knots = swing.step / parts, len(swing.shares)
    level = np.interp(np.arange(parts * (knots - 1) + 1) / parts, np.arange(knots), swing.shares)
    rates: ComplexArray = plate.eigenvalues[near] - s
    decays = np.exp(rates * step)
    ends = 1 - (decays - 1) / (rates * step)
    added = level[1:, None] * ends + level[:-1, None] * (1 - decays - ends)
    follows = np.zeros((len(level), len(rates)), dtype=complex)
    for number, each in enumerate(added, 1):
        follows[number] = decays * follows[number - 1] + each
    moved = np.tensordot(follows, settled[near], axes=1)
    moved += level[:, None, None] * settled[~near].sum(axis=0)
    largest = np.abs(moved).sum(axis=1).max(axis=0)
    if swing.again < math.inf:  # phases go on from one to the next
        for pause in np.arange(swing.again, swing.again + _PACES, _STEP):
            count = math.ceil(pause / step)
            spare = np.pad(moved, ((0, -len(moved) % count), (0, 0), (0, 0)))
            anew = np.abs(spare.reshape(-1, count, *moved.shape[1:]).sum(axis=0))
            largest = np.maximum(largest, anew.sum(axis=1).max(axis=0))
    return np.asarray(largest)
