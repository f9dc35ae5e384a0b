"""The drive mode `phased`: all ERAs at one frequency, with any amplitudes and phases.

Robust weights reach the targets with little at the quiet fingers; a spring or damper at an ERA adds
a force where the drive acts anyway: without errors the best contrast does not depend on it.

At each frequency the expected power at the quiet fingertips, a weighted mean over them, is the
quadratic form w^H R w of the weights w, and the weights that reach the targets with the least of it
solve R w = c, where c sums conj(h_t) of the targets, each times a factor. Where the maximum
over the quiet fingertips counts, their weights mu_q are multiplied by the root of their expected
power and the system is solved again (Lawson's algorithm for minimax approximation; three steps, of
which the best is kept, since the minimax of expected powers is not the best percentile). A mean is
at most the maximum, so that for one target |c^H w| / sqrt(w^H R w) bounds the score at a frequency.
Of several it estimates it: phases and factors in c are the best of those tried.

`model/compiled/search.h` is the same in C.
"""

from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.choice import best_along
from model.drive_modes.forms import Forms

LAWSON_STEPS = 3
"""Iterations; twelve lose 0.1 to 0.3 dB of the tenth percentile."""

TARGET_STARTS, ALIGNMENTS, REALIGNMENTS = 8, 16, 5
"""Targets whose own optimum gives phases to start from; iterations from each that align phases with
those reached, and from the factors of the step before.

Of 20 targets, 4 starts of 8 iterations lose 0.3 dB more in the median.
"""

LIMITED_STEPS = 30
"""Iterations towards weights that reach the level within full stroke; ten lose up to 1.4 dB where
drives are known to 5 %."""

MAX_GROWTH, MAX_MULTIPLIER = 100.0, 1e12
"""Factor on a multiplier in one iteration, and in all."""

NEARLY_HIGHEST = 0.99
"""Of the highest level there is, what is searched where the level cannot be reached."""

LEVEL_RESERVE = 1.02
"""Level aimed at, since the iterations come near to full stroke from above."""


@dataclass(frozen=True)
class LawsonMethod:
    """Weights that are tried at each frequency.

    steps: of Lawson's algorithm; is_limited: whether each is brought to the level within full
    stroke, by multipliers; variance: of each ERA's contribution beyond that of the forms; gain: by
    which weights are raised up to full stroke, 0 for none.
    """

    steps: int
    is_limited: bool = False
    variance: float = 0.0
    gain: float = 0.0


ONE_FINGER, SEVERAL = LawsonMethod(1), LawsonMethod(1 + LAWSON_STEPS)

WITHIN_STROKE = (
    LawsonMethod(LIMITED_STEPS, is_limited=True, gain=1.0),
    LawsonMethod(1, variance=1.0, gain=3.0),
    LawsonMethod(1, variance=1e6, gain=1e6),
)
"""Tried in turn where the first weights miss the level: such within full stroke, and then such for
which the quiet points count less against each ERA's own power."""

_TINY, _LEAST, _LEAST_FIELD = 1e-7, np.float32(1e-30), np.float32(1e-20)


@dataclass(frozen=True, eq=False)
class CoherentResult:
    """The best weights (f, eras) at each frequency, and their robust score (f,).

    The score is 0 where none were found that reach the level. bound (f,): of the score for one
    target, for several an estimate that other phases may exceed; missed (f,): the best score of
    weights that miss the level.
    """

    score: Float32Array
    weights: Complex64Array
    bound: Float32Array
    missed: Float32Array

    @property
    def level_limited(self) -> IntArray:
        """Frequencies without weights that reach the level, but of a better score than the best."""
        is_missed = (self.score == 0) & (self.missed > self.score.max(initial=0))
        return np.asarray(is_missed.nonzero()[0])


def search(forms: Forms) -> CoherentResult:
    """Find the best weights at each frequency, brought within full stroke where they must."""
    found = search_all(forms)
    for method in WITHIN_STROKE:
        open_ = found.level_limited
        if len(open_) == 0:
            break
        more = tried(forms.at(open_), method)
        found.score[open_], found.weights[open_] = more.score, more.weights
        found.missed[open_] = np.maximum(found.missed[open_], more.missed)
    return found


def search_to_level(forms: Forms) -> tuple[CoherentResult, Forms]:
    """Search for weights of a level, without its margin where they must, or else near the highest.

    Also return the forms with the level that was sought.
    """
    found = search(forms)
    for is_highest in (False, True):
        if found.score.any():
            break
        level = NEARLY_HIGHEST * max_sensation(forms) if is_highest else forms.wanted
        forms = replace(forms, wanted=float(np.float32(level)), level_margin=0.0)
        found = search(forms)
    return found, forms


def search_all(forms: Forms) -> CoherentResult:
    """Find the best weights at every frequency, none raised to the level."""
    return tried(forms, SEVERAL if forms.quiet.shape[1] > 1 else ONE_FINGER)


def max_sensation(forms: Forms) -> float:
    """Return the highest amplitude to threshold found at the weakest target."""
    any_level = replace(forms, wanted=0.0, level_margin=0.0)
    peak = forms.amplitude(tried(any_level, WITHIN_STROKE[-1]).weights)
    return float((peak / forms.threshold).max())


def tried(forms: Forms, method: LawsonMethod) -> CoherentResult:
    """Find the best of the weights of a method at every frequency.

    Within full stroke the optimum has R + diag(d) in place of R, with multipliers d that are
    zero but for ERAs at full stroke; they are multiplied by the squared magnitudes of the
    weights until they fit.
    """
    f, q, n, _ = forms.quiet.shape
    shares = np.full((f, q), 1 / q, dtype=np.float32)
    multipliers = limit = np.zeros((f, 1), dtype=np.float32)
    bound = np.full(f, np.inf, dtype=np.float32)
    every_weights, powers, factors = [], [], None
    for step in range(method.steps):
        R = _weighted(forms, shares)
        diagonal = R.reshape(f, -1)[:, :: n + 1]
        diagonal *= 1 + np.float32(method.variance)
        diagonal += multipliers
        weights, highest, factors = _optimise_targets(R, forms.targets, factors, method.gain)
        bound = np.minimum(bound, highest)
        if method.is_limited:
            gain = LEVEL_RESERVE * forms.gain_to_level(weights)
            weights = (weights * gain[:, None]).astype(np.complex64)
        fitting = _saturated(weights, method.gain) if method.gain else weights
        expected = forms.quiet_power(fitting)
        every_weights.append(fitting)
        powers.append(np.maximum.reduce(expected, axis=1))
        shares = _moved(shares, expected)
        if not method.is_limited:
            continue
        power = np.abs(weights) ** 2
        if step == 0:
            own = np.maximum.reduce(forms.quiet_power(weights), axis=1)
            multipliers = (own / np.maximum(np.add.reduce(power, axis=1), _LEAST))[:, None]
            limit = np.float32(MAX_MULTIPLIER) * multipliers
        # Beyond any level that can be reached they would grow without end.
        multipliers = np.minimum(multipliers * np.minimum(power, MAX_GROWTH), limit)
    every = np.array(every_weights)
    peak, reaches = forms.reached(every)
    each = peak / np.sqrt(np.maximum(powers, _LEAST) + _TINY * (peak * peak))
    score = np.where(reaches, each, 0)
    best = (best_along(score, axis=0), np.arange(f))
    best_weights = np.where(score[best][:, None] > 0, every[best], 0).astype(np.complex64)
    missed = np.maximum.reduce(np.where(reaches, 0, each), axis=0)
    return CoherentResult(score[best], best_weights, bound, missed)


def _moved(shares: Float32Array, expected: Float32Array) -> Float32Array:
    """Shares of the quiet fingertips (f, q) after a step of Lawson's, by their expected powers.

    As they were at frequencies where no ERA is driven.
    """
    moved = shares * np.sqrt(np.maximum(expected, 0))
    total = np.add.reduce(moved, axis=-1, keepdims=True)
    return np.where(total > _LEAST, moved / np.maximum(total, _LEAST), shares)


def _weighted(forms: Forms, shares: Float32Array) -> Complex64Array:
    """R (n, eras, eras) for weights (n, q) of the quiet fingertips."""
    n, q, eras, _ = forms.quiet.shape
    parts = forms.quiet.reshape(n, q, -1).view(np.float32)
    return (shares[:, None] @ parts)[:, 0].view(np.complex64).reshape(n, eras, eras)


def _optimise_targets(
    R: Complex64Array, targets: Complex64Array, before: Complex64Array | None, gain: float
) -> tuple[Complex64Array, Float32Array, Complex64Array]:
    """Weights (n, eras), largest magnitude 1, for targets (t, n, eras), and their bound (n,).

    Also their factors (n, t). Weights are R^-1 times a sum of the targets' conjugates, each times a
    factor, so that what targets get follows from factors by the targets' Gram matrix, t by t. Each
    iteration sets the factors' phases to those reached, and raises that of a weaker target. before:
    factors to start from, None for the phases that the optimum for one target gives all others.
    With a gain above 1 the level itself counts, of weights raised by it up to full stroke.
    """
    t, n, _ = targets.shape
    fields = targets.swapaxes(0, 1)
    columns = np.linalg.solve(R, fields.conj().swapaxes(1, 2))  # (n, eras, t)
    gram = fields @ columns
    if before is None:
        count = min(t, TARGET_STARTS)
        factors = _phases(gram[:, :, np.arange(count) * t // count].transpose(2, 0, 1))
        steps = ALIGNMENTS
    else:
        factors, steps = before[None], REALIGNMENTS
    tried, values = [], []
    for _ in range(steps if t > 1 else 1):
        if gain > 1:
            reached = np.matvec(fields, _saturated(_largest_one(np.matvec(columns, factors)), gain))
            cost = np.float32(1)
        else:
            reached = np.matvec(gram, factors)
            cost = np.maximum(np.vecdot(factors, reached).real, _LEAST)
        size = np.maximum(np.abs(reached), _LEAST_FIELD)
        tried.append(factors)
        values.append(np.minimum.reduce(size, axis=-1) / np.sqrt(cost))
        factors = _largest_one(np.abs(factors) / size * _phases(reached))
    every = np.concatenate(values)
    best = (best_along(every, axis=0), np.arange(n))
    factors = np.concatenate(tried)[best]
    return _largest_one(np.matvec(columns, factors)), every[best], factors


def _largest_one(values: Complex64Array) -> Complex64Array:
    """Values scaled so that the largest magnitude along the last axis is 1."""
    size = np.maximum.reduce(np.abs(values), axis=-1, keepdims=True)
    return np.asarray(values / np.maximum(size, _LEAST), dtype=np.complex64)


def _saturated(weights: Complex64Array, gain: float) -> Complex64Array:
    """Weights raised by a gain up to full stroke."""
    return np.asarray(weights / np.maximum(np.abs(weights), 1 / gain), dtype=np.complex64)


def _phases(fields: Complex64Array) -> Complex64Array:
    """Phase factors of fields."""
    return np.asarray(fields / np.maximum(np.abs(fields), _LEAST_FIELD))
