"""The frequencies of sampled tones."""

import numpy as np

from drivers.protocol.table import QUANTITIES
from model.arrays import FloatArray

_SILENT = 1e-3  # of full stroke
_LEAST = 0.1  # of a channel's loudest tone; quieter peaks are its side lobes
_PADDING = 8
_APART = 1.0  # Hz; of different tones


def frequencies_in(samples: FloatArray, *, rate: float) -> list[float]:
    """The frequencies [Hz] in samples (n, channels) in full strokes, ascending.

    Peaks of a windowed spectrum at the steps of the wire; rate [Hz].
    """
    found: list[float] = []
    for channel in samples.T:
        if np.abs(channel).max() >= _SILENT:
            found += _peaks(channel, rate=rate)
    step = QUANTITIES["frequency"].step
    tones: list[float] = []
    for frequency in sorted(round(each / step) * step for each in found):
        if not tones or frequency - tones[-1] > _APART:
            tones.append(frequency)
    return tones


def _peaks(channel: FloatArray, *, rate: float) -> list[float]:
    """Local maxima of the spectrum of a channel (n,), by a parabola through three logarithms."""
    size = _PADDING * len(channel)
    spectrum = np.abs(np.fft.rfft(channel * np.hanning(len(channel)), size))
    middle = spectrum[1:-1]
    is_peak = (middle > spectrum[:-2]) & (middle >= spectrum[2:])
    at = np.flatnonzero(is_peak & (middle > _LEAST * spectrum.max())) + 1
    below, top, above = (np.log(spectrum[at + offset] + 1e-12) for offset in (-1, 0, 1))
    offsets = (below - above) / (2 * (below - 2 * top + above))
    return ((at + offsets) * rate / size).tolist()  # type: ignore[no-any-return]
