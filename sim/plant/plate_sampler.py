"""Accelerations of a loaded plate at points, sampled from tables of exponentials.

Free vibrations decay and forced vibrations turn as exponentials. Both are tabulated for a block of
samples; a block of accelerations is one matrix product with each table.
"""

from functools import lru_cache

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.transients.plate_in_time import ForcedVibration
from sim.plant.loaded_plate import TABLE_ROWS, LoadedPlate, exponentials

_NEGLIGIBLE = 1e-17  # of the strongest free vibration: a tenth of its rounding error
_SMALLEST = 1e-60  # m/s²; subnormal numbers are slow
_TABLES_KEPT = 8  # sets of omegas


class Sampler:
    """Samples a loaded plate at points with mode shapes (q, r), including phalanges.

    precision: of the sums, double or single; all other steps use double.
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
        # Free vibrations: conjugate exponents and amplitudes at the points (m, q), fastest decay
        # last.
        self._decay = plate.decay.conj()
        self._free = (points @ plate.free_acceleration).conj().T
        self._strengths = np.abs(self._free).max(axis=1, initial=0.0)
        self._free_table = self._columns(loaded.exponentials(sample_rate))
        # Forced vibrations: conjugate amplitudes (n, q) of all solutions, and their growth per
        # second; exponents and table of the solution in use, -1 for none.
        self._forced: ForcedVibration | None = None
        self._constant = self._free[:0]
        self._growth = self._free[:0]
        self._solution = -1
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

        free (m,): amplitude of each free vibration at the time of the forced one; solution: index
        of the forced vibration's solution.
        """
        if forced is not self._forced:
            self._use_forced(forced)
            self._use_solution(forced, solution)
        elif solution != self._solution:
            self._use_solution(forced, solution)
        free_conjugate = free.conj()
        for start in range(0, len(times), TABLE_ROWS):
            block = out[start : start + TABLE_ROWS]
            elapsed = float(times[start] - forced.times[solution])
            self._write_free(block, elapsed, free_conjugate)
            self._add_forced(block, elapsed, forced)

    def _write_free(self, block: FloatArray, elapsed: float, free_conjugate: ComplexArray) -> None:
        """Write the free vibrations, elapsed [s] after the time of their amplitudes."""
        decayed = np.exp(self._decay * elapsed) * free_conjugate
        strengths = np.abs(decayed) * self._strengths
        smallest = max(_NEGLIGIBLE * strengths.max(), _SMALLEST)
        audible = (strengths > smallest).nonzero()[0]
        count = int(audible[-1]) + 1 if len(audible) else 0
        amplitudes = self._rows(self._free[:count] * decayed[:count, None])
        np.matmul(self._free_table[: len(block), : 2 * count], amplitudes, out=block)

    def _add_forced(self, block: FloatArray, elapsed: float, forced: ForcedVibration) -> None:
        """Add the forced vibrations of the solution in use, elapsed [s] after its time."""
        rows = forced.rows(self._solution)
        amplitudes: ComplexArray = self._constant[rows]
        if forced.a1 is not None:
            growth = self._growth[rows]
            amplitudes = np.vstack([amplitudes + elapsed * growth, growth])
        turned = amplitudes * np.exp(self._exponents * elapsed)[:, None]
        block += self._forced_table[: len(block)] @ self._rows(turned)

    def _use_forced(self, forced: ForcedVibration) -> None:
        """Compute the amplitudes of all solutions of a forced vibration at the points."""
        self._forced = forced
        s = 1j * forced.omegas[:, None]
        constant = s**2 * forced.a0
        if forced.a1 is not None:
            constant += 2 * s * forced.a1
            self._growth = self._conjugate_at_points(s**2 * forced.a1)
        self._constant = self._conjugate_at_points(constant)

    def _conjugate_at_points(self, amplitudes: ComplexArray) -> ComplexArray:
        """Conjugate of -i a at the points (n, q), since Im[a exp(s t)] is Re[-i a exp(s t)]."""
        return np.asarray(1j * (amplitudes @ self._by_forced).conj())

    def _use_solution(self, forced: ForcedVibration, solution: int) -> None:
        """Tabulate the exponentials of a solution."""
        self._solution = solution
        omegas = forced.omegas[forced.rows(solution)]
        table = _sinusoids(omegas.tobytes(), self.sample_rate)
        exponents = np.asarray(-1j * omegas, dtype=complex)
        if forced.a1 is not None:
            times = np.arange(TABLE_ROWS)[:, None] / self.sample_rate
            table = np.hstack([table, times * table])
            exponents = np.tile(exponents, 2)
        self._exponents = exponents
        self._forced_table = self._columns(table)

    def _rows(self, amplitudes: ComplexArray) -> FloatArray:
        """Real and imaginary parts (2 n, q) of amplitudes (n, q), alternating."""
        parts = np.stack([amplitudes.real, amplitudes.imag], axis=1, dtype=self.precision)
        return parts.reshape(2 * len(amplitudes), len(self.points))

    def _columns(self, table: ComplexArray) -> FloatArray:
        """Real and imaginary parts (n, 2 k) of a table (n, k)."""
        return np.ascontiguousarray(table).view(float).astype(self.precision, copy=False)


@lru_cache(_TABLES_KEPT)
def _sinusoids(omegas: bytes, sample_rate: float) -> ComplexArray:
    """exp(i omega k / sample_rate) for k < TABLE_ROWS, (TABLE_ROWS, n)."""
    exponents = np.asarray(1j * np.frombuffer(omegas), dtype=complex)
    return exponentials(exponents, sample_rate)
