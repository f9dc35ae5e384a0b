"""The drive mode `switched`: one or two ERAs at full stroke, each at a frequency of its own.

The paper's idea: switching frequencies and activation sets moves the nulls about. Four ERAs and 27
frequencies make 4 * 27 + 6 * 27² = 4482 patterns. Every pattern is one source or the sum of two: an
ERA at a frequency, or a pair of ERAs at the same one (`model.exact_search` drives more of them).
"""

import numpy as np

from model.arrays import IntArray
from model.drive_modes.fields import SILENT, Drive, Fields, Single
from model.drive_modes.sources import (
    Patterns,
    all_patterns,
    magnitudes_of_sources,
    per_source,
    sums_of_sources,
)

# A bound on the quiet maximum comes from this many of the quiet points.
BOUND_POINTS = 12
AT_ONCE = 48  # patterns that are looked at in full together


def find_switched(fields: Fields, least: float) -> Drive | None:
    """The pattern of highest contrast that reaches the level; None where it is not above `least`.

    Contrast here is without errors, which can only lower it: at full stroke there is nothing to
    trade against them. Exact: patterns are left out only where a bound says that they cannot be
    better.
    """
    eras = fields.era_count
    patterns = all_patterns(eras, fields.frequency_count)
    first, second = patterns.first, patterns.second
    peak = _least_of_means([magnitudes_of_sources(field) for field in fields.targets], eras)
    if least > 0 and not fields.is_alone and not _may_be_better(fields, patterns, peak, least):
        return None
    powers = _powers(fields)
    quiet = magnitudes_of_sources(fields.quiet)
    if fields.is_alone:
        loud = _rms_of_sums(quiet, first, second, alone=eras * fields.frequency_count)
    else:
        loud = sums_of_sources(quiet[:, _loud_points(quiet)].T, eras).max(axis=0)
    # The mean of a root is at most the root of the mean.
    reaches = _least_of_means(powers, eras) >= fields.wanted**2
    bound = np.where(reaches, peak / loud, 0)

    best, contrast = -1, least
    open_ = np.flatnonzero(bound > least)
    while len(open_) > 0:
        if len(open_) > AT_ONCE:
            open_ = open_[np.argpartition(-bound[open_], AT_ONCE)]
        candidates, open_ = open_[:AT_ONCE], open_[AT_ONCE:]
        one, other = first[candidates], second[candidates]
        value = bound[candidates]
        if not fields.is_alone:
            value = peak[candidates] / (quiet[one] + quiet[other]).max(axis=1)
        felt = _sensation(powers, patterns, candidates)
        value = np.where(felt >= fields.wanted, value, 0)
        if value.max() > contrast:
            best, contrast = int(candidates[value.argmax()]), float(value.max())
        open_ = open_[bound[open_] > contrast]
    if best < 0:
        return None
    index = patterns.index[best].astype(int)
    return Drive(index, (index != SILENT).astype(np.complex64))


def _may_be_better(fields: Fields, patterns: Patterns, peak: Single, least: float) -> bool:
    """Whether any pattern of some peaks (n,) at the targets can have more contrast than `least`.

    Some of the quiet points will mostly do to see that nothing can. Their mean, which a sum of two
    sources has from the means of both, leaves few patterns of which to find the loudest point.
    """
    step = max(1, fields.quiet.shape[2] // BOUND_POINTS)
    few = magnitudes_of_sources(np.ascontiguousarray(fields.quiet[:, :, ::step]))
    mean = sums_of_sources(few.mean(axis=1)[None], fields.era_count)[0]
    left = np.flatnonzero(peak > least * mean)
    loud = (few[patterns.first[left]] + few[patterns.second[left]]).max(axis=1, initial=0.0)
    return bool((peak[left] > least * loud).any())


def loudest_switched(fields: Fields) -> float:
    """How many times above threshold the targets can be made to feel it.

    Of the loudest patterns by a bound, and of one and the same for all targets.
    """
    patterns = all_patterns(fields.era_count, fields.frequency_count)
    powers = _powers(fields)
    most = _least_of_means(powers, fields.era_count)
    loudest = np.argsort(-most)[:AT_ONCE]
    return float(_sensation(powers, patterns, loudest).max())


def _powers(fields: Fields) -> list[Single]:
    """Squared sensation of every source at the points of each target, (sources, p)."""
    threshold = per_source(fields.threshold, fields.era_count)
    return [(magnitudes_of_sources(field) / threshold) ** 2 for field in fields.targets]


def _least_of_means(rows: list[Single], eras: int) -> Single:
    """Of every pattern (n,) the mean over a target's points, at the target where it is least."""
    means = np.array([each.mean(axis=1) for each in rows])
    return np.asarray(sums_of_sources(means, eras).min(axis=0))


def _sensation(powers: list[Single], patterns: Patterns, chosen: IntArray) -> Single:
    """How many times above threshold some patterns (n,) are felt at the lesser target."""
    one, other = patterns.first[chosen], patterns.second[chosen]
    each = [np.sqrt(rows[one] + rows[other]).mean(axis=1) for rows in powers]
    return np.asarray(np.min(each, axis=0))


def _loud_points(quiet: Single) -> IntArray:
    """The quiet points that are the loudest of most sources, up to BOUND_POINTS of them."""
    often = np.bincount(quiet.argmax(axis=1), minlength=quiet.shape[1])
    return np.argsort(-often)[:BOUND_POINTS]


def _rms_of_sums(quiet: Single, first: IntArray, second: IntArray, *, alone: int) -> Single:
    """Root mean square over the points of every sum of two sources, of which the second is alone.

    The mean square of a + b is that of a, that of b, and twice the mean of a b.
    """
    mean_square = (quiet**2).mean(axis=1)
    cross = np.zeros((alone + 1, alone + 1), dtype=quiet.dtype)
    cross[:alone, :alone] = quiet[:alone] @ quiet[:alone].T / quiet.shape[1]
    # What is not alone has nothing beside it.
    product = cross[np.minimum(first, alone), np.minimum(second, alone)]
    return np.asarray(np.sqrt(mean_square[first] + mean_square[second] + 2 * product))
