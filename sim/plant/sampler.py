"""Accelerations of a vibrating plate on a grid of times, at points that stay for a while.

A free vibration is a sum of exponentials that decay, a forced one of a few that do not. All are
tabulated for a block of samples, so that a block is one product of matrices.
"""

from functools import lru_cache

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.transients.time_response import ForcedVibration
from sim.plant.loaded_plates import BLOCK, LoadedPlate, exponentials

_NEGLIGIBLE = 1e-17  # of the strongest free vibration: a tenth of what rounding leaves of it
_SMALLEST = 1e-60  # m/s²; what is subnormal is slow
_ROOM = 16  # for forced exponentials, at first
_TABLES_KEPT = 8  # sets of omegas


class Sampler:
    """Samples a loaded plate at points of these shapes (q, r), phalanges included.

    precision: of the sums, double or single; everything before them is double.
    """

    def __init__(
        self,
        loaded: LoadedPlate,
        points: FloatArray,
        *,
        sample_rate: float,
        precision: type[np.floating] = np.float64,
    ) -> None:
        self.points = points
        self.sample_rate = sample_rate
        self.precision = precision
        plate = loaded.plate
        at_points = points @ plate.free_acceleration
        self._strengths = np.abs(at_points).max(axis=0, initial=0.0)
        self._by_forced = np.ascontiguousarray((points @ plate.displacement).T)
        # Of all exponentials, forced ones before the free ones, those that decay fastest last:
        # conjugate exponents, conjugate amplitudes at the points, parts over time.
        self._room = self._first = _ROOM  # for forced ones, and the first of those in use
        self._exponents = np.pad(plate.decay.conj(), (_ROOM, 0))
        self._amplitudes = np.zeros((len(self._exponents), len(points)), dtype=complex)
        self._amplitudes[_ROOM:] = at_points.conj().T
        self._columns = np.empty((BLOCK, 2 * len(self._exponents)), dtype=precision)
        self._columns[:, 2 * _ROOM :] = loaded.exponentials(sample_rate).view(float)
        self._forced: ForcedVibration | None = None
        self._solution = -1  # which these are
        self._constant = self._amplitudes[:0]  # conjugate amplitudes of all its solutions (n, q),
        self._growth: ComplexArray | None = None  # and per second

    def sample(
        self,
        times: FloatArray,
        out: FloatArray,
        *,
        free: ComplexArray,
        forced: ForcedVibration,
        solution: int,
    ) -> None:
        """Write accelerations at times (n,) [s], evenly spaced, to out (n, q).

        free (m,): amplitude of each free vibration at the time of the forced one, which is a
        solution by its number.
        """
        if forced is not self._forced or solution != self._solution:
            self._use(forced, solution)
        exponents, columns = self._exponents[self._first :], self._columns[:, 2 * self._first :]
        count = self._room - self._first
        for start in range(0, len(times), BLOCK):
            into = out[start : start + BLOCK]
            tau = float(times[start] - forced.times[solution])
            now = np.exp(exponents * tau)
            now[count:] *= free.conj()
            kept = count + self._kept(now[count:])
            amplitudes = self._amplitudes[self._first : self._first + kept] * now[:kept, None]
            if self._growth is not None:
                amplitudes[: count // 2] += tau * amplitudes[count // 2 : count]
            parts = np.empty((kept, 2, len(self.points)), dtype=self.precision)
            parts[:, 0], parts[:, 1] = amplitudes.real, amplitudes.imag
            rows = parts.reshape(2 * kept, len(self.points))
            np.matmul(columns[: len(into), : 2 * kept], rows, out=into)

    def _kept(self, free: ComplexArray) -> int:
        """How many free vibrations count."""
        strengths = np.abs(free) * self._strengths
        counts = strengths > max(_NEGLIGIBLE * strengths.max(), _SMALLEST)
        last = counts.nonzero()[0][-1:]
        return int(last[0]) + 1 if len(last) else 0

    def _use(self, forced: ForcedVibration, solution: int) -> None:
        """Put the exponentials of a solution before the free ones."""
        if forced is not self._forced:
            self._find_amplitudes(forced)
        self._solution = solution
        rows = forced.rows(solution)
        table = _sinusoids(forced.omegas[rows].tobytes(), self.sample_rate)
        exponents, amplitudes = -1j * forced.omegas[rows], self._constant[rows]
        if self._growth is not None:
            table = np.hstack([table, np.arange(BLOCK)[:, None] / self.sample_rate * table])
            exponents = np.concatenate([exponents, exponents])
            amplitudes = np.concatenate([amplitudes, self._growth[rows]])
        if len(exponents) > self._room:
            self._make_room(len(exponents))
        self._first = self._room - len(exponents)
        self._exponents[self._first : self._room] = exponents
        self._amplitudes[self._first : self._room] = amplitudes
        self._columns[:, 2 * self._first : 2 * self._room] = table.view(float)

    def _find_amplitudes(self, forced: ForcedVibration) -> None:
        """Find the amplitudes of all solutions at the points, all at once."""
        self._forced = forced
        s, self._growth = 1j * forced.omegas[:, None], None
        constant = s**2 * forced.a0
        if forced.a1 is not None:
            constant += 2 * s * forced.a1
            # Im[a exp(s t)] is Re[-i a exp(s t)].
            self._growth = np.asarray(1j * ((s**2 * forced.a1) @ self._by_forced).conj())
        self._constant = np.asarray(1j * (constant @ self._by_forced).conj())

    def _make_room(self, count: int) -> None:
        """Make room for so many forced exponentials."""
        more = count - self._room
        self._exponents = np.pad(self._exponents, (more, 0))
        self._amplitudes = np.pad(self._amplitudes, ((more, 0), (0, 0)))
        self._columns = np.pad(self._columns, ((0, 0), (2 * more, 0)))
        self._room = count


@lru_cache(_TABLES_KEPT)
def _sinusoids(omegas: bytes, sample_rate: float) -> ComplexArray:
    """exp(i omega k / sample_rate) for k up to a block, (BLOCK, n)."""
    return exponentials(np.asarray(1j * np.frombuffer(omegas), dtype=complex), sample_rate)
