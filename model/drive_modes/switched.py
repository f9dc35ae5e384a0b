"""The drive mode `switched`: one or two ERAs at full stroke, each at a frequency of its own.

The paper's idea: switching frequencies and activation sets moves the nulls. Four ERAs and 27
frequencies make 4 * 27 + 6 * 27² = 4482 patterns, six and 361 two millions. Every pattern is one
source or the sum of two: an ERA at a frequency, or a pair of ERAs at the same one
(`model.drive_modes.exact_search` drives more of them).

Patterns are not enumerated: the maximum over the quiet points is at least any weighted mean,
and the mean of a sum of two sources is the sum of theirs. So a pattern of contrast above c needs

    sum over its sources of (target - c mean of quiet) > 0,

one number for each source, which excludes most sources and pairs.
"""

from itertools import combinations

import numpy as np

from model.arrays import Float32Array, IntArray
from model.drive_modes.fields import SILENT, Fields, Weights
from model.drive_modes.sources import (
    all_combinations,
    magnitudes_of_sources,
    per_source,
    sums_of_sources,
)

BOUND_POINTS = 12
"""Quiet points from which the quiet maximum is bounded."""

BATCH = 48
"""Patterns evaluated together."""

FEW_SOURCES = 500
"""Up to this all sums are faster than a selection of them."""


def find_switched(fields: Fields, min_score: float) -> Weights | None:
    """Find the pattern of highest contrast that reaches the level; None if not above min_score.

    Contrast without errors, which can only lower it: at full stroke there is nothing to trade
    against them. Exact: patterns are excluded by bounds only.
    """
    magnitudes = [magnitudes_of_sources(field) for field in fields.targets]
    means = np.array([_mean(rows) for rows in magnitudes])
    peak = means.mean(axis=0)
    if (
        min_score > 0
        and not fields.has_no_quiet_contacts
        and not _may_be_better(fields, means, min_score)
    ):
        return None
    quiet = magnitudes_of_sources(fields.quiet)
    powers = _powers(magnitudes, fields)
    power = np.array([_mean(rows) for rows in powers])
    weights = _equal_weights(quiet) if fields.has_no_quiet_contacts else _loudest_weights(quiet)
    loud = quiet @ weights

    def value(
        peaks: Float32Array, at_quiet: Float32Array, powers: list[Float32Array]
    ) -> Float32Array:
        """Contrast of patterns (n,), 0 where they do not reach the level.

        Peaks at each target (targets, n) and at the quiet points (n, q); powers: (n, p) each.
        """
        sensation = np.min([_mean(np.sqrt(rows)) for rows in powers], axis=0)
        quiet_peak = (
            np.sqrt(_mean(at_quiet**2)) if fields.has_no_quiet_contacts else at_quiet.max(axis=1)
        )
        return np.asarray(np.where(sensation >= fields.wanted, peaks.min(axis=0) / quiet_peak, 0))

    nothing = len(quiet) - 1
    contrast, best = min_score, (nothing, nothing)
    # Single sources are evaluated first: their contrast excludes pairs.
    alone = value(means[:, :-1], quiet[:-1], [rows[:-1] for rows in powers])
    if alone.max() > contrast:
        contrast, best = float(alone.max()), (int(alone.argmax()), nothing)
    one, other = _pairs(peak - contrast * loud, fields)
    # The mean of a root is at most the root of the mean; one source may serve one target, the other
    # the other.
    reaches = (power[:, one] + power[:, other] >= fields.wanted**2).all(axis=0)
    one, other = one[reaches], other[reaches]
    bound = (peak[one] + peak[other]) / (loud[one] + loud[other])
    closer = fields.has_no_quiet_contacts
    while len(one) > 0:
        if len(one) > BATCH:
            order = np.argpartition(-bound, BATCH)
            one, other, bound = one[order], other[order], bound[order]
        some, more = one[:BATCH], other[:BATCH]
        found = value(
            means[:, some] + means[:, more],
            quiet[some] + quiet[more],
            [rows[some] + rows[more] for rows in powers],
        )
        if found.max() > contrast:
            at = int(found.argmax())
            contrast, best = float(found[at]), (int(one[at]), int(other[at]))
        left = BATCH + np.flatnonzero(bound[BATCH:] > contrast)
        one, other, bound = one[left], other[left], bound[left]
        if not closer and len(one) > 0:
            closer = True
            few = quiet[:, np.argsort(-weights)[:BOUND_POINTS]]
            bound = (peak[one] + peak[other]) / (few[one] + few[other]).max(axis=1)
            left = np.flatnonzero(bound > contrast)
            one, other, bound = one[left], other[left], bound[left]
    return None if best[0] == nothing else _drive(best, fields)


def _may_be_better(fields: Fields, means: Float32Array, min_score: float) -> bool:
    """Whether any pattern can have more contrast than min_score; means (targets, sources).

    From a few of the quiet points, which mostly suffice to exclude all patterns.
    """
    step = max(1, fields.quiet.shape[2] // BOUND_POINTS)
    few = magnitudes_of_sources(np.ascontiguousarray(fields.quiet[:, :, ::step]))
    gain = means.mean(axis=0) - min_score * few @ _loudest_weights(few)
    if gain.max() <= 0:  # and so no two of them have a sum above zero
        return False
    if means.shape[1] < FEW_SOURCES:
        peak = sums_of_sources(means, fields.era_count).min(axis=0)
        return bool((peak > min_score * sums_of_sources(few.T, fields.era_count).max(axis=0)).any())
    if (means.min(axis=0) > min_score * few.max(axis=1))[:-1].any():
        return True
    one, other = _pairs(gain, fields)
    loud = (few[one] + few[other]).max(axis=1, initial=0.0)
    return bool(((means[:, one] + means[:, other]).min(axis=0) > min_score * loud).any())


def _pairs(gain: Float32Array, fields: Fields) -> tuple[IntArray, IntArray]:
    """Patterns of two ERAs at two frequencies whose gains (sources,) have a sum above zero."""
    count = fields.frequency_count
    of_era = gain[: fields.era_count * count].reshape(-1, count)
    highest = of_era.max(axis=1)
    ones, others = [], []
    for one, other in combinations(range(fields.era_count), 2):
        if highest[one] + highest[other] <= 0:
            continue
        first = np.flatnonzero(of_era[one] > -highest[other])
        second = np.flatnonzero(of_era[other] > -highest[one])
        sums = of_era[one][first, None] + of_era[other][second]
        row, column = np.nonzero((sums > 0) & (first[:, None] != second))
        ones.append(one * count + first[row])
        others.append(other * count + second[column])
    if not ones:
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    return np.concatenate(ones), np.concatenate(others)


def _drive(sources: tuple[int, int], fields: Fields) -> Weights:
    """All ERAs of two sources at full stroke; see `magnitudes_of_sources` for their order."""
    count, eras = fields.frequency_count, fields.era_count
    members = [(era,) for era in range(eras)] + list(combinations(range(eras), 2)) + [()]
    index = np.full(eras, SILENT)
    for source in sources:
        block, frequency = divmod(source, count)
        index[list(members[block])] = frequency
    return Weights(index, (index != SILENT).astype(np.complex64))


def max_sensation_switched(fields: Fields) -> float:
    """Return the highest amplitude to threshold found at the weakest target.

    Among the patterns of the largest bounds, the same pattern for all targets.
    """
    patterns = all_combinations(fields.era_count, fields.frequency_count)
    powers = _powers([magnitudes_of_sources(field) for field in fields.targets], fields)
    means = np.array([_mean(rows) for rows in powers])
    highest = sums_of_sources(means, fields.era_count).min(axis=0)
    loudest = np.argsort(-highest)[:BATCH]
    one, other = patterns.first[loudest], patterns.second[loudest]
    sensation = np.min([np.sqrt(rows[one] + rows[other]).mean(axis=1) for rows in powers], axis=0)
    return float(sensation.max())


def _powers(magnitudes: list[Float32Array], fields: Fields) -> list[Float32Array]:
    """Squared sensation of every source from its magnitudes at each target, (sources, p)."""
    threshold = per_source(fields.threshold, fields.era_count)
    return [(rows / threshold) ** 2 for rows in magnitudes]


def _mean(rows: Float32Array) -> Float32Array:
    """Mean over points of (n, p), as a product: in a fifth of the time of `mean`."""
    return np.asarray(rows @ _equal_weights(rows))


def _equal_weights(rows: Float32Array) -> Float32Array:
    """Equal weights of the points of (n, p), (p,)."""
    return np.full(rows.shape[1], 1 / rows.shape[1], dtype=rows.dtype)


def _loudest_weights(quiet: Float32Array) -> Float32Array:
    """Weights of the quiet points: the fraction of sources of which each is the loudest."""
    often = np.bincount(quiet.argmax(axis=1), minlength=quiet.shape[1])
    return np.asarray(often / len(quiet), dtype=quiet.dtype)
