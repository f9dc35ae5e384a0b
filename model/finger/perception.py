"""Detection thresholds at the fingertip, and levels above them in dB SL."""

import csv
from functools import cache
from importlib import resources

import numpy as np

from model.arrays import FloatArray

DEFAULT_THRESHOLD = "vibrotactile-probe"
THRESHOLDS = {DEFAULT_THRESHOLD: "perception.csv"}
"""Files of detection thresholds in model/data by the name of the set."""

FELT_DB_SL = 12.0
STRONG_DB_SL = 20.0


@cache
def _thresholds() -> tuple[FloatArray, FloatArray]:
    """Logarithms of frequency and of threshold, as tabulated."""
    text = (
        resources.files("model")
        .joinpath("data", THRESHOLDS[DEFAULT_THRESHOLD])
        .read_text(encoding="utf-8")
    )
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    frequency = np.array([float(row["frequency_hz"]) for row in rows])
    threshold = np.array([float(row["threshold_m_s2_peak"]) for row in rows])
    return np.log(frequency), np.log(threshold)


def detection_threshold(frequency: FloatArray) -> FloatArray:
    """Peak acceleration [m/s²] that a fingertip just detects at frequencies [Hz].

    Interpolated in the logarithm of both; held constant outside the table (10 to 500 Hz). Good to
    about 4 dB between people; sources in data/perception.csv.
    """
    log_frequency, log_threshold = _thresholds()
    return np.asarray(np.exp(np.interp(np.log(frequency), log_frequency, log_threshold)))


def sensation_level(frequencies: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """Level above threshold [dB SL] of tones felt together: 20 log10 sqrt(sum (a_f / T(f))²).

    frequencies (f,) [Hz], amplitudes (f, ...) [m/s²]; -inf where nothing moves.
    """
    threshold = detection_threshold(frequencies).reshape(-1, *[1] * (amplitudes.ndim - 1))
    return decibels(np.sqrt(((amplitudes / threshold) ** 2).sum(axis=0)))


def decibels(ratio: FloatArray | float) -> FloatArray:
    """20 log10 of an amplitude ratio, of the same shape; -inf for zero."""
    with np.errstate(divide="ignore"):
        return np.asarray(20 * np.log10(ratio))
