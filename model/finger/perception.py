"""Detection thresholds at the fingertip, levels above them in dB SL, and contrast.

A set of thresholds is a file in model/data/thresholds, with its sources; its name is the file's.
What is measured differs by tens of decibels between ways to touch (docs/concepts/people.md).

Felt is the part of a vibration that skin can feel: Pacinian corpuscles answer to about 1 kHz. What
is above it in an onset is the ringing of a fingertip's contact mass on the plate beneath it and of
modes far beyond the drive, of which models with different numbers of modes say different things.
"""

import csv
from collections.abc import Sequence
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

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


def highest_known(threshold: str = DEFAULT_THRESHOLD) -> float:
    """Frequency [Hz] to which a set of thresholds has data."""
    return float(_tabulated(threshold)[0][-1])


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


def sensitivities(
    frequencies: FloatArray, sets: Sequence[str], threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """How much higher an amplitude is to the thresholds of sets (s,) than to those of one, (s, f).

    frequencies (f,) [Hz]. Raises InputError for frequencies at which any has no data.
    """
    own = detection_threshold(frequencies, threshold)
    return np.array([own / detection_threshold(frequencies, each) for each in sets])


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


def contrast_db(
    targets: Sequence[FloatArray], quiet: FloatArray, weights: Sequence[FloatArray]
) -> FloatArray:
    """Contrast [dB] of peak amplitudes: the weakest target to the loudest quiet point.

    A target counts by the mean over its points, by weights (p,) each. targets (..., p) each, quiet
    (..., q) -> (...).
    """
    means = [target @ weight for target, weight in zip(targets, weights, strict=True)]
    return decibels(np.minimum.reduce(means) / quiet.max(axis=-1))


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


def over_threshold(
    samples: FloatArray, sample_rate: float, threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """What is felt of samples (n, p) [m/s²] at a rate [Hz], each frequency over its threshold.

    Beyond the data of a set its last threshold is taken.
    """
    count, known = len(samples), _tabulated(threshold)[0]
    frequencies = np.clip(np.fft.rfftfreq(2 * count, 1 / sample_rate), known[0], known[-1])
    spectrum = np.fft.rfft(felt_part(samples, sample_rate), 2 * count, axis=0)
    return np.fft.irfft(spectrum / detection_threshold(frequencies, threshold)[:, None], axis=0)[
        :count
    ]


_CUTOFF = 1250.0  # Hz; where half of a tone passes
_HALF_LENGTH = 0.002  # s; of the filter: 0.5 % up to 850 Hz, 40 dB from 1.65 kHz on


def felt_part(samples: FloatArray, sample_rate: float) -> FloatArray:
    """The part of samples (n, p) at a rate [Hz] that is up to 1 kHz, without delay, (n, p).

    Before and after the samples is silence. Sampled too slowly to hold more, they stay as they are.
    """
    if sample_rate <= 2 * _CUTOFF or not samples.size:
        return samples
    kernel = _kernel(sample_rate)
    beyond = len(kernel) // 2
    columns = [np.convolve(each, kernel)[beyond : beyond + len(samples)] for each in samples.T]
    return np.array(columns).T


@cache
def _kernel(sample_rate: float) -> FloatArray:
    """A windowed sinc whose sum is 1."""
    count = round(_HALF_LENGTH * sample_rate)
    number = np.arange(-count, count + 1)
    window = np.hanning(len(number) + 2)[1:-1]
    kernel = window * np.sinc(2 * _CUTOFF / sample_rate * number)
    return np.asarray(kernel / kernel.sum())
