"""Sources, and the patterns of one or two ERAs as sums of them.

A source is an ERA at a frequency, or a pair of ERAs together at the same one. Two ERAs at one
frequency add as complex numbers, at two frequencies their magnitudes add (paper Eq. 28), so that
every pattern is one source or the sum of two.
"""

from functools import lru_cache
from itertools import combinations

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray


def magnitudes_of_sources(acceleration: Complex64Array | ComplexArray) -> Float32Array:
    """Peak acceleration (sources, p) of all sources from each ERA's field (f, eras, p)."""
    f, eras, p = acceleration.shape
    by_era = acceleration.transpose(1, 0, 2)
    groups = eras * (eras + 1) // 2
    rows = np.zeros((groups * f + 1, p), dtype=acceleration.real.dtype)
    blocks = rows[:-1].reshape(groups, f, p)
    _magnitude(by_era, blocks[:eras])
    start = eras
    for era in range(eras - 1):
        end = start + eras - 1 - era
        _magnitude(by_era[era + 1 :] + by_era[era], blocks[start:end])
        start = end
    return rows


def _magnitude(fields: Complex64Array | ComplexArray, into: Float32Array) -> None:
    """Write magnitudes of fields of any shape; three times as fast as `np.abs` of them."""
    np.multiply(fields.real, fields.real, out=into)
    into += fields.imag * fields.imag
    np.sqrt(into, out=into)


def per_source(threshold: Float32Array | FloatArray, era_count: int) -> Float32Array:
    """Threshold (f,) of every source, (sources, 1); of nothing it is 1."""
    blocks = era_count * (era_count + 1) // 2
    return np.append(np.tile(threshold, blocks), np.ones(1, threshold.dtype))[:, None]


def sums_of_sources(rows: Float32Array, eras: int) -> Float32Array:
    """Values of all patterns (c, n), from those of all sources (c, sources).

    Sources are each ERA at each frequency, each pair together at each frequency, and nothing;
    patterns every ERA alone, then every pair, frequencies of its first ERA running slowest.
    """
    c = len(rows)
    f = (rows.shape[1] - 1) // (eras * (eras + 1) // 2)
    alone = rows[:, : eras * f].reshape(c, eras, f)
    one, other = _pairs(eras)
    sums = np.empty((c, eras * f + len(one) * f * f), dtype=rows.dtype)
    sums[:, : eras * f] = rows[:, : eras * f]
    pairs = sums[:, eras * f :].reshape(c, len(one), f, f)
    np.add(alone[:, one, :, None], alone[:, other, None, :], out=pairs)
    same = np.arange(f)
    pairs[:, :, same, same] = rows[:, eras * f : -1].reshape(c, len(one), f)
    return sums


@lru_cache(maxsize=8)
def _pairs(eras: int) -> tuple[IntArray, IntArray]:
    """The first and the second of every pair of ERAs."""
    one, other = np.array(list(combinations(range(eras), 2)), dtype=int).reshape(-1, 2).T
    return one, other
