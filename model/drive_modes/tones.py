"""From what a drive mode finds to physics: a tone for each ERA."""

import cmath
from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray
from model.drive_modes.fields import Drive
from model.structure.actuator import Era
from model.vibration.excitation import Excitation, Tone

ROUNDING = 1e-6  # of single precision, in which drives are found


def excitation_of(
    drive: Drive, eras: Sequence[Era], frequencies: FloatArray, *, gain: float
) -> Excitation:
    """Tones by ERA, at a gain of up to 1; at each frequency the strongest has phase zero.

    No phase is absolute. frequencies (f,) [Hz]: what the drive's indices stand for.
    """
    tones = {}
    for index, weight in drive.tones():
        strongest = weight[np.argmax(np.abs(weight))]
        turned = weight * (np.conj(strongest) / np.abs(strongest))
        frequency = float(frequencies[index])
        # Numbers of Python's own: those of numpy take ten times as long, one by one.
        for era, w in zip(eras, turned.tolist(), strict=True):
            if w != 0:
                in_phase = w.real > 0 and abs(w.imag) < ROUNDING * w.real
                tones[era.name] = Tone(
                    frequency=frequency,
                    amplitude=gain * min(abs(w), 1.0) * era.stroke,
                    phase=0.0 if in_phase else cmath.phase(w),
                )
    return tones
