"""How localized a vibration is: contrast between fingertips, and level at the target."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.finger.perception import decibels, sensation_level

# The background of a lone finger begins at this distance [m], about two fingertips.
NEAR_RADIUS = 0.05


def is_beyond(points: FloatArray, targets: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which points [m] (p, 2) are farther than NEAR_RADIUS from every target [m], (p,)."""
    apart = np.linalg.norm(points[:, None] - np.array(targets), axis=-1)
    beyond: NDArray[np.bool_] = (apart > NEAR_RADIUS).all(axis=1)
    return beyond


def is_background(points: FloatArray, targets: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which points [m] (p, 2) are background to targets [m], (p,): those beyond, or all.

    All where the plate is so small that no point is beyond.
    """
    beyond = is_beyond(points, targets)
    return beyond if beyond.any() else ~beyond


def contrast_ratio(targets: Sequence[FloatArray], quiet: FloatArray) -> FloatArray:
    """Contrast of peak amplitudes as a ratio: the weakest target to the loudest quiet point.

    A target counts by the mean over its points. targets (..., p) each, quiet (..., q) -> (...).
    """
    peak = np.minimum.reduce([target.mean(axis=-1) for target in targets])
    return np.asarray(peak / quiet.max(axis=-1))


def contrast_db(targets: Sequence[FloatArray], quiet: FloatArray) -> FloatArray:
    """Return `contrast_ratio` in dB."""
    return decibels(contrast_ratio(targets, quiet))


def mean_level_db_sl(frequencies: FloatArray, amplitudes: FloatArray) -> float:
    """Level [dB SL] over a region: mean over its points of amplitude to threshold.

    frequencies (f,) [Hz], amplitudes (f, p) [m/s²].
    """
    above = 10 ** (sensation_level(frequencies, amplitudes) / 20)
    return float(decibels(above.mean()))
