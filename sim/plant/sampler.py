"""Accelerations of a vibrating plate on a grid of times, at points that stay for a while.

A free vibration is a sum of exponentials, tabulated for a block of samples, so that a block is one
product of matrices; a forced one is a sum of a few sinusoids.
"""

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.transients.time_response import ForcedVibration
from sim.plant.loaded_plates import BLOCK, LoadedPlate

_SMALL_PRODUCT = 1_000_000  # multiplications; below, OpenBLAS is half as fast again


class Sampler:
    """Samples a loaded plate at points of these shapes (q, r), phalanges included."""

    def __init__(self, loaded: LoadedPlate, points: FloatArray) -> None:
        self.points = points
        self._loaded = loaded
        self._by_free = np.ascontiguousarray((points @ loaded.plate.free_acceleration).T)
        self._by_coordinate = np.ascontiguousarray(points.T)
        self._forced: ForcedVibration | None = None  # whose amplitudes these are, (2 n, q):
        self._constant = self._growth = np.zeros((0, len(points)))

    def sample(
        self,
        times: FloatArray,
        out: FloatArray,
        *,
        free: ComplexArray,
        forced: ForcedVibration,
        sample_rate: float,
    ) -> None:
        """Write accelerations at times (n,) [s] on the grid k / sample_rate [Hz] to out (n, q).

        free (m,): amplitude of each free vibration at the first of them.
        """
        self._use(forced)
        table = self._loaded.exponentials(sample_rate)
        step = np.exp(self._loaded.plate.decay * (BLOCK / sample_rate)) if len(out) > BLOCK else 1
        rows = max(1, _SMALL_PRODUCT // (table.shape[1] * out.shape[1]))
        for start in range(0, len(times), BLOCK):
            into = out[start : start + BLOCK]
            if start:
                free = free * step
            if free.any():
                modal = self._by_free * free[:, None]
                amplitudes = np.concatenate([modal.real, modal.imag])
                for first in range(0, len(into), rows):
                    part = into[first : first + rows]
                    np.matmul(table[first : first + len(part)], amplitudes, out=part)
            else:
                into[:] = 0
            self._add_forced(times[start : start + BLOCK], into)

    def _use(self, forced: ForcedVibration) -> None:
        """Find the amplitudes at the points, of sines and cosines and of those that grow."""
        if forced is self._forced:
            return
        self._forced = forced
        s = 1j * forced.omegas[:, None]
        constant = s**2 * forced.b0
        if forced.b1 is not None:
            constant += 2 * s * forced.b1
            growth = s**2 * forced.b1
            self._growth = np.concatenate([growth.imag, growth.real]) @ self._by_coordinate
        self._constant = np.concatenate([constant.imag, constant.real]) @ self._by_coordinate

    def _add_forced(self, times: FloatArray, out: FloatArray) -> None:
        forced = self._forced
        if forced is None or not len(forced.omegas):
            return
        tau = (times - forced.time)[:, None]
        angle = tau * forced.omegas
        phase_factor = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        out += phase_factor @ self._constant
        if forced.b1 is not None:
            out += (phase_factor * tau) @ self._growth
