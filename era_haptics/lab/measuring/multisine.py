"""Multisines, and responses estimated from runs.

Multisines play on all outputs simultaneously. In run e the phase of source i is rotated by 2 pi e i
/ S, where S is the number of sources and of runs. At every line the S runs are orthogonal (discrete
Fourier transform matrix), so the response to each source follows from all runs, with the full
amplitude of all sources. Lines are odd multiples of the lowest, so a square law shows in the empty
even lines. Amplitudes decrease with frequency because accelerations increase.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError

PERIOD = 1.0
"""s; lines are whole numbers of hertz."""

MIN_PERIODS = 2
"""Minimum number of periods in a recording: between their lines, its spectrum is only noise."""

_DRAWS = 20  # random phases; the lowest crest factor among them is 3.1 to 3.6
_RAMP = 0.02  # s
_STEP = 10  # Hz
_AROUND = 4  # lines on either side for the noise estimate
_SMALLEST = 1e-300  # in place of a divisor of 0


@dataclass(frozen=True, eq=False)
class Multisine:
    """Signals of several sources; level: their largest sample; seed: of the phases.

    frequencies (f,) [Hz]: whole multiples of 1 / PERIOD.
    """

    frequencies: FloatArray
    sources: int
    rate: float
    level: float
    seed: int = 0

    def __post_init__(self) -> None:
        """Check that the signals can be played."""
        if self.rate * PERIOD % 1:
            raise InputError(f"sample rate must be a whole number of hertz, got {self.rate:g} Hz")
        lines = self.frequencies * PERIOD
        if len(lines) == 0 or np.abs(lines - np.round(lines)).max() > 1e-6 or lines.min() < 1:
            raise InputError(
                f"frequencies must be whole multiples of {1 / PERIOD:g} Hz, got "
                f"{', '.join(f'{hertz:g}' for hertz in self.frequencies[:3]) or 'none'}, ..."
            )
        if self.frequencies.max() > 0.4 * self.rate:
            raise InputError(
                f"frequencies must be at most {0.4 * self.rate:g} Hz at this sample rate, got "
                f"{self.frequencies.max():g} Hz"
            )

    @property
    def slew(self) -> float:
        """Highest rise [1/s] of the level, along the ramp at the start."""
        return np.pi / 2 * self.level / _RAMP

    @property
    def samples(self) -> int:
        """Samples of a period."""
        return round(self.rate * PERIOD)

    @cached_property
    def lines(self) -> IntArray:
        """Number of each line in the spectrum of a period, (f,)."""
        return np.round(self.frequencies * PERIOD).astype(int)

    @cached_property
    def _amplitudes(self) -> ComplexArray:
        """Complex amplitudes (f,) of the cosines of source 0 in run 0, with the lowest crest."""
        rng = np.random.default_rng(self.seed)
        sizes = 1 / self.frequencies
        best = sizes + 0j
        lowest_peak = np.inf
        for _ in range(_DRAWS):
            amplitudes = sizes * np.exp(2j * np.pi * rng.uniform(size=len(sizes)))
            peak = np.abs(self._analytic(amplitudes)).max()
            if peak < lowest_peak:
                best = amplitudes
                lowest_peak = peak
        # The envelope is the largest sample under any turn of the phases.
        return np.asarray(best * self.level / lowest_peak)

    def _analytic(self, amplitudes: ComplexArray) -> ComplexArray:
        """One period of the sum of a exp(i omega t), whose real part is played, (n,)."""
        spectrum = np.zeros(self.samples, dtype=complex)
        spectrum[self.lines] = amplitudes
        return np.asarray(np.fft.ifft(spectrum) * self.samples)

    def played(self, run: int) -> ComplexArray:
        """Complex amplitudes (f, sources) of the samples of a run."""
        return self._amplitudes[:, None] * self._phase_factors(run)

    def signal(self, run: int, *, periods: float) -> FloatArray:
        """Samples (n, sources) of a number of periods, with ramps at both ends."""
        period = (self._analytic(self._amplitudes)[:, None] * self._phase_factors(run)).real
        samples = np.resize(period, (round(periods * self.samples), self.sources))
        return ramped(samples, round(_RAMP * self.rate))

    def amplitudes_in(self, recorded: FloatArray) -> ComplexArray:
        """Complex amplitudes (f, ...) at the lines of whole periods of samples (n, ...)."""
        lines = self.lines * (len(recorded) // self.samples)
        return np.asarray(np.fft.rfft(recorded, axis=0)[lines] * 2 / len(recorded))

    def _phase_factors(self, run: int) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * run * np.arange(self.sources) / self.sources))


def ramped(samples: FloatArray, count: int) -> FloatArray:
    """Samples (n, sources) with squared-sine ramps of `count` samples at both ends."""
    ramp = np.sin(np.linspace(0, np.pi / 2, count)) ** 2
    shape = np.ones((len(samples), 1))
    shape[:count, 0] = ramp
    shape[-count:, 0] *= ramp[::-1]
    return samples * shape


def multisine_frequencies(low: float, high: float) -> FloatArray:
    """Return odd whole frequencies [Hz] in steps of 10 between a lowest and a highest one."""
    odd = np.arange(1.0, high + 1e-9, 2)
    odd = odd[odd >= low]
    if not odd.size:
        raise InputError(f"limits.frequency must leave odd hertz, got {low:g} to {high:g} Hz")
    return np.unique([*odd[:: _STEP // 2], odd[-1]])


@dataclass(frozen=True, eq=False)
class ResponseEstimate:
    """Sample-to-sample responses (f, inputs, sources), H1 estimate over all runs.

    - std (f, inputs): standard deviation of each complex response; that of its real part, and of
      its modulus, is smaller by the square root of 2.
    - coherence (f, inputs): fraction of the power that comes from the sources.
    - even (inputs,): amplitude at even lines, which are not played, relative to the played lines,
      minus noise.
    """

    values: ComplexArray
    std: FloatArray
    coherence: FloatArray
    even: FloatArray


def estimate(multisine: Multisine, recorded: Sequence[FloatArray]) -> ResponseEstimate:
    """Estimate responses from whole periods of each run, (periods x samples, inputs).

    Solves Y = U H^T at each line by least squares, with U the amplitudes played (runs, sources).
    Raises InputError for fewer than `MIN_PERIODS` periods, or fewer runs than sources.
    """
    length = len(recorded[0])
    periods = length // multisine.samples
    if periods < MIN_PERIODS:
        raise InputError(f"a recording must have at least {MIN_PERIODS} periods, got {periods}")
    if len(recorded) < multisine.sources:
        raise InputError(
            f"runs must be at least as many as sources, {multisine.sources}, got {len(recorded)}"
        )
    spectra = np.array([np.fft.rfft(run, axis=0) for run in recorded], dtype=complex)
    spectra *= 2 / length
    lines = multisine.lines * periods
    received = spectra[:, lines]  # (runs, f, inputs)
    played = np.array([multisine.played(run) for run in range(len(recorded))])  # (runs, f, s)
    noise = _noise_power(spectra, lines, periods)
    power = (np.abs(received) ** 2).mean(axis=0)
    amplitudes = np.abs(multisine.played(0)[:, :1])
    return ResponseEstimate(
        values=_least_squares(played, received),
        std=np.sqrt(noise / len(recorded)) / amplitudes,
        coherence=np.clip(1 - noise / np.maximum(power, _SMALLEST), 0.0, 1.0),
        even=_even_lines(spectra, lines, periods, noise),
    )


def _least_squares(played: ComplexArray, received: ComplexArray) -> ComplexArray:
    """Return the responses H (f, inputs, s) from amplitudes (runs, f, s) and (runs, f, inputs)."""
    U = played.transpose(1, 0, 2)
    Y = received.transpose(1, 0, 2)
    adjoint = U.conj().swapaxes(1, 2)
    transposed = np.linalg.solve(adjoint @ U, adjoint @ Y)
    return np.asarray(transposed.transpose(0, 2, 1))


def _noise_power(spectra: ComplexArray, lines: IntArray, periods: int) -> FloatArray:
    """Return the mean power of noise (f, inputs), from bins around each line without any signal."""
    offsets = np.arange(-_AROUND * periods, _AROUND * periods + 1)
    offsets = offsets[offsets % periods != 0]
    bins = np.clip(lines[:, None] + offsets, 1, spectra.shape[1] - 1)
    return np.asarray((np.abs(spectra[:, bins]) ** 2).mean(axis=(0, 2)))


def _even_lines(
    spectra: ComplexArray, lines: IntArray, periods: int, noise: FloatArray
) -> FloatArray:
    """Return the amplitude at the even lines, relative to the played lines, (inputs,)."""
    even_lines = lines + periods
    even_power = ((np.abs(spectra[:, even_lines]) ** 2).mean(axis=0) - noise).sum(axis=0)
    played_power = (np.abs(spectra[:, lines]) ** 2).mean(axis=0).sum(axis=0)
    ratio = np.maximum(even_power, 0) / np.maximum(played_power, _SMALLEST)
    return np.asarray(np.sqrt(ratio))
