"""Activation sets, and statistics of the plate's vibration over all frequencies.

The paper's measure of a layout: at each frequency in turn the ERAs of an activation set are driven
together, at full stroke and in phase; the peak accelerations of all frequencies are added up at
each point (its section 3.2), and their distribution over the plate is what its box plots show.
"""

from functools import lru_cache
from itertools import combinations

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray
from model.finger.grid import Grid
from model.finger.perception import FELT_DB_SL, detection_threshold
from model.structure.plate import Plate

STATISTICS = ("minimum", "lower quartile", "median", "upper quartile", "maximum", "unfelt share")
"""Names of `cumulative_statistics`: five of cumulative peak acceleration [m/s²], and a share."""

MEDIAN = STATISTICS.index("median")

ActivationSet = tuple[int, ...]
"""Indices of the driven ERAs."""


@lru_cache(maxsize=16)
def activation_sets(era_count: int) -> tuple[ActivationSet, ...]:
    """List every ERA alone, every pair, and all together where they are more than two."""
    alone = [(era,) for era in range(era_count)]
    everything = [tuple(range(era_count))] if era_count > 2 else []
    return (*alone, *combinations(range(era_count), 2), *everything)


def felt_acceleration(frequencies: FloatArray) -> FloatArray:
    """Peak acceleration (f,) [m/s²] from which tones (f,) [Hz] are felt well, 12 dB SL.

    Raises InputError for frequencies without data on thresholds.
    """
    return detection_threshold(frequencies) * 10 ** (FELT_DB_SL / 20)


def equal_area_points(plate: Plate, *, frequency_max: float) -> FloatArray:
    """Points [m] (p, 2) that stand for equal areas of a plate: centres of nearly square cells.

    24 of them along the longer side, or as many as put twelve into a bending wave of the highest
    frequency [Hz]. On the paper's plate, against cells a quarter as long: medians within 3 %,
    quartiles within 8 %; the maximum, which lies on the edge, is up to 12 % low, and the minimum,
    which lies at a null, is just that of these points.
    """
    longer = max(plate.length, plate.width)
    size = min(longer / 24, plate.bending_wavelength(frequency_max) / 12)
    grid = Grid(max(1, round(plate.length / size)), max(1, round(plate.width / size)))
    return grid.centres(plate)


def cumulative_statistics(
    acceleration: ComplexArray | Complex64Array, *, felt: FloatArray | None = None
) -> FloatArray:
    """STATISTICS of every set of `activation_sets`, (sets, 6), from acceleration (f, eras, p).

    In the precision of the acceleration.

    Points p must stand for equal areas. felt: (f,) from where a tone is felt, same unit as the
    acceleration; the unfelt share is that of the plate where a tone stays below, mean over the
    frequencies (0 without felt).
    """
    frequency_count, era_count, point_count = acceleration.shape
    sets = activation_sets(era_count)
    precision = acceleration.real.dtype
    ones = np.ones((1, frequency_count), dtype=precision)
    peaks = np.empty((len(sets), point_count), dtype=precision)
    limits = None if felt is None else felt.astype(precision)[:, None]
    result = np.zeros((len(sets), len(STATISTICS)))
    # Two arrays for all sets: fresh ones, handed back to the system each time, cost as much again.
    together = np.empty((frequency_count, point_count), dtype=acceleration.dtype)
    amplitudes = np.empty((frequency_count, point_count), dtype=precision)
    for row, active in enumerate(sets):
        fields = acceleration[:, active[0]]
        for era in active[1:]:
            fields = np.add(fields, acceleration[:, era], out=together)
        np.abs(fields, out=amplitudes)
        np.matmul(ones, amplitudes, out=peaks[row : row + 1])
        if limits is not None:
            result[row, -1] = np.count_nonzero(amplitudes < limits) / amplitudes.size
    result[:, :-1] = _quartiles(peaks)
    return result


def _quartiles(values: FloatArray | Float32Array) -> FloatArray:
    """Minimum, quartiles and maximum of each row (n, p), (n, 5), as `np.quantile`, but faster."""
    low, high, share = _places_of_quartiles(values.shape[1])
    ordered = np.asarray(np.sort(values, axis=-1), dtype=float)
    below = ordered[:, low]
    return np.asarray(below + share * (ordered[:, high] - below))


@lru_cache(maxsize=8)
def _places_of_quartiles(count: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Places of the five values among so many sorted ones: below, above, share of the latter."""
    at = np.linspace(0, count - 1, 5)
    low = np.floor(at).astype(np.int64)
    return low, np.ceil(at).astype(np.int64), at - low
