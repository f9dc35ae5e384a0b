"""Periodic multisines on all outputs at once, told apart by the turns of their phases.

In run e the phase of source i is turned by 2 pi e i / S, S the number of sources and of runs: at
every line the S runs are orthogonal (the matrix of the discrete Fourier transform), so that the
response to each source follows from all runs, with the full amplitude of all sources.

Lines are odd multiples of the lowest: a square law shows in the empty even ones. Amplitudes fall
with frequency, since accelerations grow.
"""

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
    first = int(np.ceil(low))
    first += 1 - first % 2
    last = int(np.floor(high))
    last -= 1 - last % 2
    if last < first:
        raise InputError(f"limits.frequency must leave odd hertz, got {low:g} to {high:g} Hz")
    return np.unique(np.append(np.arange(first, last, _STEP), last)).astype(float)
