"""All ERAs at one frequency: robust weights that reach the targets with little at the quiet ones.

At each frequency the expected power at the quiet fingertips, a weighted mean over them, is the
quadratic form w^H R w of the weights w, and the weights that reach the targets with the least of it
solve R w = c, where c sums conj(h_t) of the targets, each times its phase factor. Where the maximum
over the quiet fingertips counts, their weights mu_q are multiplied by the root of their expected
power and the system is solved again (Lawson's algorithm for minimax approximation; few steps, since
the minimax of expected powers is not the best percentile). A mean is at most the maximum, so that
|c^H w| / sqrt(w^H R w) bounds the score at a frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TypeAlias

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.choice import best_along
from model.drive_modes.forms import Forms

LAWSON_STEPS = 3
"""Iterations; twelve lose 0.1 to 0.3 dB of the tenth percentile."""

PRUNE_MARGIN = 0.84
"""Patterns of `switched` below this times the best score are left out: 1.5 dB, since the percentile
decides among the best."""

LIMITED_STEPS = 30
"""Iterations towards weights that reach the level within full stroke; ten lose up to 1.4 dB where
drives are known to 5 %."""

MAX_GROWTH, MAX_MULTIPLIER = 100.0, 1e12
"""Factor on a multiplier in one iteration, and in all."""

LEVEL_RESERVE = 1.02
"""Level aimed at, since the iterations come near to full stroke from above."""

# Sigma and gain, tried in turn where the iterations fail: the quiet points count less against each
# ERA's own power, and weights are raised up to full stroke.
LEVEL_RELAXATION = ((1.0, 3.0), (1000.0, 1e6))

_TINY, _LEAST = 1e-7, np.float32(1e-30)


@dataclass(frozen=True)
class Coherent:
    """Search for weights of all ERAs.

    phases: number of starting phases of the first target, and of every further one; iterations:
    number from each start that align the phases with those reached.
    """

    phases: tuple[int, int]
    iterations: int

    def search(self, forms: Forms) -> "CoherentResult":
        """Find the best weights at each frequency, brought within full stroke where they must."""
        found = self._tried(forms)
        if found.is_level_limited:
            self._limit_weights(forms, found)
            self._relax_level(forms, found)
        return found.search()

    def search_all(self, forms: Forms) -> "CoherentResult":
        """Find the best weights at every frequency, none raised to the level."""
        return self._tried(forms).search()

    def _tried(self, forms: Forms) -> "_BestCandidates":
        """The best of the first weights, and of Lawson's where there are several constraints."""
        found = _BestCandidates(forms)
        weights, bound = self._weights(forms, _mean(forms))
        expected = forms.quiet_power(weights)
        tried: list[_Tried] = [(weights, expected, bound)]
        if expected.shape[1] > 1:
            tried += self._iterate(forms, expected)
        found.add(np.arange(forms.frequency_count), forms, tried)
        return found

    def _iterate(self, forms: Forms, expected: Float32Array) -> "list[_Tried]":
        """Lawson's iterations from expected powers (f, q) at the quiet fingertips."""
        tried: list[_Tried] = []
        shares = np.ones_like(expected)
        for _ in range(LAWSON_STEPS):
            shares = _moved(shares, expected)
            weights, bound = self._weights(forms, _weighted(forms, shares))
            expected = forms.quiet_power(weights)
            tried.append((weights, expected, bound))
        return tried

    def max_sensation(self, forms: Forms) -> float:
        """Return the highest amplitude to threshold found at the weakest target."""
        sigma, gain = LEVEL_RELAXATION[-1]
        weights, _ = self._weights(forms, _mean(forms, sigma=sigma))
        peak = forms.amplitude(_saturated(weights, gain))
        return float((peak / forms.threshold).max())

    def _limit_weights(self, forms: Forms, found: "_BestCandidates") -> None:
        """Find the best weights within full stroke where the best of all do not reach the level.

        The optimum has R + diag(d) in place of R, with multipliers d that are zero but for ERAs at
        full stroke; they are multiplied by the squared magnitudes of the weights until they fit.
        """
        open_ = found.level_limited()
        if len(open_) == 0:
            return
        some = forms.at(open_)
        R = _mean(some)
        shares = np.ones_like(some.quiet[:, :, 0, 0].real)
        multipliers = np.zeros((len(open_), 1), dtype=np.float32)
        tried: list[_Tried] = []
        for step in range(LIMITED_STEPS):
            held = R.copy()
            held.reshape(len(R), -1)[:, :: some.era_count + 1] += multipliers
            weights, _ = self._weights(some, held)
            weights = weights * (LEVEL_RESERVE * some.gain_to_level(weights))[:, None]
            fitting = _saturated(weights, 1.0)
            expected = some.quiet_power(fitting)
            tried.append((fitting, expected, None))
            power = np.abs(weights) ** 2
            if step == 0:
                own = np.maximum.reduce(some.quiet_power(weights), axis=1)
                multipliers = (own / np.maximum(np.add.reduce(power, axis=1), _LEAST))[:, None]
                limit = np.float32(MAX_MULTIPLIER) * multipliers
            # Beyond any level that can be reached they would grow without end.
            multipliers = np.minimum(multipliers * np.minimum(power, MAX_GROWTH), limit)
            if shares.shape[1] > 1:
                shares = _moved(shares, expected)
                R = _weighted(some, shares)
        found.add(open_, some, tried)

    def _relax_level(self, forms: Forms, found: "_BestCandidates") -> None:
        """Raise the level where the best weights do not reach it, for less contrast."""
        for sigma, gain in LEVEL_RELAXATION:
            open_ = found.level_limited()
            if len(open_) == 0:
                return
            some = forms if len(open_) == forms.frequency_count else forms.at(open_)
            weights, _ = self._weights(some, _mean(some, sigma=sigma))
            weights = _saturated(weights, gain)
            found.add(open_, some, [(weights, some.quiet_power(weights), None)])

    def _weights(self, forms: Forms, R: Complex64Array) -> tuple[Complex64Array, Float32Array]:
        """Weights (n, eras), and their bound |c^H w| / sqrt(w^H R w), (n,)."""
        targets = forms.targets
        starts = _starts(len(targets), self.phases)
        iterations = self.iterations if len(starts) > 1 else 1
        return _optimise_target_phases(R, targets, starts=starts, iterations=iterations)


@dataclass(frozen=True, eq=False)
class CoherentResult:
    """The best weights (f, eras) at each frequency, and their robust score (f,).

    The score is 0 where none were found that reach the level. bound (f,): upper bound of the score.
    is_level_limited: weights of a better score were found at a frequency where none reach the
    level.
    """

    score: Float32Array
    weights: Complex64Array
    bound: Float32Array
    is_level_limited: bool


_Tried: TypeAlias = tuple[Complex64Array, Float32Array, Float32Array | None]
"""Weights (n, eras), their expected power at the quiet fingertips (n, q), bound of scores (n,)."""


class _BestCandidates:
    """The best candidate weights so far; score: the best of those that reach the level."""

    def __init__(self, forms: Forms) -> None:
        count = forms.frequency_count
        self._scores = np.zeros(count, dtype=np.float32)
        self._infeasible_scores = np.zeros(count, dtype=np.float32)
        self._weights = np.zeros((count, forms.era_count), dtype=np.complex64)
        self.bound = np.full(count, np.inf, dtype=np.float32)
        self.score = 0.0

    def add(self, frequencies: IntArray, forms: Forms, tried: Sequence[_Tried]) -> None:
        """Add what was tried at frequencies, by index (n,); forms: at these only."""
        weights = np.array([each for each, _, _ in tried])
        expected = np.array([each for _, each, _ in tried])
        power = np.maximum.reduce(expected, axis=-1)
        peak, reaches = forms.reached(weights)
        score = peak / np.sqrt(np.maximum(power, _LEAST) + _TINY * (peak * peak))
        if not reaches.all():
            missed = np.maximum.reduce(np.where(reaches, 0, score), axis=0)
            self._infeasible_scores[frequencies] = np.maximum(
                self._infeasible_scores[frequencies], missed
            )
            score = np.where(reaches, score, 0)
        at = (best_along(score, axis=0), np.arange(len(frequencies)))
        highest = score[at]
        better = highest > self._scores[frequencies]
        self._scores[frequencies[better]] = highest[better]
        self._weights[frequencies[better]] = weights[at][better]
        for _, _, bound in tried:
            if bound is not None:
                self.bound[frequencies] = np.minimum(self.bound[frequencies], bound)
        self.score = max(self.score, float(highest.max()))

    @property
    def is_level_limited(self) -> bool:
        """Whether there are `level_limited` frequencies."""
        return len(self.level_limited()) > 0

    def level_limited(self) -> IntArray:
        """Frequencies without weights that reach the level, but of a better score than the best."""
        is_missed = (self._scores == 0) & (self._infeasible_scores > self.score)
        return np.asarray(is_missed.nonzero()[0])

    def search(self) -> "CoherentResult":
        """Return the best weights at each frequency."""
        return CoherentResult(self._scores, self._weights, self.bound, self.is_level_limited)


def _saturated(weights: Complex64Array, gain: float) -> Complex64Array:
    """Weights times a gain, limited to full stroke."""
    return np.asarray(weights / np.maximum(np.abs(weights), 1 / gain), dtype=np.complex64)


def _moved(shares: Float32Array, expected: Float32Array) -> Float32Array:
    """Shares of the quiet fingertips (f, q) after a step of Lawson's, by their expected powers.

    As they were at frequencies where no ERA is driven.
    """
    moved = shares * np.sqrt(np.maximum(expected, 0))
    total = np.add.reduce(moved, axis=-1, keepdims=True)
    return np.where(total > _LEAST, moved / np.maximum(total, _LEAST), shares)


def _mean(forms: Forms, *, sigma: float = 0.0) -> Complex64Array:
    """R (f, eras, eras) for equal weights of the quiet fingertips.

    sigma: relative error of each ERA's contribution beyond that of the forms.
    """
    quiet = forms.quiet
    R = np.add.reduce(quiet, axis=1) / np.float32(quiet.shape[1])
    if sigma:
        R.reshape(len(R), -1)[:, :: R.shape[1] + 1] *= 1 + np.float32(sigma**2)
    return np.asarray(R)


def _weighted(forms: Forms, shares: Float32Array) -> Complex64Array:
    """R (n, eras, eras) for weights (n, q) of the quiet fingertips."""
    n, q, eras, _ = forms.quiet.shape
    parts = forms.quiet.reshape(n, q, -1).view(np.float32)
    return (shares[:, None] @ parts)[:, 0].view(np.complex64).reshape(n, eras, eras)


@lru_cache(maxsize=16)
def _starts(targets: int, phases: tuple[int, int]) -> Complex64Array:
    """Phase factors of the targets to start from, (s, targets)."""
    circles = [
        np.exp(2j * np.pi * np.arange(count) / count)
        for count in (phases[0], *[phases[1]] * (targets - 1))
    ]
    return np.array(list(product(*circles)), dtype=np.complex64)


def _optimise_target_phases(
    R: Complex64Array,
    targets: Complex64Array,
    *,
    starts: Complex64Array,
    iterations: int,
) -> tuple[Complex64Array, Float32Array]:
    """Weights (n, eras), largest magnitude 1, for targets (t, n, eras), and their bound (n,).

    The best of all starts. Each iteration sets the targets' phase factors to the phases reached,
    which cannot lower the bound, and gives more weight to a weaker target.
    """
    _, n, eras = targets.shape
    conjugate = targets.conj()
    s = len(starts)
    target_factors = np.repeat(starts[:, :, None], n, axis=2)
    forms = np.broadcast_to(R, (s, *R.shape)).reshape(-1, eras, eras)
    tried, magnitudes = [], []
    for _ in range(iterations):
        c = np.add.reduce(target_factors[..., None] * conjugate, axis=1)
        w = np.linalg.solve(forms, c.reshape(-1, eras, 1)).reshape(s, n, eras)
        reached = np.vecdot(conjugate, w[:, None])  # (s, t, n)
        magnitude = np.maximum(np.abs(reached), 1e-20)
        tried.append(w)
        magnitudes.append(np.minimum.reduce(magnitude, axis=1))
        if len(tried) < iterations:
            lacking = np.sqrt(magnitude.mean(axis=1, keepdims=True) / magnitude)
            target_factors = np.abs(target_factors) * lacking * reached / magnitude
    every = np.concatenate(tried)
    cost = np.vecdot(every, np.matvec(R, every)).real
    values = np.concatenate(magnitudes) / np.sqrt(np.maximum(cost, 1e-30))
    best = (best_along(values, axis=0), np.arange(n))
    w, value = every[best], values[best]
    size = np.maximum.reduce(np.abs(w), axis=-1, keepdims=True)
    return np.asarray(w / np.maximum(size, 1e-30), dtype=np.complex64), value
