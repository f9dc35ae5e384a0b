"""Patterns of the drive mode `switched`: one or two ERAs at full stroke, each at its own frequency.

Switching frequencies and activation sets moves the nulls (an idea of the founding paper). Four ERAs
and 27 frequencies form 4 * 27 + 6 * 27² = 4482 patterns; sixteen ERAs and 47 frequencies form a
quarter of a million. Powers of different frequencies, each over its squared threshold, add at the
target and at every quiet fingertip; at one frequency the fields add. So all patterns of two ERAs
are the sums of a column and a row, except for their diagonal. The maximum over the quiet fingertips
is at least any weighted mean, and the mean of a sum is the sum of the means. One number per pattern
therefore bounds its score, and few patterns are computed exactly. Symbols are defined in
`model.drive_forms`.
"""

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray, best_few
from model.drive_forms import LEAST_POWER, Forms, WeightedTones

ALTERNATIVES = 4
"""Number of patterns that are kept, the best first, to be judged on drawn plates."""

BATCH = 512
"""Number of patterns computed exactly at first, those with the highest bounds."""


def find_switched(forms: Forms) -> list[tuple[float, WeightedTones]]:
    """Find the switched patterns of the best scores that reach the level, best first.

    Empty if none does. Exact: patterns are excluded by bounds only.
    """
    powers = _pattern_powers(forms)
    bounds = _pattern_bounds(forms, powers)
    first_era, second_era = _era_pairs(forms.era_count)
    bound = bounds.ravel()
    count = BATCH
    while True:
        order = np.argpartition(-bound, min(count, len(bound) - 1))
        chosen = np.sort(order[:count])  # a partition's order differs between processors
        pair, first_row, second_row = np.unravel_index(chosen, bounds.shape)
        first = np.array([first_row, first_era[pair]])
        second = np.array([second_row, second_era[pair]])
        score = np.where(bound[chosen] < 0, 0, _scores(forms, powers, first, second))
        best = best_few(score, ALTERNATIVES)
        if count >= len(bound) or score[best[-1]] >= bound[order[count]]:
            break
        count *= 4
    patterns = list[tuple[float, WeightedTones]]()
    for number in best.tolist():
        if score[number] > 0:
            tones = [first[:, number].tolist(), second[:, number].tolist()]
            patterns.append((float(np.sqrt(score[number])), _drive(tones, forms.era_count)))
    return patterns


def _pattern_powers(forms: Forms) -> Float32Array:
    """Return powers to threshold `_with_silence` (2 t + q, 1 + f, eras, eras).

    Nominal at the t targets, expected there, and expected at the q quiet fingertips.
    """
    threshold_power = np.square(forms.threshold)[:, None, None]
    expected = np.concatenate([forms.target_power, forms.quiet.swapaxes(0, 1)]).real
    powers = np.concatenate([power_forms(forms.targets), expected]) / threshold_power
    return _with_silence(powers.astype(np.float32))


def _pattern_bounds(forms: Forms, powers: Float32Array) -> Float32Array:
    """Return bounds (pairs, 1 + f, 1 + f) of the squared scores of all patterns, -1 for repeated
    ones."""
    t = len(forms.targets)
    target_powers = powers[:t]
    quiet_powers = powers[2 * t :]
    alone = np.diagonal(powers[:, 1:], axis1=2, axis2=3)
    alone_at_targets = np.maximum(alone[:t].mean(axis=0), LEAST_POWER)
    loudest = (alone[2 * t :] / alone_at_targets).argmax(axis=0)
    shares = np.bincount(loudest.ravel(), minlength=len(quiet_powers)) / loudest.size
    mean_quiet = np.tensordot(shares.astype(np.float32), quiet_powers, axes=1)
    mean_target = target_powers.mean(axis=0)
    target, quiet = _sums_of_pairs(np.stack([mean_target, mean_quiet]))
    bounds = np.asarray(target / np.maximum(quiet, LEAST_POWER))
    first_era, second_era = _era_pairs(forms.era_count)
    # An ERA alone counts once.
    bounds[first_era == second_era, :, 1:] = -1
    bounds[first_era + 1 < second_era, :, 0] = -1
    bounds[:-1, 0] = -1
    return bounds


def _scores(forms: Forms, powers: Float32Array, first: IntArray, second: IntArray) -> Float32Array:
    """Return power ratios (m,) of patterns of two tones (2, m), of powers `_with_silence`.

    A tone is a row and an ERA. 0 where the level is not reached.
    """
    i, a = first
    j, b = second
    t = len(forms.targets)
    interference = (i == j) * 2 * powers[:, i, a, b]
    sums = powers[:, i, a, a] + powers[:, j, b, b] + interference
    nominal = sums[:t]
    variance = np.maximum(sums[t : 2 * t] - nominal, 0)
    least = np.sqrt(nominal) - np.float32(forms.level_margin) * np.sqrt(variance)
    reaches = (least >= forms.wanted).all(axis=0)
    loudest = np.maximum(sums[2 * t :].max(axis=0), LEAST_POWER)
    return np.asarray(np.where(reaches, nominal.min(axis=0) / loudest, 0))


def max_sensation_switched(forms: Forms) -> float:
    """Return the highest amplitude to threshold of switched patterns at the weakest target."""
    return float(highest_levels((forms.targets / forms.threshold[:, None])[None])[0])


def highest_levels(fields: Complex64Array) -> Float32Array:
    """Return the highest amplitudes (m,) that a pattern gives the weakest of t targets.

    fields (m, t, f, eras).
    """
    highest = list[np.float32]()
    for target_fields in fields:
        powers = _sums_of_pairs(_with_silence(power_forms(target_fields)))
        highest.append(powers.min(axis=0).max())
    return np.sqrt(np.array(highest, dtype=np.float32))


def power_forms(fields: Complex64Array) -> Float32Array:
    """Return real parts of the forms (c, f, eras, eras) of squared fields (c, f, eras)."""
    return (fields.conj()[..., None] * fields[..., None, :]).real


def _with_silence(powers: Float32Array) -> Float32Array:
    """Prepend a frequency at which nothing plays to forms, (c, 1 + f, eras, eras)."""
    return np.pad(powers, [(0, 0), (1, 0), (0, 0), (0, 0)])


def _sums_of_pairs(powers: Float32Array) -> Float32Array:
    """Return the powers (c, pairs, 1 + f, 1 + f) of all patterns of two ERAs.

    By the frequency of each ERA; powers `_with_silence`.
    """
    first, second = _era_pairs(powers.shape[-1])
    alone = np.diagonal(powers, axis1=2, axis2=3).swapaxes(1, 2)
    sums = alone[:, first, :, None] + alone[:, second, None]
    rows = np.arange(powers.shape[1])
    sums[:, :, rows, rows] += 2 * powers[:, :, first, second].swapaxes(1, 2)
    sums[:, first == second, :, 1:] = 0
    return sums


def _era_pairs(era_count: int) -> tuple[IntArray, IntArray]:
    """Return the two ERAs (pairs,) of each pattern.

    An only ERA is paired with itself, and plays as the first of the two alone.
    """
    if era_count == 1:
        only = np.zeros(1, dtype=np.intp)
        return only, only
    first, second = np.triu_indices(era_count, 1)
    return first, second


def _drive(tones: list[list[int]], eras: int) -> WeightedTones:
    """Make a drive of ERAs at full stroke, from pairs of frequency, counted from 1, and ERA."""
    weights_by_row: dict[int, Complex64Array] = {}
    for row, era in sorted(tones):
        if row:
            weights = weights_by_row.setdefault(row - 1, np.zeros(eras, dtype=np.complex64))
            weights[era] = 1
    return [*weights_by_row.items()]
