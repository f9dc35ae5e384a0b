"""How localized a vibration is: contrast between fingertips, and level at the target."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.finger.perception import DEFAULT_THRESHOLD, decibels, sensation_level

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


def contrast_ratio(
    targets: Sequence[FloatArray],
    quiet: FloatArray,
    weights: Sequence[FloatArray] | None = None,
) -> FloatArray:
    """Contrast of peak amplitudes as a ratio: the weakest target to the loudest quiet point.

    A target counts by the mean over its points, by weights (p,) each; None where all points count
    alike. targets (..., p) each, quiet (..., q) -> (...).
    """
    each = weights or [np.full(len(target.T), 1 / len(target.T)) for target in targets]
    means = [target @ weight for target, weight in zip(targets, each, strict=True)]
    return np.asarray(np.minimum.reduce(means) / quiet.max(axis=-1))


def contrast_db(
    targets: Sequence[FloatArray],
    quiet: FloatArray,
    weights: Sequence[FloatArray] | None = None,
) -> FloatArray:
    """Return `contrast_ratio` in dB."""
    return decibels(contrast_ratio(targets, quiet, weights))


def mean_level_db_sl(
    frequencies: FloatArray,
    amplitudes: FloatArray,
    weights: FloatArray,
    threshold: str = DEFAULT_THRESHOLD,
) -> float:
    """Level [dB SL] over a fingertip: mean over its points of amplitude to threshold.

    frequencies (f,) [Hz], amplitudes (f, p) [m/s²], weights (p,) of the points; threshold: name of
    the set. Raises InputError for frequencies without data.
    """
    above = 10 ** (sensation_level(frequencies, amplitudes, threshold) / 20)
    return float(decibels(above @ weights))
