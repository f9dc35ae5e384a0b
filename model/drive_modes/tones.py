"""Conversion of the ERAs' weights to physics: a tone for each ERA."""

import cmath
from collections.abc import Sequence

from model.arrays import FloatArray
from model.choice import NEARLY
from model.structure.attachments import Era
from model.vibration.excitation import Excitation, Tone

ROUNDING = 1e-6  # of single precision


def excitation_of(
    weights: Sequence[tuple[int, Sequence[complex]]],
    eras: Sequence[Era],
    frequencies: FloatArray,
    *,
    gain: float,
) -> Excitation:
    """Tones by ERA, at a gain of up to 1; at each frequency the strongest, the first of
    those nearly as strong, has phase zero.

    weights (eras,): at each of some frequencies (f,) [Hz], by index.
    """
    tones = {}
    for index, values in weights:  # Python's numbers: numpy's take ten times as long, one by one
        enough = (1 - NEARLY) * max(map(abs, values))
        (strongest, *_) = [value for value in values if abs(value) >= enough]
        factor = strongest.conjugate() / abs(strongest)
        frequency = float(frequencies[index])
        for era, value in zip(eras, values, strict=True):
            if value != 0:
                w = value * factor
                if w.real > 0 and abs(w.imag) < ROUNDING * w.real:
                    w = w.real
                amplitude = gain * min(abs(w), 1.0) * era.stroke
                tones[era.name] = Tone(frequency, amplitude, cmath.phase(w))
    return tones
