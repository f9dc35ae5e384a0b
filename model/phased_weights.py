"""Weights of the drive mode `phased`: all ERAs at one frequency, with any amplitudes and phases.

These are minimum-variance (MVDR, LCMV) weights. Symbols are defined in `model.drive_forms`.

At each frequency the expected power at the quiet fingertips, a weighted mean over them, is the
quadratic form w^H R w. The weights that reach the targets with the least power solve R w = c, where
c is the sum of conj(h_t) over the targets, each times a factor. Because the maximum over the quiet
fingertips counts, their weights mu_q are multiplied by the root of their expected power, and the
system is solved again. This is Lawson's algorithm for minimax approximation (C. L. Lawson, 1961).
The best of three steps is kept, since the minimax of expected powers is not the best percentile. A
mean is at most the maximum, so for one target |c^H w| / sqrt(w^H R w) bounds the score at a
frequency. For several targets it is an estimate from several tried phases and factors in c. Without
errors, a spring or damper at an ERA does not change the best contrast: it adds a force at a point
that is driven anyway. `model/compiled/search.h` is the same algorithm in C.
"""

from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray, best_along
from model.drive_forms import LEAST_AMPLITUDE, LEAST_POWER, Forms

_TINY = 1e-7

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
    return np.asarray((loudest / np.maximum(weight_power, LEAST_POWER))[:, None])


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
    power = np.maximum(quiet_power, LEAST_POWER) + _TINY * (peak * peak)
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
    return np.where(total > LEAST_POWER, moved / np.maximum(total, LEAST_POWER), shares)


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
            power = np.maximum(np.vecdot(factors, amplitudes).real, LEAST_POWER)
        size = np.maximum(np.abs(amplitudes), LEAST_AMPLITUDE)
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
    return np.asarray(values / np.maximum(size, LEAST_POWER), dtype=np.complex64)


def _saturated(weights: Complex64Array, gain: float) -> Complex64Array:
    """Weights raised by a gain up to full stroke."""
    return np.asarray(weights / np.maximum(np.abs(weights), 1 / gain), dtype=np.complex64)


def _phases(fields: Complex64Array) -> Complex64Array:
    """Phase factors of fields."""
    return np.asarray(fields / np.maximum(np.abs(fields), LEAST_AMPLITUDE))
