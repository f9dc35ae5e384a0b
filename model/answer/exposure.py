"""Exposure of fingers to vibration, weighted as ISO 5349-1 does for the hand.

What a finger feels above its threshold says nothing of what harms it in the long run: that goes by
acceleration, weighted by frequency (docs/concepts/people.md).
"""

import numpy as np

from model.answer.answer import Answer
from model.answer.fingers_on_plate import FingersOnPlate
from model.answer.promised import loudest_power, promise
from model.answer.search import PROMISED_PERCENTILE
from model.arrays import FloatArray
from model.ensemble.draws import PROMISED_DRAWS
from model.table.table import LocalizationTable

# Hz; of the limits of the band, 10^0.8 and 10^3.1, and where the weighting begins to fall.
_LOW, _HIGH, _FALL = 10**0.8, 10**3.1, 100 / (2 * np.pi)
_BAND_Q, _FALL_Q = 1 / np.sqrt(2), 0.64


def hand_weighting(frequencies: FloatArray) -> FloatArray:
    """Weighting Wh at frequencies [Hz], of the same shape: 0.96 at 12.5 Hz, 0.063 at 250 Hz.

    Of a band from 6.3 to 1259 Hz, second-order Butterworth on both sides, and of a transition from
    acceleration to velocity at 15.9 Hz (ISO 5349-1:2001, annex A; ISO 8041).
    """
    s = 1j * np.asarray(frequencies)
    band = s**2 / (s**2 + _LOW / _BAND_Q * s + _LOW**2)
    band = band * _HIGH**2 / (s**2 + _HIGH / _BAND_Q * s + _HIGH**2)
    fall = (s + _FALL) * _FALL / (s**2 + _FALL / _FALL_Q * s + _FALL**2)
    return np.asarray(np.abs(band * fall))


def exposures(table: LocalizationTable, found: Answer) -> list[float]:
    """Weighted acceleration at each finger of an answer, root mean square [m/s²].

    Of all vibrations together, normal to the plate, at the loudest point of the fingertip, while
    they are at their full strength; nine of ten plates do not exceed it. Beyond 1 kHz, where
    thresholds end, harmonics do not count.
    """
    tones, contents = found.tones, found.contents
    if not tones.rows:
        return [0.0] * len(contents.places)
    rows, gains = np.array(tones.rows), np.array(tones.gains)
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    drawn = PROMISED_DRAWS, rows, np.array(tones.weights, dtype=np.complex64)
    frequencies, at_harmonics = table.frequencies[rows], table.compared_harmonic_thresholds[rows]
    factors, of_harmonics = (
        (gains * np.where(np.isfinite(each), each, 0.0) * hand_weighting(at)) ** 2 / 2
        for each, at in ((table.thresholds[rows], frequencies), (at_harmonics, 2 * frequencies))
    )
    power = fingers.powers(*drawn) * factors.astype(np.float32)[:, None, None, None]
    harmonics = fingers.harmonics(*drawn) * of_harmonics.astype(np.float32)[:, None, None]
    return [
        promise(np.sqrt(loudest_power(power, harmonics, rows, finger)), 100 - PROMISED_PERCENTILE)
        for finger in range(len(contents.places))
    ]
