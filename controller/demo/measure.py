"""Measures of what fingertips felt, by the same definitions as the table's predictions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.demo.far_end import FingerFelt
from model.finger.contrast import contrast_db, mean_level_db_sl
from model.vibration.peak import peak_acceleration


@dataclass(frozen=True)
class Measured:
    """Level [dB SL] at the target, and contrast [dB] to the loudest quiet point; None if alone.

    Both of the steady vibration, at the frequencies that were played.
    """

    level_db_sl: float
    contrast_db: float | None


def finger_level(felt: FingerFelt) -> float:
    """Level that a fingertip felt [dB SL], mean over its points; -inf if nothing was played."""
    return mean_level_db_sl(felt.frequencies, felt.amplitudes)


def measure(target: FingerFelt, quiet: Sequence[FingerFelt]) -> Measured | None:
    """Measures of a window; None where nothing was played in it."""
    if len(target.frequencies) == 0:
        return None
    contrast = None
    if quiet:
        others = np.concatenate([peak_acceleration(finger.amplitudes) for finger in quiet])
        contrast = float(contrast_db([peak_acceleration(target.amplitudes)], others))
    return Measured(finger_level(target), contrast)


def peak_contrast_db(target: FingerFelt, quiet: Sequence[FingerFelt]) -> float:
    """Contrast [dB] of a window's peaks, as `model.transients.measures` predicts an onset's."""
    return float(contrast_db([target.peaks], np.concatenate([finger.peaks for finger in quiet])))
