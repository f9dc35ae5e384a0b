"""How localized a pattern is: contrast between regions of the plate, and level at the target."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.finger.perception import decibels, sensation_level

# A lone finger is told from the rest of the plate beyond this distance [m] (about two fingertips).
SURROUNDINGS_RADIUS = 0.05


def is_beyond(points: FloatArray, targets: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Which points [m] (p, 2) are farther from every target [m] than SURROUNDINGS_RADIUS, (p,)."""
    apart = np.linalg.norm(points[:, None] - np.array(targets), axis=-1)
    beyond: NDArray[np.bool_] = (apart > SURROUNDINGS_RADIUS).all(axis=1)
    return beyond


def is_around(points: FloatArray, targets: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Which points [m] (p, 2) are the surroundings of targets [m], (p,): those beyond, or all.

    All where the plate is so small that no point is beyond.
    """
    beyond = is_beyond(points, targets)
    return beyond if beyond.any() else ~beyond


def contrast_db(target: FloatArray, quiet: FloatArray) -> FloatArray:
    """Contrast [dB] of peak accelerations: mean over the target's points to the quiet maximum.

    target (..., p), quiet (..., q) -> (...).
    """
    return decibels(target.mean(axis=-1) / quiet.max(axis=-1))


def mean_level_db_sl(frequencies: FloatArray, amplitudes: FloatArray) -> float:
    """Level [dB SL] over a region: mean over its points of how far above threshold each is felt.

    frequencies (f,) [Hz], amplitudes (f, p) [m/s²].
    """
    above = 10 ** (sensation_level(frequencies, amplitudes) / 20)
    return float(decibels(above.mean()))
