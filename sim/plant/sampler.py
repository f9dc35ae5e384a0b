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
        self._by_forced = np.ascontiguousarray((points @ plate.displacement).T)
        # Conjugate exponents and amplitudes at the points (m, q), those that decay fastest last.
        self._decay = plate.decay.conj()
        self._free = (points @ plate.free_acceleration).conj().T
        self._strengths = np.abs(self._free).max(axis=1, initial=0.0)
        self._free_table = self._columns(loaded.exponentials(sample_rate))
        self._forced: ForcedVibration | None = None
        self._solution = -1  # which these are, with their conjugate amplitudes (n, q):
        self._constant = self._growth = self._free[:0]  # of all its solutions, and per second
        self._exponents = self._decay[:0]
        self._forced_table = self._free_table[:, :0]

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
        rows = forced.rows(solution)
        for start in range(0, len(times), BLOCK):
            into = out[start : start + BLOCK]
            tau = float(times[start] - forced.times[solution])
            now = np.exp(self._decay * tau) * free.conj()
            kept = self._kept(now)
            amplitudes = self._rows(self._free[:kept] * now[:kept, None])
            np.matmul(self._free_table[: len(into), : 2 * kept], amplitudes, out=into)
            driven: ComplexArray = self._constant[rows]
            if forced.a1 is not None:
                driven = np.vstack([driven + tau * self._growth[rows], self._growth[rows]])
            turned = driven * np.exp(self._exponents * tau)[:, None]
            into += self._forced_table[: len(into)] @ self._rows(turned)

    def _rows(self, amplitudes: ComplexArray) -> FloatArray:
        """Real and imaginary parts (2 n, q) of amplitudes (n, q), one after the other."""
        parts = np.stack([amplitudes.real, amplitudes.imag], axis=1, dtype=self.precision)
        return parts.reshape(-1, len(self.points))

    def _columns(self, table: ComplexArray) -> FloatArray:
        """Real and imaginary parts (n, 2 k) of a table (n, k)."""
        return np.ascontiguousarray(table).view(float).astype(self.precision, copy=False)

    def _kept(self, free: ComplexArray) -> int:
        """How many free vibrations count."""
        strengths = np.abs(free) * self._strengths
        counts = strengths > max(_NEGLIGIBLE * strengths.max(), _SMALLEST)
        last = counts.nonzero()[0][-1:]
        return int(last[0]) + 1 if len(last) else 0

    def _use(self, forced: ForcedVibration, solution: int) -> None:
        """Tabulate the exponentials of a solution."""
        if forced is not self._forced:
            self._find_amplitudes(forced)
        self._solution = solution
        omegas = forced.omegas[forced.rows(solution)]
        table = _sinusoids(omegas.tobytes(), self.sample_rate)
        self._exponents = np.asarray(-1j * omegas, dtype=complex)
        if forced.a1 is not None:
            table = np.hstack([table, np.arange(BLOCK)[:, None] / self.sample_rate * table])
            self._exponents = np.tile(self._exponents, 2)
        self._forced_table = self._columns(table)

    def _find_amplitudes(self, forced: ForcedVibration) -> None:
        """Find the amplitudes of all solutions at the points, all at once."""
        self._forced = forced
        s = 1j * forced.omegas[:, None]
        constant = s**2 * forced.a0
        if forced.a1 is not None:
            constant += 2 * s * forced.a1
            # Im[a exp(s t)] is Re[-i a exp(s t)].
            self._growth = np.asarray(1j * ((s**2 * forced.a1) @ self._by_forced).conj())
        self._constant = np.asarray(1j * (constant @ self._by_forced).conj())


@lru_cache(_TABLES_KEPT)
def _sinusoids(omegas: bytes, sample_rate: float) -> ComplexArray:
    """exp(i omega k / sample_rate) for k up to a block, (BLOCK, n)."""
    return exponentials(np.asarray(1j * np.frombuffer(omegas), dtype=complex), sample_rate)
