"""The drive mode `switched`: one or two ERAs at full stroke, each at a frequency of its own.

The paper's idea: switching frequencies and activation sets moves the nulls. Four ERAs and 27
frequencies make 4 * 27 + 6 * 27² = 4482 patterns, sixteen and 47 a quarter of a million.

Powers of tones of different frequencies, each over the squared threshold of its frequency, add to
what is felt, at the target and at every quiet fingertip; at one frequency the fields add. So all
patterns of two ERAs are the sums of a column and a row, but for their diagonal. The maximum over
the quiet fingertips is at least any weighted mean, and the mean of a sum is the sum of the means:
one number for each pattern, which leaves few to be looked at closely.
"""

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.choice import best_few
from model.drive_modes.forms import Drive, Forms

ALTERNATIVES = 4
"""Patterns that are kept, the best first, for drawn plates to choose among."""

BATCH = 512
"""Patterns that are looked at closely at first, those of the highest bounds."""

_LEAST = np.float32(1e-30)


def find_switched(forms: Forms) -> list[tuple[float, Drive]]:
    """Find the patterns of the best robust scores that reach the level, best first.

    Empty if none does. Exact: patterns are excluded by bounds only.
    """
    t, above = len(forms.targets), np.square(forms.threshold)[:, None, None]
    expected = np.concatenate([forms.target_power, forms.quiet.swapaxes(0, 1)]).real
    every = np.concatenate([power_forms(forms.targets), expected]) / above
    powers = _with_silence(every.astype(np.float32))
    alone = np.diagonal(powers[:, 1:], axis1=2, axis2=3)
    loudest = (alone[2 * t :] / np.maximum(alone[:t].mean(axis=0), _LEAST)).argmax(axis=0)
    share = np.bincount(loudest.ravel(), minlength=len(powers) - 2 * t) / loudest.size
    heard = np.tensordot(share.astype(np.float32), powers[2 * t :], axes=1)
    target, quiet = _sums_of_pairs(np.stack([powers[:t].mean(axis=0), heard]))
    bounds = target / np.maximum(quiet, _LEAST)
    one, other = np.triu_indices(forms.era_count, 1)
    bounds[one + 1 < other, :, 0] = bounds[:-1, 0] = -1  # an ERA alone counts once
    count, bound = BATCH, bounds.ravel()
    while True:
        order = np.argpartition(-bound, min(count, len(bound) - 1))
        some = np.sort(order[:count])  # a partition's own order is another one elsewhere
        pair, first, second = np.unravel_index(some, bounds.shape)
        tones = np.array([[first, one[pair]], [second, other[pair]]])
        score = np.where(bound[some] < 0, 0, _scores(forms, powers, *tones))
        best = best_few(score, ALTERNATIVES)
        if count >= len(bound) or score[best[-1]] >= bound[order[count]]:
            break
        count *= 4
    return [
        (float(np.sqrt(score[each])), _drive(tones[:, :, each].tolist(), forms.era_count))
        for each in best.tolist()
        if score[each] > 0
    ]


def _scores(forms: Forms, powers: Float32Array, one: IntArray, other: IntArray) -> Float32Array:
    """Power ratios (m,) of patterns of two tones (2, m) of powers `_with_silence`.

    0 where the level is not reached.
    """
    (i, a), (j, b), t = one, other, len(forms.targets)
    sums = powers[:, i, a, a] + powers[:, j, b, b] + (i == j) * 2 * powers[:, i, a, b]
    at, deviation = sums[:t], np.sqrt(np.maximum(sums[t : 2 * t] - sums[:t], 0))
    reaches = np.sqrt(at) - np.float32(forms.level_margin) * deviation >= forms.wanted
    ratio = at.min(axis=0) / np.maximum(sums[2 * t :].max(axis=0), _LEAST)
    return np.asarray(np.where(reaches.all(axis=0), ratio, 0))


def max_sensation_switched(forms: Forms) -> float:
    """Return the highest amplitude to threshold at the weakest target, the same pattern for all."""
    return float(highest_levels((forms.targets / forms.threshold[:, None])[None])[0])


def highest_levels(fields: Complex64Array) -> Float32Array:
    """Highest amplitudes (m,) that a pattern gives the weakest of t targets, (m, t, f, eras)."""
    found = [_sums_of_pairs(_with_silence(power_forms(each))).min(axis=0).max() for each in fields]
    return np.sqrt(np.array(found, dtype=np.float32))


def power_forms(fields: Complex64Array) -> Float32Array:
    """Real parts of forms (c, f, eras, eras) of the squared magnitude of fields (c, f, eras)."""
    return np.asarray((fields.conj()[..., None] * fields[..., None, :]).real)


def _with_silence(powers: Float32Array) -> Float32Array:
    """Forms (c, 1 + f, eras, eras): at the first frequency nothing plays."""
    return np.pad(powers, [(0, 0), (1, 0), (0, 0), (0, 0)])


def _sums_of_pairs(powers: Float32Array) -> Float32Array:
    """Powers of all patterns of two ERAs, for every two (c, pairs, 1 + f, 1 + f).

    By the frequency of each ERA; powers `_with_silence`.
    """
    one, other = np.triu_indices(powers.shape[-1], 1)
    alone = np.diagonal(powers, axis1=2, axis2=3).swapaxes(1, 2)
    sums = alone[:, one, :, None] + alone[:, other, None]
    same = np.arange(powers.shape[1])
    sums[:, :, same, same] += 2 * powers[:, :, one, other].swapaxes(1, 2)
    return np.asarray(sums)


def _drive(tones: list[list[int]], eras: int) -> Drive:
    """ERAs at full stroke; of each the frequency, counted from 1, and its number."""
    found: dict[int, Complex64Array] = {}
    for row, era in sorted(tones):
        if row:
            found.setdefault(row - 1, np.zeros(eras, dtype=np.complex64))[era] = 1
    return [*found.items()]
