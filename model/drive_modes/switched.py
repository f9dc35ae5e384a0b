"""The drive mode `switched`: one or two ERAs at full stroke, each at a frequency of its own.

The paper's idea: switching frequencies and activation sets moves the nulls. Four ERAs and 27
frequencies make 4 * 27 + 6 * 27² = 4482 patterns, six and 361 two millions. Every pattern is one
source or the sum of two: an ERA at a frequency, or a pair of ERAs at the same one.

The powers of its sources, each over the squared threshold of its frequency, add to what is felt, at
the target and at every quiet fingertip. Patterns are not enumerated: the maximum over the quiet
fingertips is at least any weighted mean, and the mean of a sum is the sum of the means. So a
pattern of a power ratio above c needs

    sum over its sources of (target - c mean of quiet) > 0,

one number for each source, which excludes most sources and pairs.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray
from model.choice import NEARLY, best_few
from model.drive_modes.forms import Drive, Forms

BATCH = 256
"""Patterns evaluated together."""

ALTERNATIVES = 6
"""Patterns that are kept, the best first."""


@dataclass(frozen=True, eq=False)
class SourcePowers:
    """What each group of ERAs does at full stroke at each frequency, in squared thresholds.

    target (t, groups, f): power of the mean amplitude at each target; variance (t, groups, f): of
    that amplitude; quiet (q, groups, f): expected power.
    """

    target: Float32Array
    variance: Float32Array
    quiet: Float32Array


def source_powers(forms: Forms, members: Float32Array) -> SourcePowers:
    """Powers of groups of ERAs, members (groups, eras) 1 or 0."""
    threshold_power = (forms.threshold**2)[None, None]
    amplitude = amplitude_powers(forms.targets, members) / threshold_power
    expected = group_powers(forms.target_power, members) / threshold_power
    return SourcePowers(
        amplitude.astype(np.float32),
        np.maximum(expected - amplitude, 0).astype(np.float32),
        (group_powers(forms.quiet.swapaxes(0, 1), members) / threshold_power).astype(np.float32),
    )


def amplitude_powers(fields: ComplexArray | Complex64Array, members: Float32Array) -> FloatArray:
    """Squared magnitude of fields (t, f, eras) for groups (groups, eras): (t, groups, f)."""
    return np.asarray(np.abs(fields @ members.T).transpose(0, 2, 1) ** 2)


def group_powers(forms: Complex64Array, members: Float32Array) -> Float32Array:
    """Power of forms (q, f, eras, eras) for groups (groups, eras): (q, groups, f)."""
    q, f, *_ = forms.shape
    products = (members[:, :, None] * members[:, None]).reshape(len(members), -1)
    real = np.ascontiguousarray(forms.real).reshape(q * f, -1) @ products.T
    return np.asarray(real.reshape(q, f, -1).transpose(0, 2, 1))


def find_switched(forms: Forms) -> list[tuple[float, Drive]]:
    """Find the patterns of the best robust scores that reach the level, best first.

    Empty if none does. The first one is exact: patterns are excluded by bounds only.
    """
    eras, f = forms.era_count, forms.frequency_count
    powers = source_powers(forms, members_of(eras))
    target = powers.target.reshape(len(powers.target), -1)
    variance = powers.variance.reshape(target.shape)
    quiet = powers.quiet.reshape(len(powers.quiet), -1)
    mean_target = target.mean(axis=0)

    def score(at: Float32Array, variance: Float32Array, loud: Float32Array) -> Float32Array:
        """Power ratio (n,), 0 where the level is not reached; from sums (t, n), (t, n), (q, n)."""
        reached = np.sqrt(at) - np.float32(forms.level_margin) * np.sqrt(variance)
        reaches = (reached >= forms.wanted).all(axis=0)
        return np.asarray(
            np.where(reaches, at.min(axis=0) / np.maximum(loud.max(axis=0), 1e-30), 0)
        )

    alone = score(target, variance, quiet)
    kept = best_few(alone, ALTERNATIVES)
    found: list[tuple[float, tuple[int, ...]]] = [
        (float(alone[s]), (s,)) for s in kept.tolist() if alone[s] > 0
    ]
    best = found[0][0] if found else 0.0
    loudest = np.bincount((quiet / mean_target).argmax(axis=0), minlength=len(quiet))
    share = (loudest / loudest.sum()).astype(np.float32)
    mean_quiet = share @ quiet
    one, other = _pairs(mean_target - best * mean_quiet, eras, f)
    bound = (mean_target[one] + mean_target[other]) / (mean_quiet[one] + mean_quiet[other])
    while len(one) > 0:
        if len(one) > BATCH:
            order = np.argpartition(-bound, BATCH)
            order[:BATCH].sort()  # a partition's own order is another one on another processor
            one, other, bound = one[order], other[order], bound[order]
        some, more = one[:BATCH], other[:BATCH]
        values = score(
            target[:, some] + target[:, more],
            variance[:, some] + variance[:, more],
            quiet[:, some] + quiet[:, more],
        )
        for at in best_few(values, ALTERNATIVES).tolist():
            if values[at] > 0:
                found.append((float(values[at]), (int(some[at]), int(more[at]))))
        best = max(best, float(values.max()))
        left = BATCH + np.flatnonzero(bound[BATCH:] > (1 - NEARLY) * best)
        one, other, bound = one[left], other[left], bound[left]
    found.sort(key=lambda each: each[1])
    order = best_few([value for value, _ in found], ALTERNATIVES).tolist()
    return [
        (float(np.sqrt(value)), _drive(sources, eras, f))
        for value, sources in (found[each] for each in order)
    ]


def max_sensation_switched(forms: Forms) -> float:
    """Return the highest amplitude to threshold at the weakest target, the same pattern for all."""
    eras = forms.era_count
    powers = source_powers(forms, members_of(eras))
    return float(np.sqrt(sums_of_sources(powers.target, eras).min(axis=0).max()))


def sums_of_sources(powers: Float32Array | FloatArray, eras: int) -> Float32Array:
    """Values of all patterns (c, n), from those of all sources (c, groups, f).

    Patterns are every ERA alone, then every pair, frequencies of its first ERA running slowest.
    """
    c, _, f = powers.shape
    alone = powers[:, :eras]
    one, other = np.array(list(combinations(range(eras), 2)), dtype=int).reshape(-1, 2).T
    sums = np.empty((c, eras * f + len(one) * f * f), dtype=powers.dtype)
    sums[:, : eras * f] = alone.reshape(c, -1)
    pairs = sums[:, eras * f :].reshape(c, len(one), f, f)
    np.add(alone[:, one, :, None], alone[:, other, None, :], out=pairs)
    same = np.arange(f)
    pairs[:, :, same, same] = powers[:, eras:]
    return sums


def _pairs(gain: Float32Array, eras: int, count: int) -> tuple[IntArray, IntArray]:
    """Patterns of two ERAs at two frequencies whose gains (sources,) have a sum above zero."""
    of_era = gain[: eras * count].reshape(-1, count)
    highest = of_era.max(axis=1)
    ones, others = [], []
    for one, other in combinations(range(eras), 2):
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


@lru_cache(maxsize=8)
def members_of(eras: int) -> Float32Array:
    """Every ERA alone, then every pair, (groups, eras), as sources are ordered."""
    groups = [*((era,) for era in range(eras)), *combinations(range(eras), 2)]
    members = np.zeros((len(groups), eras), dtype=np.float32)
    for row, group in enumerate(groups):
        members[row, list(group)] = 1
    members.setflags(write=False)
    return members


def _drive(sources: tuple[int, ...], eras: int, count: int) -> Drive:
    """All ERAs of one or two sources at full stroke."""
    tones = sorted(divmod(source, count)[::-1] for source in sources)
    return [(row, members_of(eras)[group].astype(np.complex64)) for row, group in tones]
