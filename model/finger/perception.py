"""Detection thresholds at the fingertip, and levels above them in dB SL.

A set of thresholds is a file in model/data/thresholds, with its sources; its name is the file's.
What is measured differs by tens of decibels between ways to touch (docs/concepts/people.md).
"""

import csv
from functools import cache
from importlib import resources

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError

DEFAULT_THRESHOLD = "vibrotactile-probe"

FELT_DB_SL = 12.0
STRONG_DB_SL = 20.0

_FOLDER = resources.files("model").joinpath("data/thresholds")

THRESHOLDS = tuple(
    sorted(
        each.name.removesuffix(".csv") for each in _FOLDER.iterdir() if each.name.endswith(".csv")
    )
)
"""Names of the sets of detection thresholds."""


@cache
def _rows(threshold: str) -> list[dict[str, str]]:
    text = _FOLDER.joinpath(f"{threshold}.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


@cache
def _tabulated(threshold: str) -> tuple[FloatArray, FloatArray]:
    """Frequencies [Hz] and peak accelerations [m/s²] of a set, as tabulated."""
    rows = _rows(threshold)
    frequency = np.array([float(row["frequency_hz"]) for row in rows])
    return frequency, np.array([float(row["threshold_m_s2_peak"]) for row in rows])


@cache
def highest_measured(threshold: str = DEFAULT_THRESHOLD) -> float:
    """Frequency [Hz] above which a set of thresholds is extrapolated."""
    known = (row for row in _rows(threshold) if row["basis"] != "extrapolated")
    return max(float(row["frequency_hz"]) for row in known)


def check_has_threshold(frequency: FloatArray, threshold: str = DEFAULT_THRESHOLD) -> None:
    """Raise InputError for frequencies [Hz] at which a set of thresholds has no data."""
    if threshold not in THRESHOLDS:
        raise InputError(f"threshold must be one of {', '.join(THRESHOLDS)}, got {threshold!r}")
    low, high = _tabulated(threshold)[0][[0, -1]]
    outside = np.asarray(frequency)[~((low <= frequency) & (frequency <= high))]  # NaN too
    if outside.size:
        raise InputError(
            f"frequency must be {low:g} to {high:g} Hz, where the thresholds {threshold} have "
            f"data, got {outside.flat[0]:g} Hz"
        )


def detection_threshold(frequency: FloatArray, threshold: str = DEFAULT_THRESHOLD) -> FloatArray:
    """Peak acceleration [m/s²] that a fingertip just detects at frequencies [Hz].

    threshold: name of the set. Interpolated in the logarithm of both. Raises InputError for
    frequencies without data.
    """
    check_has_threshold(frequency, threshold)
    known, acceleration = _tabulated(threshold)
    return np.asarray(np.exp(np.interp(np.log(frequency), np.log(known), np.log(acceleration))))


def sensitivity_margin_db(frequency: FloatArray, threshold: str = DEFAULT_THRESHOLD) -> FloatArray:
    """How far [dB] the lowest of all sets lies below one at frequencies [Hz], at least 0.

    Raises InputError for frequencies at which that one has no data; others without are left out.
    """
    own = detection_threshold(frequency, threshold)
    lowest = own
    for name in THRESHOLDS:
        low, high = _tabulated(name)[0][[0, -1]]
        inside = (low <= frequency) & (frequency <= high)
        other = detection_threshold(np.clip(frequency, low, high), name)
        lowest = np.where(inside, np.minimum(lowest, other), lowest)
    return decibels(own / lowest)


def sensation_level(
    frequencies: FloatArray, amplitudes: FloatArray, threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """Level above threshold [dB SL] of tones felt together: 20 log10 sqrt(sum (a_f / T(f))²).

    frequencies (f,) [Hz], amplitudes (f, ...) [m/s²]; -inf where nothing moves. Raises InputError
    for frequencies without data.
    """
    lowest = detection_threshold(frequencies, threshold)
    above = amplitudes / lowest.reshape(-1, *[1] * (amplitudes.ndim - 1))
    return decibels(np.sqrt((above**2).sum(axis=0)))


def decibels(ratio: FloatArray | float) -> FloatArray:
    """20 log10 of an amplitude ratio, of the same shape; -inf for zero."""
    with np.errstate(divide="ignore"):
        return np.asarray(20 * np.log10(ratio))
