"""A finger on the plate: contact area, load, detection thresholds and contrast.

A fingertip on the plate: a disc, sampled at points with weights.

The points and weights are a cubature over a disc, for the mean of a field: rings about the centre,
along the radius Gauss-Lobatto points of the radius squared, so that the outermost ring is the rim
and the largest value over the points is close to that over the disc; evenly spaced around (product
rules: Stroud, Approximate Calculation of Multiple Integrals, 1971, section 2.6). Where an edge of
the plate cuts the disc, the mean is that over what remains of it.

Grid of target cells over the plate.

Detection thresholds at the fingertip, levels above them in dB SL, and contrast.

A set of thresholds is a file in model/data/thresholds, with its sources; its name is the file's.
What is measured differs by tens of decibels between ways to touch (docs/concepts/people.md).

Felt is the part of a vibration that skin can feel: Pacinian corpuscles answer to about 1 kHz. What
is above it in an onset is the ringing of a fingertip's contact mass on the plate beneath it and of
modes far beyond the drive, of which models with different numbers of modes say different things.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, lattice
from model.errors import InputError, is_whole
from model.structure.plate import Plate

MAX_CONTACTS = 20
"""Two people with ten fingers each, or four with five; more are a forearm or a spill."""

MAX_CONTENTS = 6
"""Contents at the same time; more have no contrast left on any plate."""


GAUSS_LEGENDRE = np.column_stack(np.polynomial.legendre.leggauss(8))
"""Points and weights (8, 2) over -1..1."""


@dataclass(frozen=True, eq=False)
class DiscRule:
    """Points (p, 2) of the unit disc with weights (..., p), which sum to 1 over the points.

    Exact for the mean over the disc of polynomials up to a degree.
    """

    points: FloatArray
    weights: FloatArray

    def cut(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (k, p, 2) and weights (..., k, p) for the disc's parts in rectangles.

        low, high (k, 2): the rectangles' corners, in radii from the disc's centre, which they
        contain. Points outside move to the nearest place inside and weigh nothing; the weights of
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
        """Weights (..., k, p): those kept, times the linear function that makes linear means exact.

        The few that would become negative are zero; the mean is exact but for that.
        """
        weights = self.weights[..., None, :] * is_kept
        weights /= weights.sum(axis=-1, keepdims=True)
        linear = np.column_stack([np.ones(len(self.points)), self.points])
        gram = (weights[..., None, :] * linear.T) @ linear
        means = np.concatenate([np.ones((len(low), 1)), _centroids(low, high)], axis=1)
        # Definite also where the points kept lie on a line, in parts narrower than a fingertip.
        tilt = np.linalg.solve(gram + 1e-9 * np.eye(3), means[:, :, None])[..., 0]
        fitted = np.maximum(weights * (tilt @ linear.T), 0)
        return np.asarray(fitted / fitted.sum(axis=-1, keepdims=True))


def _rings(*rings: tuple[float, int, float]) -> DiscRule:
    """A rule of rings: radius, number of points, and weight of all of them together."""
    points, weights = [], []
    for radius, count, weight in rings:
        angles = 2 * np.pi * np.arange(count) / count
        points.append(radius * np.column_stack([np.cos(angles), np.sin(angles)]))
        weights.append(np.full(count, weight / count))
    # Rounded, for points that shall lie on the axes.
    return DiscRule(np.concatenate(points).round(15), np.concatenate(weights))


FIVE_POINTS = _rings((0.0, 1, 1 / 2), (1.0, 4, 1 / 2))
"""The centre and four points of the rim, exact to degree 3: for searches."""

FINE_POINTS = _rings((0.0, 1, 1 / 6), (np.sqrt(0.5), 8, 4 / 6), (1.0, 12, 1 / 6))
"""Twenty-one points, twelve of them on the rim, exact to degree 7: for figures."""

FIVE_AND_FINE = DiscRule(
    np.concatenate([FIVE_POINTS.points, FINE_POINTS.points]),
    np.stack([np.pad(FIVE_POINTS.weights, (0, 21)), np.pad(FINE_POINTS.weights, (5, 0))]),
)
"""Both, the five points first: weights (2, 26) for the mean by either."""


def _centroids(low: FloatArray, high: FloatArray) -> FloatArray:
    """Centroids (k, 2) of the unit disc's parts in rectangles that hold its centre.

    Integrals over y are exact; over x by Gauss-Legendre points of the angle asin(x), piecewise
    between the corners where rim and rectangle meet.
    """
    low, high = np.maximum(low, -1), np.minimum(high, 1)
    first, last = np.arcsin(low[:, 0]), np.arcsin(high[:, 0])
    corners = np.arccos(np.abs(np.column_stack([low[:, 1], high[:, 1]])))
    ends = np.column_stack([first, -corners, corners, last])
    ends = np.sort(np.minimum(np.maximum(ends, first[:, None]), last[:, None]), axis=1)
    half = np.diff(ends, axis=1)[..., None] / 2
    angles = (ends[:, :-1, None] + half + half * GAUSS_LEGENDRE[:, 0]).reshape(len(low), -1)
    x, rim = np.sin(angles), np.cos(angles)
    widths = (half * GAUSS_LEGENDRE[:, 1]).reshape(len(low), -1) * rim
    bottom, top = np.maximum(-rim, low[:, 1:]), np.minimum(rim, high[:, 1:])
    area = (widths * (top - bottom)).sum(axis=1)
    along_x = (widths * x * (top - bottom)).sum(axis=1)
    along_y = (widths * (top**2 - bottom**2) / 2).sum(axis=1)
    return np.asarray(np.column_stack([along_x, along_y]) / area[:, None])


# A contact of 5 mm radius, the mean of index fingers on touch screens, and the 8 mm by which a
# finger may move before its pattern changes (docs/concepts/people.md).
FINGERTIP_RADIUS = 0.013


def fingertips_on(
    centres: FloatArray, *, length: float, width: float, rule: DiscRule = FINE_POINTS
) -> tuple[FloatArray, FloatArray]:
    """Points [m] (k, p, 2) under fingertips centred at (k, 2) [m] on a plate, weights (..., k, p).

    The weighted sum over a fingertip's points is the mean over its disc, or over the part of it
    that is on the plate. All points are on the plate and under the fingertip.
    """
    low = -centres / FINGERTIP_RADIUS
    high = ([length, width] - centres) / FINGERTIP_RADIUS
    points, weights = rule.cut(low, high)
    return centres[:, None] + FINGERTIP_RADIUS * points, weights


def fingertip_points(x: float, y: float, plate: Plate) -> FloatArray:
    """Points [m] (p, 2) under a fingertip centred at x, y [m] on the plate."""
    return np.asarray(_one(x, y, plate)[0][0])


def fingertip_weights(x: float, y: float, plate: Plate) -> FloatArray:
    """Weights (p,) of `fingertip_points` in the mean over the fingertip."""
    return np.asarray(_one(x, y, plate)[1][0])


def _one(x: float, y: float, plate: Plate) -> tuple[FloatArray, FloatArray]:
    return fingertips_on(np.array([[x, y]]), length=plate.length, width=plate.width)


@dataclass(frozen=True)
class Grid:
    """Target cells: nx by ny equal rectangles over the plate, numbered along x first."""

    nx: int
    ny: int

    def __post_init__(self) -> None:
        """Refuse a grid without cells or with too many."""
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

    def centres(self, plate: Plate) -> FloatArray:
        """Centres of the cells [m], (cell_count, 2)."""
        x = (np.arange(self.nx) + 0.5) * plate.length / self.nx
        return lattice(x, (np.arange(self.ny) + 0.5) * plate.width / self.ny)


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
