"""A finger on the plate: contact area, detection thresholds, levels above them, and contrast.

A fingertip is a disc, sampled at points with weights for the mean of a field. The cubature has
rings about the center, at Gauss-Lobatto points of the radius squared, with evenly spaced points
(product rules: Stroud, Approximate Calculation of Multiple Integrals, 1971, section 2.6). The
outermost ring is the rim, so the largest value over the points is close to the maximum over the
disc. If an edge of the plate cuts the disc, the mean is over the remaining part.

A set of detection thresholds is a file in model/data/thresholds with its sources, or in a folder of
the user; the file's name is the name of the set. Measured thresholds differ by tens of decibels
between ways to touch (docs/concepts/people.md).

Pacinian corpuscles in the skin feel vibration up to about 1 kHz. At higher frequencies, an onset
contains ringing of the fingertip's contact mass and of modes far above the drive. Models with
different numbers of modes disagree about this ringing; `felt_part` removes it.
"""

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, lattice
from model.errors import InputError, is_whole, shown
from model.structure.plate import Plate

GAUSS_LEGENDRE = np.column_stack(np.polynomial.legendre.leggauss(8))
"""Points and weights (8, 2) over -1..1."""


@dataclass(frozen=True, eq=False)
class DiscRule:
    """A cubature over the unit disc, exact for means of polynomials up to a degree."""

    points: FloatArray
    """Points (p, 2)."""
    weights: FloatArray
    """Weights (..., p), whose sum over the points is 1."""

    def cut(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points (k, p, 2) and weights (..., k, p) for the disc's parts in k rectangles.

        low, high (k, 2): corners of the rectangles, in radii from the disc's center, which they
        contain. Points outside move to the nearest point inside and get weight 0; the weights of
        the others make the mean of linear functions exact.
        """
        weights = self.weights[..., None, :].repeat(len(low), axis=-2)
        if low.max() <= -1 and high.min() >= 1:
            return self.points[None].repeat(len(low), axis=0), weights
        inside = np.minimum(np.maximum(self.points, low[:, None]), high[:, None])
        is_kept = (inside == self.points).all(axis=2)
        is_cut = ~is_kept.all(axis=1)
        if is_cut.any():
            weights[..., is_cut, :] = self._refit(is_kept[is_cut], low[is_cut], high[is_cut])
        return inside, weights

    def _refit(self, is_kept: NDArray[np.bool_], low: FloatArray, high: FloatArray) -> FloatArray:
        """Return weights (..., k, p), times the linear function that makes linear means exact.

        The few that would become negative are set to 0, which leaves a small error.
        """
        weights = self.weights[..., None, :] * is_kept
        weights /= weights.sum(axis=-1, keepdims=True)
        ones = np.ones(len(self.points))
        linear = np.column_stack([ones, self.points])
        gram = (weights[..., None, :] * linear.T) @ linear
        centroids = _centroids(low, high)
        means = np.concatenate([np.ones((len(low), 1)), centroids], axis=1)
        # Definite even if the remaining points lie on a line, in parts narrower than a fingertip.
        definite_gram = gram + 1e-9 * np.eye(3)
        coefficients = np.linalg.solve(definite_gram, means[:, :, None])[..., 0]
        linear_factors = coefficients @ linear.T
        fitted = np.maximum(weights * linear_factors, 0)
        return np.asarray(fitted / fitted.sum(axis=-1, keepdims=True))


def _rings(*rings: tuple[float, int, float]) -> DiscRule:
    """Make a rule of rings: radius, number of points, and their total weight."""
    points = list[FloatArray]()
    weights = list[FloatArray]()
    for radius, count, weight in rings:
        angles = 2 * np.pi * np.arange(count) / count
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        points.append(radius * circle)
        weights.append(np.full(count, weight / count))
    # Rounded, so that points lie exactly on the axes.
    return DiscRule(np.concatenate(points).round(15), np.concatenate(weights))


FIVE_POINTS = _rings((0.0, 1, 1 / 2), (1.0, 4, 1 / 2))
"""The center and four points of the rim, exact to degree 3: for searches."""

FINE_POINTS = _rings((0.0, 1, 1 / 6), (np.sqrt(0.5), 8, 4 / 6), (1.0, 12, 1 / 6))
"""Twenty-one points (twelve on the rim), exact to degree 7: for figures."""

ENDS = (1, 2, 3, 4)
"""Indices of the points of `FIVE_POINTS` at the ends of the disc: +x, +y, -x, -y."""

FINE_ENDS = (9, 12, 15, 18)
"""Indices of the same points in `FINE_POINTS`."""

FINE_DIAGONAL = (2, 4, 6, 8)
"""Indices of the points of `FINE_POINTS` at (+-1/2, +-1/2), by quadrant."""

FIVE_AND_FINE = DiscRule(
    points=np.concatenate([FIVE_POINTS.points, FINE_POINTS.points]),
    weights=np.stack([np.pad(FIVE_POINTS.weights, (0, 21)), np.pad(FINE_POINTS.weights, (5, 0))]),
)
"""Both rules, the five points first, with weights (2, 26) for the mean by each."""


def _centroids(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the centroids (k, 2) of the unit disc's parts in rectangles that contain its center.

    Integrals over y are exact; over x by Gauss-Legendre points of the angle asin(x), piecewise
    between the corners where rim and rectangle meet.
    """
    low = np.maximum(low, -1)
    high = np.minimum(high, 1)
    count = len(low)
    first = np.arcsin(low[:, :1])
    last = np.arcsin(high[:, :1])
    heights = np.column_stack([low[:, 1], high[:, 1]])
    corners = np.arccos(np.abs(heights))
    ends = np.column_stack([first, -corners, corners, last])
    ends = np.sort(np.minimum(np.maximum(ends, first), last), axis=1)
    half = np.diff(ends, axis=1)[..., None] / 2
    angles = (ends[:, :-1, None] + half + half * GAUSS_LEGENDRE[:, 0]).reshape(count, -1)
    x = np.sin(angles)
    rim = np.cos(angles)
    widths = (half * GAUSS_LEGENDRE[:, 1]).reshape(count, -1) * rim
    bottom = np.maximum(-rim, low[:, 1:])
    top = np.minimum(rim, high[:, 1:])
    height = top - bottom
    area = (widths * height).sum(axis=1)
    along_x = (widths * x * height).sum(axis=1)
    along_y = (widths * (top**2 - bottom**2) / 2).sum(axis=1)
    return np.asarray(np.column_stack([along_x, along_y]) / area[:, None])


FINGERTIP_RADIUS = 0.013
"""Radius [m] over which a fingertip counts.

A contact of 5 mm radius, the mean of index fingers on touch screens, and the 8 mm that a finger can
move before its pattern changes (docs/concepts/people.md).
"""


def fingertips_on(
    centers: FloatArray, *, length: float, width: float, rule: DiscRule = FINE_POINTS
) -> tuple[FloatArray, FloatArray]:
    """Return points (k, p, 2) [m] under fingertips centered at (k, 2) [m], and weights (..., k, p).

    The weighted sum over a fingertip's points is the mean over its disc, or over the part of the
    disc on the plate. All points are on the plate and under the fingertip.
    """
    low = -centers / FINGERTIP_RADIUS
    high = ([length, width] - centers) / FINGERTIP_RADIUS
    points, weights = rule.cut(low, high)
    return centers[:, None] + FINGERTIP_RADIUS * points, weights


def fingertip_points(x: float, y: float, plate: Plate) -> FloatArray:
    """Return points (p, 2) [m] under a fingertip centered at x, y [m] on the plate."""
    points, _ = _single_fingertip(x, y, plate)
    return np.asarray(points[0])


def fingertip_weights(x: float, y: float, plate: Plate) -> FloatArray:
    """Return the weights (p,) of `fingertip_points` in the mean over the fingertip."""
    _, weights = _single_fingertip(x, y, plate)
    return np.asarray(weights[0])


def _single_fingertip(x: float, y: float, plate: Plate) -> tuple[FloatArray, FloatArray]:
    return fingertips_on(np.array([[x, y]]), length=plate.length, width=plate.width)


@dataclass(frozen=True)
class Grid:
    """Grid of target cells: nx by ny equal rectangles over the plate, numbered along x first."""

    nx: int
    ny: int

    def __post_init__(self) -> None:
        """Reject a grid without cells or with too many."""
        if not (is_whole(self.nx) and is_whole(self.ny)):
            raise InputError(f"grid: numbers of cells must be integers, got {self}")
        if not (1 <= self.nx <= 200 and 1 <= self.ny <= 200):
            raise InputError(f"grid must be 1x1 to 200x200 cells, got {self}")

    def __str__(self) -> str:
        return f"{self.nx}x{self.ny}"

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.nx * self.ny

    def centers(self, plate: Plate) -> FloatArray:
        """Return the centers (cell_count, 2) of the cells [m]."""
        x = (np.arange(self.nx) + 0.5) * plate.length / self.nx
        y = (np.arange(self.ny) + 0.5) * plate.width / self.ny
        return lattice(x, y)


DEFAULT_THRESHOLD = "vibrotactile-probe"

FELT_DB_SL = 12.0
"""Level at which a vibration is clearly felt."""

STRONG_DB_SL = 20.0
"""Level at which a vibration is strong."""

THRESHOLD_FOLDER_VARIABLE = "ERA_HAPTICS_THRESHOLDS"
"""Environment variable with a folder of further threshold sets, such as those of a study."""


def _files_in(folder: Traversable) -> dict[str, Traversable]:
    """Return the files of threshold sets in a folder, by the name of the set; none without it."""
    if not folder.is_dir():
        return {}
    files = [file for file in folder.iterdir() if file.name.endswith(".csv")]
    return {file.name.removesuffix(".csv"): file for file in files}


_PUBLISHED_FILES = _files_in(resources.files("model").joinpath("data/thresholds"))
_OWN_FOLDER = os.environ.get(THRESHOLD_FOLDER_VARIABLE)
_OWN_FILES = _files_in(Path(_OWN_FOLDER)) if _OWN_FOLDER else {}
_FILES = _OWN_FILES | _PUBLISHED_FILES  # a published name keeps its meaning

PUBLISHED_THRESHOLDS = tuple(sorted(_PUBLISHED_FILES))
"""Names of the published sets of detection thresholds."""

THRESHOLDS = tuple(sorted(_FILES))
"""Names of all sets of detection thresholds."""


@cache
def _rows(threshold: str) -> list[dict[str, str]]:
    text = _FILES[threshold].read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


@cache
def _tabulated(threshold: str) -> tuple[FloatArray, FloatArray]:
    """Return the tabulated frequencies [Hz] and peak accelerations [m/s²] of a set."""
    try:
        rows = _rows(threshold)
        frequency = np.array([float(row["frequency_hz"]) for row in rows])
        acceleration = np.array([float(row["threshold_m_s2_peak"]) for row in rows])
        is_valid = len(rows) > 0 and bool(
            (np.diff(frequency) > 0).all() and frequency[0] > 0 and (acceleration > 0).all()
        )
    except (OSError, KeyError, TypeError, ValueError):
        is_valid = False
    if not is_valid:
        raise InputError(
            f"{_FILES[threshold]} must have the columns frequency_hz (ascending), "
            "threshold_m_s2_peak and basis, with positive numbers"
        )
    return frequency, acceleration


@cache
def highest_measured(threshold: str = DEFAULT_THRESHOLD) -> float:
    """Return the frequency [Hz] above which a set of thresholds is extrapolated."""
    measured = [row for row in _rows(threshold) if row.get("basis") != "extrapolated"]
    return max([float(row["frequency_hz"]) for row in measured])


def highest_known(threshold: str = DEFAULT_THRESHOLD) -> float:
    """Return the frequency [Hz] up to which a set of thresholds has data."""
    return float(_tabulated(threshold)[0][-1])


def check_has_threshold(
    frequency: float | Sequence[float] | FloatArray, threshold: str = DEFAULT_THRESHOLD
) -> None:
    """Raise InputError for frequencies [Hz] at which a set of thresholds has no data."""
    try:
        frequencies = np.asarray(frequency, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"frequency must be numbers of hertz, got {shown(frequency)}") from None
    if threshold not in THRESHOLDS:
        raise InputError(f"threshold must be one of {', '.join(THRESHOLDS)}, got {threshold!r}")
    tabulated, _ = _tabulated(threshold)
    low, high = tabulated[0], tabulated[-1]
    has_data = (low <= frequencies) & (frequencies <= high)
    outside = frequencies[~has_data]  # NaN too
    if outside.size:
        raise InputError(
            f"frequency must be {low:g} to {high:g} Hz, where the thresholds {threshold} have "
            f"data, got {outside.flat[0]:g} Hz"
        )


def detection_threshold(
    frequency: float | Sequence[float] | FloatArray, threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """Return the peak acceleration [m/s²] that a fingertip just detects at frequencies [Hz].

    threshold: name of the set. Interpolated in the logarithm of both. Raises InputError for
    frequencies without data.

    Example:
        >>> era.detection_threshold([60.0, 250.0]).round(3).tolist()
        [0.276, 0.247]
    """
    check_has_threshold(frequency, threshold)
    tabulated, accelerations = _tabulated(threshold)
    logarithm = np.interp(np.log(frequency), np.log(tabulated), np.log(accelerations))
    return np.exp(logarithm)


def sensitivities(
    frequencies: FloatArray, sets: Sequence[str], threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """Return the ratios (s, f) of a set's thresholds to the thresholds of s other sets.

    An amplitude is higher above the other sets' thresholds by these factors. frequencies (f,) [Hz].
    Raises InputError for frequencies at which any set has no data.
    """
    own = detection_threshold(frequencies, threshold)
    return np.array([own / detection_threshold(frequencies, name) for name in sets])


def sensation_level(
    frequencies: FloatArray, amplitudes: FloatArray, threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """Return the level [dB SL] of tones felt together: 20 log10 sqrt(sum (a_f / T(f))²).

    frequencies (f,) [Hz], amplitudes (f, ...) [m/s²]; -inf for zero amplitude. Raises InputError
    for frequencies without data.
    """
    thresholds = detection_threshold(frequencies, threshold)
    other_axes = [1] * (amplitudes.ndim - 1)
    ratios = amplitudes / thresholds.reshape(-1, *other_axes)
    return decibels(np.sqrt((ratios**2).sum(axis=0)))


def scale_in_words(threshold: str) -> str:
    """Name the threshold set that levels in dB SL are relative to, for reports and labels."""
    return f"levels above the thresholds of {threshold}"


def decibels(ratio: FloatArray | float) -> FloatArray:
    """Return 20 log10 of amplitude ratios, of the same shape; -inf for zero."""
    with np.errstate(divide="ignore"):
        return 20 * np.log10(ratio)


NEAR_RADIUS = 0.05
"""Distance [m] at which the background of a finger begins, about two fingertips."""


def is_beyond(points: FloatArray, targets: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which points (p, 2) [m] are farther than NEAR_RADIUS from every target [m], (p,)."""
    distances = np.linalg.norm(points[:, None] - np.array(targets), axis=-1)
    beyond: NDArray[np.bool_] = (distances > NEAR_RADIUS).all(axis=1)
    return beyond


def is_background(points: FloatArray, targets: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which points (p, 2) [m] are background to targets [m], (p,).

    Points beyond NEAR_RADIUS, or all points on a plate too small for this.
    """
    beyond = is_beyond(points, targets)
    return beyond if beyond.any() else ~beyond


def contrast_db(
    targets: Sequence[FloatArray], quiet: FloatArray, weights: Sequence[FloatArray]
) -> FloatArray:
    """Return the contrast (...) [dB] of peak amplitudes: weakest target to loudest quiet point.

    targets: amplitudes (..., p) at the points of each target, whose mean with weights (p,) counts;
    quiet: amplitudes (..., q) at quiet points.
    """
    means = [target @ weight for target, weight in zip(targets, weights, strict=True)]
    return decibels(np.minimum.reduce(means) / quiet.max(axis=-1))


def mean_level_db_sl(
    frequencies: FloatArray,
    amplitudes: FloatArray,
    weights: FloatArray,
    threshold: str = DEFAULT_THRESHOLD,
) -> float:
    """Return the level [dB SL] over a fingertip: mean over its points of amplitude to threshold.

    frequencies (f,) [Hz], amplitudes (f, p) [m/s²], weights (p,) of the points; threshold: name of
    the set. Raises InputError for frequencies without data.
    """
    levels = sensation_level(frequencies, amplitudes, threshold)
    ratios = 10 ** (levels / 20)
    return float(decibels(ratios @ weights))


def over_threshold(
    samples: FloatArray, sample_rate: float, threshold: str = DEFAULT_THRESHOLD
) -> FloatArray:
    """Divide samples (n, p) [m/s²] at a rate [Hz] by the threshold at each frequency.

    Uses only their felt part. Beyond the data of a set, its last threshold is used.
    """
    count = len(samples)
    tabulated, _ = _tabulated(threshold)
    spectrum = np.fft.rfft(felt_part(samples, sample_rate), 2 * count, axis=0)
    frequencies = np.fft.rfftfreq(2 * count, 1 / sample_rate)
    thresholds = detection_threshold(np.clip(frequencies, tabulated[0], tabulated[-1]), threshold)
    ratios = np.fft.irfft(spectrum / thresholds[:, None], axis=0)
    return ratios[:count]


_CUTOFF = 1250.0  # Hz; where half of a tone passes
_HALF_LENGTH = 0.002  # s; of the filter: 0.5 % up to 850 Hz, 40 dB from 1.65 kHz on


def felt_part(samples: FloatArray, sample_rate: float) -> FloatArray:
    """Low-pass samples (n, p) at a rate [Hz] to the frequencies that skin can feel, without delay.

    There is silence before and after the samples. Samples are returned unchanged if their rate is
    too low for higher frequencies.
    """
    if sample_rate <= 2 * _CUTOFF or not samples.size:
        return samples
    kernel = _kernel(sample_rate)
    delay = len(kernel) // 2
    columns = list[FloatArray]()
    for column in samples.T:
        filtered = np.convolve(column, kernel)
        columns.append(filtered[delay : delay + len(samples)])
    return np.array(columns).T


@cache
def _kernel(sample_rate: float) -> FloatArray:
    """Return a windowed sinc whose sum is 1."""
    count = round(_HALF_LENGTH * sample_rate)
    number = np.arange(-count, count + 1)
    window = np.hanning(len(number) + 2)[1:-1]
    kernel = window * np.sinc(2 * _CUTOFF / sample_rate * number)
    return np.asarray(kernel / kernel.sum())
