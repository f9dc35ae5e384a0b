"""The drive mode `switched`: one or two ERAs at full stroke, each at a frequency of its own.

The paper's idea: switching frequencies and activation sets moves the nulls about. Four ERAs and 27
frequencies make 4 * 27 + 6 * 27² = 4482 patterns. Every pattern is one source or the sum of two: an
ERA at a frequency, or a pair of ERAs at the same one (`model.exact_search` drives more of them).
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.drive_modes.fields import SILENT, Drive, Fields, Single, SingleComplex

# A bound on the quiet maximum comes from this many of the quiet points.
BOUND_POINTS = 12
AT_ONCE = 48  # patterns that are looked at in full together


@dataclass(frozen=True, eq=False)
class Patterns:
    """All patterns of one or two ERAs, as sums of two sources.

    index (n, eras): of each ERA's frequency, or SILENT; first every ERA alone, then every pair,
    frequencies of the pair's first ERA running slowest. first, second (n,): rows of the sources,
    which are: each ERA at each frequency, each pair together at each frequency, and nothing.
    """

    index: NDArray[np.int16]
    first: IntArray
    second: IntArray


@lru_cache(maxsize=8)
def all_patterns(era_count: int, frequency_count: int) -> Patterns:
    """Every pattern of so many ERAs and frequencies."""
    f = np.arange(frequency_count)
    pairs = list(combinations(range(era_count), 2))
    together = era_count * frequency_count
    nothing = together + len(pairs) * frequency_count
    index, first, second = [], [], []
    for era in range(era_count):
        block = np.full((frequency_count, era_count), SILENT, dtype=np.int16)
        block[:, era] = f
        index.append(block)
        first.append(era * frequency_count + f)
        second.append(np.full(frequency_count, nothing))
    for number, (one, other) in enumerate(pairs):
        f_one, f_other = np.repeat(f, frequency_count), np.tile(f, frequency_count)
        block = np.full((frequency_count**2, era_count), SILENT, dtype=np.int16)
        block[:, one], block[:, other] = f_one, f_other
        index.append(block)
        same = f_one == f_other
        coherent = together + number * frequency_count + f_one
        first.append(np.where(same, coherent, one * frequency_count + f_one))
        second.append(np.where(same, nothing, other * frequency_count + f_other))
    return Patterns(np.concatenate(index), np.concatenate(first), np.concatenate(second))


def find_switched(fields: Fields, least: float) -> Drive | None:
    """The pattern of highest contrast that reaches the level; None where it is not above `least`.

    Contrast here is without errors, which can only lower it: at full stroke there is nothing to
    trade against them. Exact: patterns are left out only where a bound says that they cannot be
    better.
    """
    patterns = all_patterns(fields.era_count, fields.frequency_count)
    first, second = patterns.first, patterns.second
    eras = fields.era_count
    targets = [_sources(field) for field in fields.targets]
    quiet = _sources(fields.quiet)
    threshold = _per_source(fields.threshold, eras)
    powers = [(rows / threshold) ** 2 for rows in targets]

    peak = _sums(np.array([rows.mean(axis=1) for rows in targets]), eras).min(axis=0)
    # The mean of a root is at most the root of the mean.
    most = _sums(np.array([rows.mean(axis=1) for rows in powers]), eras).min(axis=0)
    if fields.is_alone:
        loud = _rms_of_sums(quiet, first, second, alone=eras * fields.frequency_count)
    else:
        loud = _sums(quiet[:, _loud_points(quiet)].T, eras).max(axis=0)
    bound = np.where(most >= fields.wanted**2, peak / loud, 0)

    best, contrast = -1, least
    open_ = np.flatnonzero(bound > least)
    while len(open_) > 0:
        if len(open_) > AT_ONCE:
            open_ = open_[np.argpartition(-bound[open_], AT_ONCE)]
        candidates, open_ = open_[:AT_ONCE], open_[AT_ONCE:]
        one, other = first[candidates], second[candidates]
        sensation = np.min(
            [np.sqrt(rows[one] + rows[other]).mean(axis=1) for rows in powers], axis=0
        )
        value = bound[candidates]
        if not fields.is_alone:
            value = peak[candidates] / (quiet[one] + quiet[other]).max(axis=1)
        value = np.where(sensation >= fields.wanted, value, 0)
        if value.max() > contrast:
            best, contrast = int(candidates[value.argmax()]), float(value.max())
        open_ = open_[bound[open_] > contrast]
    if best < 0:
        return None
    index = patterns.index[best].astype(int)
    return Drive(index, (index != SILENT).astype(np.complex64))


def loudest_switched(fields: Fields) -> float:
    """How many times above threshold the targets can be made to feel it."""
    each = [sensation_of_patterns(field, fields.threshold).mean(axis=1) for field in fields.targets]
    return float(np.min(each, axis=0).max())


def peak_of_patterns(acceleration: SingleComplex | ComplexArray) -> FloatArray:
    """Peak acceleration of every pattern, (n, p), from each ERA's at full stroke (f, eras, p).

    Two ERAs at one frequency add as complex numbers, at two frequencies their magnitudes add
    (paper Eq. 28).
    """
    patterns = all_patterns(acceleration.shape[1], acceleration.shape[0])
    rows = _sources(acceleration)
    return np.asarray(rows[patterns.first] + rows[patterns.second])


def sensation_of_patterns(
    acceleration: SingleComplex | ComplexArray, threshold: Single | FloatArray
) -> FloatArray:
    """How many times above threshold every pattern is felt, (n, p).

    threshold: (f,), same unit as the acceleration; frequencies add as powers:
    sqrt(sum over f of (a_f / T_f)²).
    """
    patterns = all_patterns(acceleration.shape[1], acceleration.shape[0])
    rows = (_sources(acceleration) / _per_source(threshold, acceleration.shape[1])) ** 2
    return np.asarray(np.sqrt(rows[patterns.first] + rows[patterns.second]))


def _sources(acceleration: SingleComplex | ComplexArray) -> Single:
    """Magnitudes (sources, p) of all sources from each ERA's field (f, eras, p)."""
    _, eras, p = acceleration.shape
    pairs = list(combinations(range(eras), 2))
    one, other = np.array(pairs, dtype=int).reshape(-1, 2).T
    by_era = acceleration.transpose(1, 0, 2)
    fields = np.concatenate([by_era, by_era[one] + by_era[other]]).reshape(-1, p)
    rows = np.zeros((len(fields) + 1, p), dtype=acceleration.real.dtype)
    # Half the time of np.abs, which guards against overflow.
    np.sqrt(fields.real**2 + fields.imag**2, out=rows[:-1])
    return rows


def _per_source(threshold: Single | FloatArray, era_count: int) -> Single:
    """Threshold (f,) of every source, (sources, 1); of nothing it is 1."""
    blocks = era_count + era_count * (era_count - 1) // 2
    return np.append(np.tile(threshold, blocks), np.ones(1, threshold.dtype))[:, None]


def _sums(rows: Single, eras: int) -> Single:
    """Of values of all sources (c, sources), those of all patterns (c, n), without an index."""
    c = len(rows)
    f = (rows.shape[1] - 1) // (eras + eras * (eras - 1) // 2)
    alone = rows[:, : eras * f].reshape(c, eras, f)
    one, other = np.array(list(combinations(range(eras), 2)), dtype=int).reshape(-1, 2).T
    sums = np.empty((c, eras * f + len(one) * f * f), dtype=rows.dtype)
    sums[:, : eras * f] = rows[:, : eras * f]
    pairs = sums[:, eras * f :].reshape(c, len(one), f, f)
    np.add(alone[:, one, :, None], alone[:, other, None, :], out=pairs)
    same = np.arange(f)
    pairs[:, :, same, same] = rows[:, eras * f : -1].reshape(c, len(one), f)
    return sums


def _loud_points(quiet: Single) -> IntArray:
    """The quiet points that are the loudest of most sources, up to BOUND_POINTS of them."""
    often = np.bincount(quiet.argmax(axis=1), minlength=quiet.shape[1])
    return np.argsort(-often)[:BOUND_POINTS]


def _rms_of_sums(quiet: Single, first: IntArray, second: IntArray, *, alone: int) -> Single:
    """Root mean square over the points of every sum of two sources, of which the second is alone.

    The mean square of a + b is that of a, that of b, and twice the mean of a b.
    """
    mean_square = (quiet**2).mean(axis=1)
    cross = np.zeros((len(quiet), len(quiet)), dtype=quiet.dtype)
    cross[:alone, :alone] = quiet[:alone] @ quiet[:alone].T / quiet.shape[1]
    square = mean_square[first] + mean_square[second] + 2 * cross[first, second]
    return np.asarray(np.sqrt(square))
