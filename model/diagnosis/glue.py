"""Exciters whose glue is off: what comes through a spring between coil and plate.

    g_f ~ G |z / (z + D(w_f))|

g_f the gains with which a plate that fits explains a channel at its frequencies, D the dynamic
stiffness of the exciter, z that of its glue: above the resonance of its magnet D falls, and the
gain rises with frequency. A constant gain does not, nor does what its parts deviate by, which the
fit has found. What all channels have in common is the amplifier's.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.fit import project_gains, row_rms
from model.diagnosis.plate_match import Match
from model.structure.exciter import Exciter

_GLUES = np.geomspace(100.0, 1e5, 61)  # N/m
_RISES = 0.2  # of the logarithm of a gain over the frequencies
_EXPLAINS = 0.6  # of the median deviation without glue
_LEAST_CHANNELS = 3


def behind_glue(match: Match, values: ComplexArray, drives: Sequence[int]) -> NDArray[np.bool_]:
    """Mask (e,) of the channels whose exciters clearly act through a spring of glue.

    values (f, e, s), NaN for channels to be skipped; drives (e,): number of the ERA of each.
    """
    kept = np.isfinite(values) & ~match.outliers
    weight = kept / row_rms(values, kept)[:, :, None]
    gains, _ = project_gains(match.responses[:, list(drives)], values, weight)
    with np.errstate(divide="ignore"):
        sizes = np.log(np.abs(gains))
    sizes[~np.isfinite(sizes)] = np.nan
    driven = np.isfinite(sizes).any(axis=0)
    found = np.zeros(len(drives), dtype=bool)
    if driven.sum() < _LEAST_CHANNELS:
        return found
    sizes[:, driven] -= np.nanmedian(sizes[:, driven], axis=0)
    omega = match.plate.model.omega
    for channel in np.flatnonzero(driven).tolist():
        era = match.rig.eras[drives[channel]]
        if isinstance(era, Exciter):
            others = driven & (np.arange(len(drives)) != channel)
            own = sizes[:, channel] - np.nanmedian(sizes[:, others], axis=1)
            found[channel] = _is_behind_glue(own, era.dynamic_stiffness(omega))
    return found


def _is_behind_glue(sizes: FloatArray, stiffness: ComplexArray) -> bool:
    """Whether logarithms of gains (f,) rise as those of an exciter [N/m] behind a spring."""
    shares = -np.log(np.abs(1 + stiffness / _GLUES[:, None]))  # (glues, f)
    left = np.vstack([sizes, sizes - shares])
    left -= np.nanmedian(left, axis=1, keepdims=True)
    without, *behind = np.nanmedian(np.abs(left), axis=1).tolist()
    best = int(np.argmin(behind))
    rise = np.ptp(shares[best][np.isfinite(sizes)])
    return bool(behind[best] < _EXPLAINS * without and rise > _RISES)
