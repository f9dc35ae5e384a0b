"""Optimize ERA drives in each drive mode.

- `switched`: one or two ERAs at full stroke, each at its own frequency.
- `phased`: all ERAs at one frequency, with arbitrary amplitudes and phases (minimum-variance,
  MVDR/LCMV, weights).

Symbols, here and in `model.table`: f frequencies, p points under fingers, q quiet fingertips, r
reduced modal coordinates; h field of an ERA at a point, R Hermitian form of the expected power at
the quiet fingertips, c right-hand side from the targets, w complex weights of the ERAs. In
`model.transients`, q are the modal coordinates and z those of the eigenvectors in time.

A drive is a complex weight of each ERA at each frequency. Its score is the amplitude at the target
over the root of the expected power at the loudest quiet fingertip, over all plates within the rig's
uncertainty (`model.ensemble.touched_plate`). The optimum for the nominal plate relies on
cancellation and is 10 dB worse on a real one. Tones of different frequencies are felt together as
the root of the sum of their squares over the detection thresholds, so the powers of a score are in
units of their frequencies' thresholds.

`phased`. At each frequency the expected power at the quiet fingertips, a weighted mean over them,
is the quadratic form w^H R w. The weights that reach the targets with the least power solve R w =
c, where c is the sum of conj(h_t) over the targets, each times a factor. Since the maximum over the
quiet fingertips counts, their weights mu_q are multiplied by the root of their expected power and
the system is solved again: Lawson's algorithm for minimax approximation. The best of three steps is
kept, since the minimax of expected powers is not the best percentile. A mean is at most the
maximum, so for one target |c^H w| / sqrt(w^H R w) bounds the score at a frequency. For several
targets it is an estimate from several tried phases and factors in c. Without errors a spring or
damper at an ERA does not change the best contrast: it adds a force where the drive acts anyway.
`model/compiled/search.h` is the same in C.

`switched`. Switching frequencies and activation sets moves the nulls (the paper's idea). Four ERAs
and 27 frequencies make 4 * 27 + 6 * 27² = 4482 patterns, sixteen and 47 a quarter of a million.
Powers of different frequencies, each over its squared threshold, add at the target and at every
quiet fingertip; at one frequency the fields add. So all patterns of two ERAs are the sums of a
column and a row, except for their diagonal. The maximum over the quiet fingertips is at least any
weighted mean, and the mean of a sum is the sum of the means: one number per pattern bounds its
score, and few patterns are computed exactly.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, Float32Array, IntArray, best_along, best_few
from model.errors import InputError, shown

MAX_PHASE_STEP = 10.0
"""Largest phase step [degrees] for `phased`; its rms error is 3 degrees, within the allowance."""

DRIVE_MODES = ("switched", "phased")
"""The drive modes, from the least freedom to the most."""

UNRESTRICTED = "phased"
"""The drive mode with arbitrary weights."""


def checked_mode(name: str, what: str = "drive mode") -> str:
    """Return the name of a drive mode; raises InputError for any other.

    what: its name in the message.
    """
    if name not in DRIVE_MODES:
        raise InputError(f"{what} must be one of {', '.join(DRIVE_MODES)}, got {shown(name)}")
    return name


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """Return the drive modes that an amplifier with steps of level and phase [degrees] can play.

    A level step of 1 means on or off.
    """
    return DRIVE_MODES if level_step < 1 and phase_step <= MAX_PHASE_STEP else DRIVE_MODES[:1]


WeightedTones: TypeAlias = list[tuple[int, Complex64Array]]
"""Tones: the index of a frequency, and the weights (eras,) at it in full strokes."""

LEVEL_MARGIN = 1.0
"""Reserve that a drive must have at its targets, in standard deviations of their amplitude.

About the need of 90 % of plates; the draws of an answer decide.
"""

_TINY, _LEAST_POWER, _LEAST_AMPLITUDE = 1e-7, np.float32(1e-30), np.float32(1e-20)


@dataclass(frozen=True, eq=False)
class Forms:
    """Amplitudes at the targets, and expected power at targets and quiet fingertips."""

    targets: Complex64Array
    """Field (t, f, eras) of each ERA alone at full stroke [m/s²], mean over a target."""
    target_power: Complex64Array
    """Form (t, f, eras, eras) of the expected power there: w^H R w of weights w."""
    quiet: Complex64Array
    """The same (f, q, eras, eras) at each quiet fingertip.

    Without quiet fingertips there is one form, for the rest of the plate.
    """
    threshold: Float32Array
    """Detection threshold (f,) [m/s²]."""
    wanted: float
    """Wanted amplitude to threshold at every target."""
    level_margin: float = LEVEL_MARGIN
    few: Complex64Array | None = None
    """Field (f, q, p, eras) at few points of quiet fingertips, times the root of their weights.

    `quiet` counts the nominal plate by their mean. None, as `fine`, if the mean is good enough.
    """
    fine: Complex64Array | None = None
    """Field (f, q, p, eras) at many points of quiet fingertips; the loudest point counts."""
    driven: NDArray[np.bool_] | None = None
    """Mask (eras,) of the ERAs that may have weights, None for all; see `among`."""

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.quiet.shape[-1])

    def at(self, frequencies: IntArray) -> "Forms":
        """Select some of the frequencies, by index (n,)."""
        return replace(
            self,
            targets=self.targets.take(frequencies, axis=1),
            target_power=self.target_power.take(frequencies, axis=1),
            quiet=self.quiet.take(frequencies, axis=0),
            threshold=self.threshold.take(frequencies),
            few=None if self.few is None else self.few.take(frequencies, axis=0),
            fine=None if self.fine is None else self.fine.take(frequencies, axis=0),
        )

    def among(self, is_driven: NDArray[np.bool_]) -> "Forms":
        """Return the forms for weights of some ERAs (eras,); the others have no effect.

        The others keep their own power, so that the forms can be inverted.
        """
        if is_driven.all():
            return self
        pairs = np.outer(is_driven, is_driven) | np.eye(len(is_driven), dtype=bool)
        return replace(
            self,
            targets=self.targets * is_driven,
            target_power=self.target_power * pairs,
            quiet=self.quiet * pairs,
            few=None if self.few is None else self.few * is_driven,
            fine=None if self.fine is None else self.fine * is_driven,
            driven=is_driven,
        )

    def amplitude(self, weights: Complex64Array) -> Float32Array:
        """Amplitude [m/s²] at the weakest target of weights (..., f, eras), (..., f)."""
        return np.asarray(np.minimum.reduce(self._amplitudes(weights), axis=-2))

    def reached(self, weights: Complex64Array) -> tuple[Float32Array, NDArray[np.bool_]]:
        """Return `amplitude`, and whether all targets have the wanted level, both (..., f)."""
        amplitudes = self._amplitudes(weights)
        least = self._least_amplitudes(weights, amplitudes)
        reaches = np.logical_and.reduce(least >= self.wanted * self.threshold, axis=-2)
        return np.asarray(np.minimum.reduce(amplitudes, axis=-2)), np.asarray(reaches)

    def gain_to_level(self, weights: Complex64Array) -> Float32Array:
        """Factor on weights (f, eras) that just reaches the wanted level at all targets, (f,)."""
        amplitudes = self._amplitudes(weights)
        least = np.minimum.reduce(self._least_amplitudes(weights, amplitudes), axis=0)
        amplitude = np.minimum.reduce(amplitudes, axis=0)
        return np.asarray(
            self.wanted * self.threshold / np.maximum(least, 0.1 * amplitude + _LEAST_AMPLITUDE)
        )

    def quiet_power(self, weights: Complex64Array) -> Float32Array:
        """Expected power [m²/s⁴] at each quiet fingertip of weights (f, eras), (f, q)."""
        power = _expected_power(self.quiet.swapaxes(0, 1), weights).T
        if self.few is None or self.fine is None:
            return power
        mean = np.add.reduce(_powers(self.few, weights), axis=2)
        loudest = np.maximum.reduce(_powers(self.fine, weights), axis=2)
        return np.asarray(power + np.maximum(loudest - mean, 0))

    def _amplitudes(self, weights: Complex64Array) -> Float32Array:
        """Amplitudes at the targets of weights (..., f, eras), (..., t, f)."""
        fields = np.add.reduce(self.targets * weights[..., None, :, :], axis=-1)
        return np.asarray(np.abs(fields))

    def _least_amplitudes(self, weights: Complex64Array, amplitudes: Float32Array) -> Float32Array:
        """Amplitudes (..., t, f) minus the margin."""
        if not self.level_margin:
            return amplitudes
        variance = _expected_power(self.target_power, weights) - amplitudes * amplitudes
        deviation = np.sqrt(np.maximum(variance, 0))
        return np.asarray(amplitudes - np.float32(self.level_margin) * deviation)


def _powers(fields: Complex64Array, weights: Complex64Array) -> Float32Array:
    """Squared magnitudes (f, q, p) of fields (f, q, p, eras) for weights (f, eras)."""
    amplitudes = np.matvec(fields, weights[:, None])
    return np.asarray(amplitudes.real * amplitudes.real + amplitudes.imag * amplitudes.imag)


def _expected_power(forms: Complex64Array, weights: Complex64Array) -> Float32Array:
    """w^H R w of forms (q, f, eras, eras) and weights (..., f, eras): (..., q, f)."""
    by_form = weights[..., None, :, :]
    products = np.matvec(forms, by_form)
    return np.asarray(np.vecdot(by_form, products).real)


LAWSON_STEPS = 3
"""Iterations of Lawson's algorithm; twelve lose 0.1 to 0.3 dB of the tenth percentile."""

TARGET_STARTS, ALIGNMENTS, REALIGNMENTS = 8, 16, 5
"""Number of targets whose own optimum gives initial phases; iterations from each, and from the
factors of the previous step, that align phases with those reached.

For 20 targets, 4 starts of 8 iterations lose 0.3 dB more in the median.
"""

LIMITED_STEPS = 30
"""Iterations toward weights that reach the level within full stroke; ten lose up to 1.4 dB where
drives are known to 5 %."""

MAX_GROWTH, MAX_MULTIPLIER = 100.0, 1e12
"""Largest factor on a multiplier in one iteration, and in all."""

NEARLY_HIGHEST = 0.99
"""Share of the highest level that is searched for if the wanted one cannot be reached."""

LEVEL_RESERVE = 1.02
"""Factor on the level that is aimed at, since iterations approach full stroke from above."""


@dataclass(frozen=True)
class LawsonMethod:
    """How weights are computed at each frequency."""

    steps: int
    """Steps of Lawson's algorithm."""
    is_limited: bool = False
    """Whether weights are brought to the level within full stroke, by multipliers."""
    variance: float = 0.0
    """Variance of each ERA's contribution, in addition to the forms' variance."""
    gain: float = 0.0
    """Gain on the weights, limited to full stroke; 0 for none."""


ONE_FINGER, SEVERAL = LawsonMethod(1), LawsonMethod(1 + LAWSON_STEPS)

WITHIN_STROKE = (
    LawsonMethod(LIMITED_STEPS, is_limited=True, gain=1.0),
    LawsonMethod(1, variance=1.0, gain=3.0),
    LawsonMethod(1, variance=1e6, gain=1e6),
)
"""Methods that are tried in turn if the first weights miss the level.

The first one stays within full stroke; for the others the quiet points count less against each
ERA's own power.
"""


@dataclass(frozen=True, eq=False)
class CoherentResult:
    """The best weights at each frequency."""

    score: Float32Array
    """Score (f,), 0 if no weights reach the level."""
    weights: Complex64Array
    """Weights (f, eras)."""
    bound: Float32Array
    """Bound (f,) of the score; for several targets an estimate that other phases may exceed."""
    missed: Float32Array
    """The best score (f,) of weights that miss the level."""

    @property
    def level_limited(self) -> IntArray:
        """Indices of frequencies that miss the level, with a better score than the best one."""
        is_missed = (self.score == 0) & (self.missed > self.score.max(initial=0))
        return np.asarray(is_missed.nonzero()[0])


def search(forms: Forms) -> CoherentResult:
    """Find the best weights at each frequency, brought within full stroke where necessary."""
    result = search_all(forms)
    for method in WITHIN_STROKE:
        limited = result.level_limited
        if len(limited) == 0:
            break
        raised = search_by(forms.at(limited), method)
        result.score[limited] = raised.score
        result.weights[limited] = raised.weights
        result.missed[limited] = np.maximum(result.missed[limited], raised.missed)
    return result


def search_to_level(forms: Forms) -> tuple[CoherentResult, Forms]:
    """Search for weights of a level; if none are found without its margin, else near the highest.

    Also return the forms with the level that was searched for.
    """
    result = search(forms)
    if not result.score.any():
        forms = _without_margin(forms, forms.wanted)
        result = search(forms)
    if not result.score.any():
        forms = _without_margin(forms, NEARLY_HIGHEST * max_sensation(forms))
        result = search(forms)
    return result, forms


def _without_margin(forms: Forms, wanted: float) -> Forms:
    """Return forms with another wanted level, in single precision, and without its margin."""
    return replace(forms, wanted=float(np.float32(wanted)), level_margin=0.0)


def search_all(forms: Forms) -> CoherentResult:
    """Find the best weights at every frequency, none raised to the level."""
    return search_by(forms, SEVERAL if forms.quiet.shape[1] > 1 else ONE_FINGER)


def max_sensation(forms: Forms) -> float:
    """Return the highest amplitude to threshold that weights give the weakest target."""
    any_level = replace(forms, wanted=0.0, level_margin=0.0)
    loudest = search_by(any_level, WITHIN_STROKE[-1])
    peak = forms.amplitude(loudest.weights)
    return float((peak / forms.threshold).max())


def search_by(forms: Forms, method: LawsonMethod) -> CoherentResult:
    """Find the best of the weights of a method at every frequency.

    Within full stroke the optimum has R + diag(d) in place of R, with multipliers d that are zero
    but for ERAs at full stroke (`_raised`).
    """
    f, q, n, _ = forms.quiet.shape
    shares = np.full((f, q), 1 / q, dtype=np.float32)
    multipliers = limit = np.zeros((f, 1), dtype=np.float32)
    bound = np.full(f, np.inf, dtype=np.float32)
    weights_by_step = list[Complex64Array]()
    power_by_step = list[Float32Array]()
    factors = None
    for step in range(method.steps):
        R = _weighted(forms, shares)
        diagonal = R.reshape(f, -1)[:, :: n + 1]
        diagonal *= 1 + np.float32(method.variance)
        diagonal += multipliers
        weights, bound_of_step, factors = _optimize_targets(R, forms.targets, factors, method.gain)
        bound = np.minimum(bound, bound_of_step)
        if method.is_limited:
            gain = LEVEL_RESERVE * forms.gain_to_level(weights)
            weights = (weights * gain[:, None]).astype(np.complex64)
        fitting = _saturated(weights, method.gain) if method.gain else weights
        quiet_power = forms.quiet_power(fitting)
        weights_by_step.append(fitting)
        power_by_step.append(np.maximum.reduce(quiet_power, axis=1))
        shares = _moved(shares, quiet_power)
        if method.is_limited:
            if step == 0:
                multipliers = _first_multipliers(forms, weights)
                limit = np.float32(MAX_MULTIPLIER) * multipliers
            multipliers = _raised(multipliers, weights, limit)
    return _best_step(forms, np.array(weights_by_step), np.array(power_by_step), bound)


def _first_multipliers(forms: Forms, weights: Complex64Array) -> Float32Array:
    """Return first multipliers (f, 1): the power at the loudest quiet fingertip to the weights'."""
    loudest = np.maximum.reduce(forms.quiet_power(weights), axis=1)
    weight_power = np.add.reduce(np.abs(weights) ** 2, axis=1)
    return np.asarray((loudest / np.maximum(weight_power, _LEAST_POWER))[:, None])


def _raised(
    multipliers: Float32Array, weights: Complex64Array, limit: Float32Array
) -> Float32Array:
    """Return multipliers (f, n) times the squared magnitudes of weights, until these fit.

    Limited, since they would grow without end where the level cannot be reached.
    """
    growth = np.minimum(np.abs(weights) ** 2, MAX_GROWTH)
    return np.asarray(np.minimum(multipliers * growth, limit))


def _best_step(
    forms: Forms, weights: Complex64Array, quiet_power: Float32Array, bound: Float32Array
) -> CoherentResult:
    """Return the best weights of all steps (s, f, n), with power (s, f) at the loudest quiet
    fingertip."""
    peak, reaches = forms.reached(weights)
    power = np.maximum(quiet_power, _LEAST_POWER) + _TINY * (peak * peak)
    ratio = peak / np.sqrt(power)
    score = np.where(reaches, ratio, 0)
    best = (best_along(score, axis=0), np.arange(len(bound)))
    best_weights = np.where(score[best][:, None] > 0, weights[best], 0)
    return CoherentResult(
        score=score[best],
        weights=best_weights.astype(np.complex64),
        bound=bound,
        missed=np.maximum.reduce(np.where(reaches, 0, ratio), axis=0),
    )


def _moved(shares: Float32Array, expected: Float32Array) -> Float32Array:
    """Return the shares (f, q) of quiet fingertips after a Lawson step, from their expected powers.

    Unchanged at frequencies without a driven ERA.
    """
    moved = shares * np.sqrt(np.maximum(expected, 0))
    total = np.add.reduce(moved, axis=-1, keepdims=True)
    return np.where(total > _LEAST_POWER, moved / np.maximum(total, _LEAST_POWER), shares)


def _weighted(forms: Forms, shares: Float32Array) -> Complex64Array:
    """Return R (n, eras, eras) for weights (n, q) of the quiet fingertips."""
    n, q, eras, _ = forms.quiet.shape
    parts = forms.quiet.reshape(n, q, -1).view(np.float32)
    return (shares[:, None] @ parts)[:, 0].view(np.complex64).reshape(n, eras, eras)


def _optimize_targets(
    R: Complex64Array, targets: Complex64Array, start: Complex64Array | None, gain: float
) -> tuple[Complex64Array, Float32Array, Complex64Array]:
    """Find weights (n, eras), largest magnitude 1, for targets (t, n, eras), and their bound (n,).

    Also returns their factors (n, t). Weights are R^-1 times the sum of the targets' conjugates,
    each times a factor, so the targets' amplitudes follow from the factors by a t by t Gram matrix.
    Each iteration sets the factors' phases to those reached and raises the factors of weaker
    targets. start: initial factors, None for the phases that the optimum for one target gives to
    all others. With a gain above 1 the level itself counts, of weights raised up to full stroke.
    """
    t, n, _ = targets.shape
    fields = targets.swapaxes(0, 1)
    columns = np.linalg.solve(R, fields.conj().swapaxes(1, 2))  # (n, eras, t)
    gram = fields @ columns
    if start is None:
        count = min(t, TARGET_STARTS)
        first_targets = np.arange(count) * t // count
        factors = _phases(gram[:, :, first_targets].transpose(2, 0, 1))
        iterations = ALIGNMENTS
    else:
        factors = start[None]
        iterations = REALIGNMENTS
    factors_by_step = list[Complex64Array]()
    bounds_by_step = list[Float32Array]()
    for _ in range(iterations if t > 1 else 1):
        if gain > 1:
            weights = _largest_one(np.matvec(columns, factors))
            amplitudes = np.matvec(fields, _saturated(weights, gain))
            power = np.float32(1)
        else:
            amplitudes = np.matvec(gram, factors)
            power = np.maximum(np.vecdot(factors, amplitudes).real, _LEAST_POWER)
        size = np.maximum(np.abs(amplitudes), _LEAST_AMPLITUDE)
        factors_by_step.append(factors)
        bounds_by_step.append(np.minimum.reduce(size, axis=-1) / np.sqrt(power))
        factors = _largest_one(np.abs(factors) / size * _phases(amplitudes))
    bounds = np.concatenate(bounds_by_step)
    best = (best_along(bounds, axis=0), np.arange(n))
    best_factors = np.concatenate(factors_by_step)[best]
    weights = _largest_one(np.matvec(columns, best_factors))
    return weights, bounds[best], best_factors


def _largest_one(values: Complex64Array) -> Complex64Array:
    """Values scaled so that the largest magnitude along the last axis is 1."""
    size = np.maximum.reduce(np.abs(values), axis=-1, keepdims=True)
    return np.asarray(values / np.maximum(size, _LEAST_POWER), dtype=np.complex64)


def _saturated(weights: Complex64Array, gain: float) -> Complex64Array:
    """Weights raised by a gain up to full stroke."""
    return np.asarray(weights / np.maximum(np.abs(weights), 1 / gain), dtype=np.complex64)


def _phases(fields: Complex64Array) -> Complex64Array:
    """Phase factors of fields."""
    return np.asarray(fields / np.maximum(np.abs(fields), _LEAST_AMPLITUDE))


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
    alone_at_targets = np.maximum(alone[:t].mean(axis=0), _LEAST_POWER)
    loudest = (alone[2 * t :] / alone_at_targets).argmax(axis=0)
    shares = np.bincount(loudest.ravel(), minlength=len(quiet_powers)) / loudest.size
    mean_quiet = np.tensordot(shares.astype(np.float32), quiet_powers, axes=1)
    mean_target = target_powers.mean(axis=0)
    target, quiet = _sums_of_pairs(np.stack([mean_target, mean_quiet]))
    bounds = np.asarray(target / np.maximum(quiet, _LEAST_POWER))
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
    loudest = np.maximum(sums[2 * t :].max(axis=0), _LEAST_POWER)
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
