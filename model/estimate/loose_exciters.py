"""Channels whose exciter acts on the plate with only part of its contact.

A spring of glue z between coil and plate gives gains g_f ~ G |z / (z + D(w_f))|, where the dynamic
stiffness D of the exciter decreases above the resonance of the magnet: the gain rises with
frequency. A change common to all channels comes from the amplifier.
"""

from collections.abc import Sequence

import numpy as np

from model.arrays import FloatArray, best_of
from model.estimate.gains import gains_of
from model.estimate.hypotheses import Hypothesis
from model.estimate.plate_match import Match
from model.structure.exciter import Exciter

_MAX_LOOSE_SHARE = 0.7  # of its own stiffness with which an exciter explains a plate
_GLUES = np.geomspace(100.0, 1e5, 61)  # N/m, stiffness of glue
_MIN_RISE = 0.2  # of the logarithm of a gain over the frequencies
_MAX_RESIDUAL_SHARE = 0.6  # of the median residual without glue
_MIN_CHANNELS = 3  # whose median shows a common error of the amplifier


def loosened_channels(match: Match, hypotheses: Sequence[Hypothesis]) -> set[int]:
    """Return the channels of exciters that differ most, or are the likeliest hypothesis.

    Each acts with less than its own stiffness.
    """
    rig = match.plate.rig
    parameters = match.plate.parameters
    farthest = parameters[best_of(np.abs(match.z))].era
    shares = []
    for hypothesis in hypotheses[:1]:
        if hypothesis.era:
            shares.append((hypothesis.era, hypothesis.value / hypothesis.expected))
    for parameter in parameters:
        if parameter.era and parameter.era == farthest and parameter.is_factor:
            shares.append((parameter.era, parameter.of(match.rig) / parameter.of(rig)))
    loose = set()
    for era, share in shares:
        if share <= _MAX_LOOSE_SHARE and isinstance(rig.era(era), Exciter):
            loose.add(era)
    return {n for n, number in enumerate(match.drives) if rig.eras[number].name in loose}


def channels_behind_glue(match: Match) -> set[int]:
    """Return the channels whose exciter clearly acts through a spring of glue."""
    values = np.where(match.outliers, np.nan, match.values)
    gains = np.abs(gains_of(match.responses[..., match.drives], values))
    sizes = np.log(np.where(gains > 0, gains, np.nan))
    driven = np.flatnonzero(np.isfinite(sizes).any(axis=0)).tolist()
    if len(driven) < _MIN_CHANNELS:
        return set()
    sizes[:, driven] -= np.nanmedian(sizes[:, driven], axis=0)
    glued = set()
    for number in driven:
        rivals = [rival for rival in driven if rival != number]
        size = sizes[:, number] - np.nanmedian(sizes[:, rivals], axis=1)
        exciter = match.rig.eras[match.drives[number]]
        if isinstance(exciter, Exciter) and _rises_like_glue(size, exciter, match.plate.omega):
            glued.add(number)
    return glued


def _rises_like_glue(size: FloatArray, exciter: Exciter, omega: FloatArray) -> bool:
    """Whether a spring of glue explains the logarithms of an exciter's gains (f,) clearly."""
    stiffness = exciter.dynamic_stiffness(omega)
    transmitted = -np.log(np.abs(1 + stiffness / _GLUES[:, None]))  # (glues, f)
    residuals = np.vstack([size, size - transmitted])
    residuals -= np.nanmedian(residuals, axis=1, keepdims=True)
    without_glue, *with_glue = np.nanmedian(np.abs(residuals), axis=1).tolist()
    best = int(np.argmin(with_glue))
    rise = np.ptp(transmitted[best][np.isfinite(size)])
    return bool(with_glue[best] < _MAX_RESIDUAL_SHARE * without_glue and rise > _MIN_RISE)
