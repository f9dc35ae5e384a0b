"""Accelerations of a vibrating plate on a grid of times, at points that stay for a while.

A free vibration is a sum of exponentials, tabulated for a block of samples, so that a block is one
product of matrices; a forced one is a sum of a few sinusoids.
"""

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.transients.time_response import ForcedVibration
from sim.plant.loaded_plates import BLOCK, LoadedPlate

_FINE = 16  # samples
_SMALL_PRODUCT = 1_000_000  # multiplications; below, OpenBLAS is half as fast again


class Sampler:
    """Samples a loaded plate at points of these shapes (q, r), phalanges included."""

    def __init__(self, loaded: LoadedPlate, points: FloatArray, *, sample_rate: float) -> None:
        self.points = points
        self.sample_rate = sample_rate
        plate = loaded.plate
        self._by_free = np.ascontiguousarray((points @ plate.free_acceleration).T)
        self._by_forced = np.ascontiguousarray((points @ plate.displacement).T)
        self._block = np.exp(plate.decay * (BLOCK / sample_rate))
        self._free_columns = loaded.exponentials(sample_rate)
        self._after = np.arange(BLOCK) / sample_rate  # the first sample [s]
        self._columns = self._free_columns  # and behind them, cosines and sines
        self._forced: ForcedVibration | None = None  # whose amplitudes at the points these are,
        self._amplitudes = np.zeros((0, len(points)))  # (2 n, q), or (4 n, q) where some grow

    def sample(
        self,
        times: FloatArray,
        out: FloatArray,
        *,
        free: ComplexArray,
        forced: ForcedVibration,
    ) -> None:
        """Write accelerations at times (n,) [s], evenly spaced, to out (n, q).

        free (m,): amplitude of each free vibration at the first of them.
        """
        if forced is not self._forced:
            self._use(forced)
        is_free = bool(free.any())
        count = self._free_columns.shape[1]
        columns = self._columns[:, 0 if is_free else count : count + len(self._amplitudes)]
        rows = max(1, _SMALL_PRODUCT // max(1, columns.shape[1] * out.shape[1]))
        for start in range(0, len(times), BLOCK):
            into = out[start : start + BLOCK]
            self._fill(float(times[start] - forced.time), len(into), forced)
            amplitudes = self._amplitudes
            if is_free:
                modal = self._by_free * free[:, None]
                amplitudes = np.concatenate([modal.real, modal.imag, amplitudes])
                free = free * self._block
            for first in range(0, len(into), rows):
                part = into[first : first + rows]
                np.matmul(columns[first : first + len(part)], amplitudes, out=part)

    def _use(self, forced: ForcedVibration) -> None:
        """Find the amplitudes of cosines and sines at the points, and those of their growth."""
        self._forced = forced
        s = 1j * forced.omegas[:, None]
        constant = s**2 * forced.a0
        if forced.a1 is not None:
            constant = np.concatenate([constant + 2 * s * forced.a1, s**2 * forced.a1])
        at_points = constant @ self._by_forced
        count = len(forced.omegas)
        self._amplitudes = np.concatenate(
            [
                part
                for each in (at_points[:count], at_points[count:])
                for part in (each.imag, each.real)
            ]
        )
        free = self._free_columns.shape[1]
        if self._columns.shape[1] < free + len(self._amplitudes):
            self._columns = np.empty((BLOCK, free + len(self._amplitudes)))
            self._columns[:, :free] = self._free_columns

    def _fill(self, tau: float, count: int, forced: ForcedVibration) -> None:
        """Write cosines and sines for so many samples from a time tau [s] on, behind the others."""
        omegas, free = forced.omegas, self._free_columns.shape[1]
        if not len(omegas):
            return
        # Multiples of a few samples, times those few: products cost less than cosines.
        s = 1j * omegas
        coarse = np.exp((self._after[: count + _FINE - 1 : _FINE, None] + tau) * s)
        fine = np.exp(self._after[:_FINE, None] * s)
        phase_factor = (coarse[:, None] * fine).reshape(-1, len(omegas))[:count]
        columns = self._columns[:count, free : free + len(self._amplitudes)]
        both = columns[:, : 2 * len(omegas)]
        both[:, : len(omegas)], both[:, len(omegas) :] = phase_factor.real, phase_factor.imag
        if forced.a1 is not None:
            each = tau + self._after[:count, None]
            np.multiply(both, each, out=columns[:, 2 * len(omegas) :])
