"""All ERAs at one frequency: robust weights that reach the targets with little at the quiet points.

At each frequency the expected power at the quiet points, a weighted mean over them, is the
quadratic form w^H R w of the weights w,

    R = sum_p v_p (conj(h_p) h_p^T + sigma² diag |h_p|²),    sum_p v_p = 1,

and the weights that reach the targets with the least of it solve R w = c, where c sums conj(h_t) of
the targets, each times its phase factor. Where the maximum over the quiet points counts, the point
weights v_p are moved towards the loud points and the system is solved again (Lawson's algorithm for
minimax approximation). A mean is at most the maximum: |c^H w| / sqrt(w^H R w) bounds the score at a
frequency, and most frequencies are pruned after one or two iterations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.drive_modes.fields import ERROR_SHARE, Fields, error_power

Solve = Callable[[Complex64Array, Complex64Array, Complex64Array | None], Complex64Array]
"""Weights (n, eras) for R (n, eras, eras) and c (n, eras), within what a mode allows.

The third argument is the solution for the same R and a similar c, if there is one.
"""

MAX_CANDIDATES = 12
"""Frequencies at which Lawson's iterations are done."""

LAWSON_STEPS = np.array([1.0] + [0.7] * 5, dtype=np.float32)
"""Exponents of the expected power by which point weights are multiplied, one per iteration."""

MANY_POINTS, MAX_STEPS_MANY_POINTS = 100, 4
"""Number of quiet points above which fewer iterations are made, since each takes longer."""

PRUNE_MARGIN = 1.03
"""A frequency whose bound is below this times the best score is pruned."""

# Sigma and gain, tried in turn where no weights reach the level: the quiet points count less
# against each ERA's own power, and weights are raised up to full stroke.
LEVEL_RELAXATION = ((0.1, 3.0), (1.0, 1.0), (1.0, 3.0), (10.0, 1.0), (10.0, 3.0), (1000.0, 1e6))

_TINY = 1e-7


@dataclass(frozen=True)
class Coherent:
    """Method of a drive mode for its weights.

    solve: see `Solve`; phases: number of starting phases of the first target, and of every further
    one; iterations: number from each start that align the phases with those reached.
    """

    solve: Solve
    phases: tuple[int, int]
    iterations: int

    def search(self, fields: Fields, min_score: float) -> "CoherentResult":
        """Find the best weights at each frequency that can have the best score of all.

        min_score: best score so far. With none, frequencies are pruned at PRUNE_MARGIN; with one,
        only those that cannot exceed it, so that a mode finds what a restricted one would.
        """
        found = _BestCandidates(fields, min_score)
        weights, bound = self._weights(fields, _even_form(fields, sigma=ERROR_SHARE))
        expected = _expected_power(fields, weights)
        every = np.arange(fields.frequency_count)
        found.add(every, weights, fields, expected=expected, bound=bound)
        if not found.has_feasible:
            self._relax_level(fields, found)
        elif not fields.has_no_quiet_contacts:  # their norm is a mean already
            self._lawson_iterations(fields, found, expected=expected, bound=bound)
        return found.search()

    def _lawson_iterations(
        self,
        fields: Fields,
        found: "_BestCandidates",
        *,
        expected: Float32Array,
        bound: Float32Array,
    ) -> None:
        """Increase the weights of the loud quiet points while that may find better drives.

        expected (f, q), bound (f,): from equal point weights. A touch waits for this: every avoided
        call of numpy counts.
        """
        near = PRUNE_MARGIN if found.min_score == 0 else 1.0
        chosen, point_weights = np.arange(fields.frequency_count), np.ones_like(expected)
        many = fields.quiet.shape[-1] > MANY_POINTS
        for step in LAWSON_STEPS[:MAX_STEPS_MANY_POINTS] if many else LAWSON_STEPS:
            kept = (bound > near * found.score).nonzero()[0]
            if len(kept) == 0:
                return
            if len(kept) > MAX_CANDIDATES:
                kept = kept[np.argsort(-bound[kept])[:MAX_CANDIDATES]]
            if len(kept) < len(chosen):
                chosen, fields = chosen[kept], fields.at(kept)
                point_weights, expected = point_weights[kept], expected[kept]
            point_weights = point_weights * expected**step
            point_weights /= np.add.reduce(point_weights, axis=-1, keepdims=True)
            weights, bound = self._weights(fields, _mean_form(fields, point_weights))
            expected = _expected_power(fields, weights)
            found.add(chosen, weights, fields, expected=expected, bound=bound)

    def max_sensation(self, fields: Fields) -> float:
        """Return the highest amplitude to threshold found at the weakest target."""
        sigma, gain = LEVEL_RELAXATION[-1]
        weights, _ = self._weights(fields, _even_form(fields, sigma=sigma))
        peak = _peak(fields, _saturated(weights, gain))
        return float((peak / fields.threshold).max())

    def _relax_level(self, fields: Fields, found: "_BestCandidates") -> None:
        every = np.arange(fields.frequency_count)
        unknown = np.full(len(every), np.inf, dtype=np.float32)
        for sigma, gain in LEVEL_RELAXATION:
            weights, _ = self._weights(fields, _even_form(fields, sigma=sigma))
            weights = _saturated(weights, gain)
            expected = _expected_power(fields, weights)
            found.add(every, weights, fields, expected=expected, bound=unknown)
            if found.has_feasible:
                break

    def _weights(self, fields: Fields, R: Complex64Array) -> tuple[Complex64Array, Float32Array]:
        """Weights (n, eras), and their bound |c^H w| / sqrt(w^H R w), (n,)."""
        targets = fields.mean_targets
        starts = _starts(len(targets), self.phases)
        iterations = self.iterations if len(starts) > 1 else 1
        return _optimise_target_phases(R, targets, self.solve, starts=starts, iterations=iterations)


@dataclass(frozen=True, eq=False)
class CoherentResult:
    """The best weights (f, eras) at each frequency, and their robust score (f,).

    The score is 0 where none were found that reach the level. bound (f,): upper bound of the score,
    for a target's field constant over its fingertip. is_level_limited: weights of a better score
    were found that do not reach the level.
    """

    score: Float32Array
    weights: Complex64Array
    bound: Float32Array
    is_level_limited: bool


class _BestCandidates:
    """The best candidate weights so far.

    score: the best of those that reach the level, at first min_score; has_feasible: whether any do;
    best_infeasible_score: the best score of those that do not.
    """

    def __init__(self, fields: Fields, min_score: float) -> None:
        self._shape = fields.frequency_count, fields.era_count
        self._candidates: list[tuple[IntArray, Complex64Array, Float32Array, Float32Array]] = []
        self.min_score = self.score = min_score
        self.best_infeasible_score, self.has_feasible = 0.0, False

    def add(
        self,
        frequencies: IntArray,
        weights: Complex64Array,
        fields: Fields,
        *,
        expected: Float32Array,
        bound: Float32Array,
    ) -> None:
        """Add weights (n, eras) with their expected power at the quiet points (n, q).

        fields: at these frequencies only; bound (n,): upper bound of the score at them.
        """
        power = (
            expected.mean(axis=-1)
            if fields.has_no_quiet_contacts
            else np.maximum.reduce(expected, axis=-1)
        )
        peak = _peak(fields, weights)
        reaches = peak >= fields.wanted * fields.threshold
        score = peak / np.sqrt(power + _TINY * (peak * peak))
        count = int(np.count_nonzero(reaches))
        if count < len(reaches):
            self.best_infeasible_score = max(
                self.best_infeasible_score, float(score[~reaches].max())
            )
            score = np.where(reaches, score, 0)
        self._candidates.append((frequencies, weights, score, bound))
        self.score = max(self.score, float(score.max()))
        self.has_feasible = self.has_feasible or count > 0

    def search(self) -> "CoherentResult":
        """Return the best weights at each frequency."""
        at, weights, score, bound = map(np.concatenate, zip(*self._candidates, strict=True))
        found = CoherentResult(
            score=np.zeros(self._shape[0], dtype=np.float32),
            weights=np.zeros(self._shape, dtype=np.complex64),
            bound=np.full(self._shape[0], np.inf, dtype=np.float32),
            is_level_limited=self.best_infeasible_score > self.score,
        )
        # Written in ascending order, so that the best remains.
        order = np.argsort(-score, kind="stable")[::-1]
        found.score[at[order]] = score[order]
        found.weights[at[order]] = weights[order]
        np.minimum.at(found.bound, at, bound)
        return found


def _saturated(weights: Complex64Array, gain: float) -> Complex64Array:
    """Weights times a gain, limited to full stroke."""
    return np.asarray(weights / np.maximum(np.abs(weights), 1 / gain), dtype=np.complex64)


def _peak(fields: Fields, weights: Complex64Array) -> Float32Array:
    """Peak acceleration (n,) at the weakest target, mean over its points, for weights (n, eras)."""
    row = weights[:, None, :]
    each = [
        np.add.reduce(np.abs((row @ field)[:, 0]), axis=-1) / np.float32(field.shape[-1])
        for field in fields.targets
    ]
    return each[0] if len(each) == 1 else np.asarray(np.min(each, axis=0))


def _even_form(fields: Fields, *, sigma: float) -> Complex64Array:
    """R (f, eras, eras) for equal weights of the quiet points."""
    quiet = fields.quiet
    R = np.asarray(quiet.conj() @ quiet.transpose(0, 2, 1), dtype=np.complex64)
    R /= np.float32(quiet.shape[-1])
    diagonal = R.reshape(len(R), -1)[:, :: R.shape[1] + 1]
    diagonal += error_power(diagonal.real, sigma=sigma)
    return R


def _mean_form(fields: Fields, point_weights: Float32Array) -> Complex64Array:
    """R (n, eras, eras) for weights (n, q) of the quiet points."""
    mean = np.matvec(fields.quiet_forms, point_weights).view(np.complex64)
    return np.asarray(mean.reshape(len(mean), fields.era_count, -1))


def _expected_power(fields: Fields, weights: Complex64Array) -> Float32Array:
    """Expected power at the quiet points (n, q) of weights (n, eras): |w h|² + sigma² |w|² |h|²."""
    error = np.vecmat(_power(weights), fields.quiet_power)
    nominal = _power((weights[:, None, :] @ fields.quiet)[:, 0])
    return np.asarray(nominal + np.float32(ERROR_SHARE**2) * error)


def _power(values: Complex64Array) -> Float32Array:
    """Squared magnitude."""
    magnitude = np.abs(values)
    return np.asarray(magnitude * magnitude)


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
    solve: Solve,
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
    if len(starts) == 1 and iterations == 1:
        c = conjugate[0] if len(targets) == 1 else conjugate.sum(axis=0)
        w = solve(R, c, None)
        # At the solution w^H R w = |c^H w|.
        value = np.sqrt(np.abs(np.vecdot(c, w)))
    else:
        s = len(starts)
        target_factors = np.repeat(starts[:, :, None], n, axis=2)
        forms = np.broadcast_to(R, (s, *R.shape)).reshape(-1, eras, eras)
        tried, values = [], []
        solved = None
        for _ in range(iterations):
            c = np.einsum("stn,tne->sne", target_factors, conjugate)
            solved = solve(forms, c.reshape(-1, eras), solved)
            w = solved.reshape(s, n, eras)
            reached = np.einsum("tne,sne->stn", targets, w)
            magnitude = np.maximum(np.abs(reached), 1e-20)
            cost = np.einsum("sne,nef,snf->sn", w.conj(), R, w).real
            tried.append(w)
            values.append(magnitude.min(axis=1) / np.sqrt(np.maximum(cost, 1e-30)))
            lacking = np.sqrt(magnitude.mean(axis=1, keepdims=True) / magnitude)
            target_factors = np.abs(target_factors) * lacking * reached / magnitude
        every = np.concatenate(values)
        best = every.argmax(axis=0)
        w = np.concatenate(tried)[best, np.arange(n)]
        value = every[best, np.arange(n)]
    size = np.maximum.reduce(np.abs(w), axis=-1, keepdims=True)
    return np.asarray(w / np.maximum(size, 1e-30), dtype=np.complex64), value
