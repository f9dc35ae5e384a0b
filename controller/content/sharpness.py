"""Sharpness: the frequencies that 0 to 1 stand for, both ways."""

import numpy as np

from model.arrays import FloatArray

MIN_HZ, MAX_HZ = 65.0, 300.0
"""Frequencies of sharpness 0 and 1 [Hz], as the MPEG reference encoder reads AHAP."""


def sharpness_of(hertz: FloatArray) -> FloatArray:
    """Sharpness of frequencies [Hz], 0 and 1 outside their range."""
    return np.asarray(((hertz - MIN_HZ) / (MAX_HZ - MIN_HZ)).clip(0, 1))


def hertz_of(sharpness: FloatArray) -> FloatArray:
    """Frequencies [Hz] of sharpness, 0 to 1."""
    return MIN_HZ + sharpness * (MAX_HZ - MIN_HZ)
