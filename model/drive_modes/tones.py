"""Conversion of the ERAs' weights to physics: a tone for each ERA."""

from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.drive_modes.forms import Weights
from model.structure.actuator import Era
from model.vibration.excitation import Excitation, Tone

ROUNDING = 1e-6  # of single precision


def excitation_of(
    drive: Weights, eras: Sequence[Era], frequencies: FloatArray, *, gain: float
) -> Excitation:
    """Tones by ERA, at a gain of up to 1; at each frequency the strongest has phase zero.

    frequencies (f,) [Hz]: by the drive's indices.
    """
    tones = {}
    for index, weight in drive.tones():
        strongest = weight[np.argmax(np.abs(weight))]
        in_phase = weight * (np.conj(strongest) / np.abs(strongest))
        frequency = float(frequencies[index])
        # Python's own numbers: those of numpy take ten times as long, one by one.
        for era, w in zip(eras, in_phase.tolist(), strict=True):
            if w != 0:
                if w.real > 0 and abs(w.imag) < ROUNDING * w.real:
                    w = w.real
                unit = Tone.from_phasor(frequency, w)
                amplitude = gain * min(unit.amplitude, 1.0) * era.stroke
                tones[era.name] = Tone(frequency, amplitude, unit.phase)
    return tones
