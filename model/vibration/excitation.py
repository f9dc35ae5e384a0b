"""Physical excitation of the plate, a tone per active ERA; its peak acceleration and nulls.

ERAs at the same frequency add as complex numbers; only magnitudes of different frequencies add
(paper Eq. 28). Magnitudes added within a frequency would wipe out the nodal lines.
"""

import cmath
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.structure.attachments import Source


@dataclass(frozen=True)
class Tone:
    """One frequency [Hz], base amplitude a [m] and phase [rad]: y(t) = a sin(2 pi f t + phase)."""

    frequency: float
    amplitude: float
    phase: float = 0.0

    @classmethod
    def from_phasor(cls, frequency: float, phasor: complex) -> Self:
        """Make the tone of a phasor [m] at a frequency [Hz]."""
        return cls(frequency, abs(phasor), cmath.phase(phasor))

    @property
    def phasor(self) -> complex:
        """Complex amplitude a exp(i phase) [m]: y(t) = Im[phasor exp(2 pi i f t)]."""
        return cmath.rect(self.amplitude, self.phase)


Excitation: TypeAlias = Mapping[str, Tone]
"""A tone per active ERA, by the ERA's name; an ERA that is not named is still."""


G = 9.8
"""Standard gravity as the paper rounds it [m/s²]; used only where accelerations are shown in g."""

NULL_SHARE = 0.1
"""A null is below this share of the map's maximum."""


def base_amplitudes(
    excitation: Excitation, eras: Sequence[Source], *others: Excitation
) -> tuple[FloatArray, ComplexArray]:
    """Distinct frequencies (f,) [Hz], and phasors of each ERA's base at them, (f, eras) [m].

    others: that play at the same time. Raises InputError where no ERA is driven, or an unknown one.
    """
    tones = [each for one in (excitation, *others) for each in one.items()]
    if not tones:
        raise InputError("excitation: must drive at least one ERA")
    names = [era.name for era in eras]
    frequencies = sorted({tone.frequency for _, tone in tones})
    amplitudes = np.zeros((len(frequencies), len(eras)), dtype=complex)
    for name, tone in tones:
        if name not in names:
            raise InputError(f"the rig has no ERA {name!r}; it has {', '.join(names)}")
        phasor = cmath.rect(tone.amplitude, tone.phase)  # without a call for each
        amplitudes[frequencies.index(tone.frequency), names.index(name)] += phasor
    return np.array(frequencies), amplitudes


def tone_fields(
    excitation: Excitation,
    eras: Sequence[Source],
    response: Callable[[FloatArray], ComplexArray],
    *others: Excitation,
) -> tuple[FloatArray, ComplexArray]:
    """Complex acceleration [m/s²] at each distinct frequency: frequencies (f,) [Hz], field (f, p).

    response: frequencies (f,) -> acceleration of each ERA at full stroke (f, eras, p); others:
    excitations that play at the same time.
    """
    frequencies, amplitudes = base_amplitudes(excitation, eras, *others)
    weights = amplitudes / np.array([era.full_level for era in eras])
    return frequencies, np.einsum("fe,fep->fp", weights, response(frequencies))


def peak_acceleration(amplitudes: FloatArray) -> FloatArray:
    """Peak acceleration over time (p,) [m/s²] from amplitudes per frequency (f, p): their sum."""
    return np.asarray(amplitudes.sum(axis=0))


def find_nulls(x: FloatArray, y: FloatArray, peak: FloatArray) -> FloatArray:
    """Positions [m] (n, 2) of the nulls of a map (len(y), len(x)): low local minima.

    A curve of nulls shows as the lowest points along it.
    """
    from scipy.ndimage import minimum_filter  # only maps need it, and it takes long to load

    low = peak <= NULL_SHARE * peak.max()
    rows, columns = np.nonzero(low & (peak == minimum_filter(peak, size=3, mode="nearest")))
    return np.column_stack([x[columns], y[rows]])
