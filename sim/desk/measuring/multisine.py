"""Periodic multisines on all outputs at once, told apart by the turns of their phases.

In run e the phase of source i is turned by 2 pi e i / S, S the number of sources and of runs: at
every line the S runs are orthogonal (the matrix of the discrete Fourier transform), so that the
response to each source follows from all runs, with the full amplitude of all sources.

Lines are odd multiples of the lowest: a square law shows in the empty even ones. Amplitudes fall
with frequency, since accelerations grow.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError

PERIOD = 1.0
"""s; lines are whole numbers of hertz."""

_DRAWS = 20  # of phases; the lowest crest of them is 3.1 to 3.6
_RAMP = 0.02  # s
_STEP = 10  # Hz


@dataclass(frozen=True, eq=False)
class Multisine:
    """The signals of so many sources; level: their largest sample; seed: of the phases.

    frequencies (f,) [Hz]: whole multiples of 1 / PERIOD.
    """

    frequencies: FloatArray
    sources: int
    rate: float
    level: float
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be played."""
        if self.rate * PERIOD % 1:
            raise InputError(f"sample rate must be a whole number of hertz, got {self.rate:g} Hz")
        lines = self.frequencies * PERIOD
        if len(lines) == 0 or np.abs(lines - np.round(lines)).max() > 1e-6 or lines.min() < 1:
            raise InputError(
                f"frequencies must be whole multiples of {1 / PERIOD:g} Hz, got "
                f"{', '.join(f'{each:g}' for each in self.frequencies[:3]) or 'none'}, ..."
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
        """Complex amplitudes of cosines of source 0 in run 0, (f,), of the lowest crest drawn."""
        rng = np.random.default_rng(self.seed)
        sizes = 1 / self.frequencies
        best, lowest = sizes + 0j, np.inf
        for _ in range(_DRAWS):
            drawn = sizes * np.exp(2j * np.pi * rng.uniform(size=len(sizes)))
            peak = np.abs(self._analytic(drawn)).max()
            if peak < lowest:
                best, lowest = drawn, peak
        # The envelope is the largest sample under any turn of the phases.
        return np.asarray(best * self.level / lowest)

    def _analytic(self, amplitudes: ComplexArray) -> ComplexArray:
        """One period of the sum of a exp(i omega t), whose real part is played, (n,)."""
        spectrum = np.zeros(self.samples, dtype=complex)
        spectrum[self.lines] = amplitudes
        return np.asarray(np.fft.ifft(spectrum) * self.samples)

    def played(self, run: int) -> ComplexArray:
        """Complex amplitudes (f, sources) of the samples of a run."""
        return self._amplitudes[:, None] * self._phase_factors(run)

    def signal(self, run: int, *, periods: float) -> FloatArray:
        """Samples (n, sources) of so many periods, with ramps at both ends."""
        period = (self._analytic(self._amplitudes)[:, None] * self._phase_factors(run)).real
        found = np.resize(period, (round(periods * self.samples), self.sources))
        return ramped(found, round(_RAMP * self.rate))

    def found(self, recorded: FloatArray) -> ComplexArray:
        """Complex amplitudes (f, ...) at the lines of whole periods of samples (n, ...)."""
        lines = self.lines * (len(recorded) // self.samples)
        return np.asarray(np.fft.rfft(recorded, axis=0)[lines] * 2 / len(recorded))

    def _phase_factors(self, run: int) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * run * np.arange(self.sources) / self.sources))


def ramped(samples: FloatArray, count: int) -> FloatArray:
    """Samples (n, sources), ramped along squared sines over so many of them at both ends."""
    ramp = np.sin(np.linspace(0, np.pi / 2, count)) ** 2
    shape = np.ones((len(samples), 1))
    shape[:count, 0] = ramp
    shape[-count:, 0] *= ramp[::-1]
    return samples * shape


def default_frequencies(low: float, high: float) -> FloatArray:
    """Odd whole frequencies [Hz] in steps of 10 from above a lowest to below a highest one."""
    odd = np.arange(1.0, high + 1e-9, 2)
    odd = odd[odd >= low]
    if not odd.size:
        raise InputError(f"limits.frequency must leave odd hertz, got {low:g} to {high:g} Hz")
    return np.unique([*odd[:: _STEP // 2], odd[-1]])


_AROUND = 4  # lines of a period on either side, from which noise is taken


@dataclass(frozen=True, eq=False)
class Estimate:
    """Responses (f, inputs, sources) of samples to samples, H1 over all runs.

    std (f, inputs): standard deviation of each response's modulus; coherence (f, inputs): share of
    the power that comes from the sources; even (inputs,): what came back at even lines, which
    nobody played, relative to the lines played, amplitudes, noise taken off.
    """

    values: ComplexArray
    std: FloatArray
    coherence: FloatArray
    even: FloatArray


def estimate(multisine: Multisine, recorded: Sequence[FloatArray]) -> Estimate:
    """Estimate responses from whole periods of each run, (periods x samples, inputs).

    Two periods or more: between the lines of a period the spectrum of several has nothing but
    noise. Least squares of Y = U H^T at each line, U the amplitudes played (runs, sources).
    """
    n = multisine.samples
    periods = len(recorded[0]) // n
    spectra = np.array([np.fft.rfft(each, axis=0) for each in recorded], dtype=complex)
    spectra *= 2 / len(recorded[0])
    lines = multisine.lines * periods
    heard = spectra[:, lines]  # (runs, f, inputs)
    played = np.array([multisine.played(run) for run in range(len(recorded))])  # (runs, f, s)
    values = np.linalg.solve(played.transpose(1, 0, 2), heard.transpose(1, 0, 2))
    noise = _noise(spectra, lines, periods)
    power = (np.abs(heard) ** 2).mean(axis=0)
    size = np.abs(multisine.played(0)[:, :1])
    return Estimate(
        values.transpose(0, 2, 1),
        np.sqrt(noise / len(recorded)) / size,
        np.clip(1 - noise / np.maximum(power, 1e-300), 0.0, 1.0),
        _even(spectra, lines, periods, noise),
    )


def _noise(spectra: ComplexArray, lines: IntArray, periods: int) -> FloatArray:
    """Mean power of the bins around each line that no period has, (f, inputs)."""
    offsets = np.arange(-_AROUND * periods, _AROUND * periods + 1)
    offsets = offsets[offsets % periods != 0]
    bins = np.clip(lines[:, None] + offsets, 1, spectra.shape[1] - 1)
    return np.asarray((np.abs(spectra[:, bins]) ** 2).mean(axis=(0, 2)))


def _even(spectra: ComplexArray, lines: IntArray, periods: int, noise: FloatArray) -> FloatArray:
    """Amplitude at the even lines beside the odd ones, relative to those, (inputs,)."""
    beside = lines + periods
    power = (np.abs(spectra[:, beside]) ** 2).mean(axis=0) - noise
    played = (np.abs(spectra[:, lines]) ** 2).mean(axis=0).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(power.sum(axis=0), 0) / np.maximum(played, 1e-300)))
