"""All ERAs at one frequency: the weights that reach the targets past the quiet points, robustly.

At each frequency the quiet points' mean power, errors included, is the quadratic form w^H R w of
the weights w,

    R = sum_p v_p (conj(h_p) h_p^T + sigma² diag |h_p|²),    sum_p v_p = 1,

and weights that reach the targets with the least of it solve R w = c, where c sums the targets'
conj(h_t), turned to the phases in which they are reached. Where the loudest quiet point counts, the
shares v_p are moved towards the loud ones and it is solved again (Lawson's algorithm for minimax
approximation). Whatever the shares, a mean is no more than the maximum: what is reached per root of
w^H R w bounds what a frequency can offer from above, and most are left after a round or two.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from model.arrays import IntArray
from model.drive_modes.fields import ERROR_SHARE, Drive, Fields, Single, SingleComplex

Solve = Callable[[SingleComplex, SingleComplex], SingleComplex]
"""Weights (n, eras) for R (n, eras, eras) and c (n, eras), within what a mode allows."""

PROMISING = 12  # frequencies at which shares are moved, at the most
STEPS = np.array([1.0] + [0.7] * 6, dtype=np.float32)  # how far, round by round, at the most
FEWER_STEPS, MANY_POINTS = 5, 100  # of six fingers and more, where a round takes longer
CLOSE = 1.03  # a frequency that cannot be better than this times the best is left

# Where nothing reaches the level, quieter fingers are given up for a louder target, step by step:
# quiet points count less against each ERA's own share, and weights are raised until they are full.
GIVEN_UP = ((0.1, 3.0), (1.0, 1.0), (1.0, 3.0), (10.0, 1.0), (10.0, 3.0), (1000.0, 1e6))

_TINY = 1e-7


@dataclass(frozen=True)
class Coherent:
    """How a mode's weights are found.

    solve: see `Solve`; phases: at how many phases of the first target, and of every further one,
    weights are looked for; ascents: how often the phases are then brought into line with what was
    reached; where nothing is gained by it, once.
    """

    solve: Solve
    phases: tuple[int, int]
    ascents: int

    def search(self, fields: Fields, least: float) -> "Search":
        """The best weights at each frequency, as far as the best of all may be among them.

        least: a score that is there already. Frequencies that can be hardly better than the best
        are left as they are, or those that cannot be better at all where there is one already: a
        richer mode then has what a poorer one would have found.
        """
        found = _Best(fields, least)
        near = CLOSE if least == 0 else 1.0
        chosen, some, shares = np.arange(fields.frequency_count), fields, _even_shares(fields)
        for step in STEPS[: _rounds(fields)]:
            weights, bound = self._weights(some, shares, sigma=ERROR_SHARE)
            found.bound[chosen] = np.minimum(found.bound[chosen], bound)
            likely = found.offer(chosen, weights, some)
            kept = np.flatnonzero(bound > near * found.score)
            if not found.reaches or len(kept) == 0:
                break
            if len(kept) > PROMISING:
                kept = kept[np.argsort(-bound[kept])[:PROMISING]]
            if len(kept) < len(chosen):
                chosen = chosen[kept]
                some = fields.at(chosen)
            shares = shares[kept] * likely[kept] ** step
            shares /= shares.sum(axis=-1, keepdims=True)
        if not found.reaches:
            self._offer_louder(fields, found)
        return Search(found.scores, found.weights, found.bound, found.refused > found.score)

    def loudest(self, fields: Fields) -> float:
        """How many times above threshold the targets can be made to feel it."""
        sigma, gain = GIVEN_UP[-1]
        weights, _ = self._weights(fields, _even_shares(fields), sigma=sigma)
        peak = _peak(fields, _raised(weights, gain))
        return float((peak / fields.threshold).max())

    def _offer_louder(self, fields: Fields, found: "_Best") -> None:
        for sigma, gain in GIVEN_UP:
            weights, _ = self._weights(fields, _even_shares(fields), sigma=sigma)
            found.offer(np.arange(fields.frequency_count), _raised(weights, gain), fields)
            if found.reaches:
                break

    def _weights(
        self, fields: Fields, shares: Single, *, sigma: float
    ) -> tuple[SingleComplex, Single]:
        """Weights (n, eras), and what they reach per root of w^H R w, (n,)."""
        R = _quiet_form(fields, shares, sigma=sigma)
        targets = fields.mean_targets
        starts = _starts(len(targets), self.phases)
        ascents = self.ascents if len(starts) > 1 else 1
        return _ascend(R, targets, self.solve, starts=starts, ascents=ascents)


@dataclass(frozen=True, eq=False)
class Search:
    """The best weights (f, eras) at each frequency, and their robust score (f,).

    The score is 0 where none were found that reach the level. bound (f,): what no weights that the
    mode allows can have there, but for the target's field not being quite even over its fingertip.
    is_held_back: better weights than the best were found that do not reach the level.
    """

    score: Single
    weights: SingleComplex
    bound: Single
    is_held_back: bool

    def drive(self) -> Drive | None:
        """The best of all frequencies; None where nothing reaches the level."""
        best = int(self.score.argmax())
        return Drive.at(best, self.weights[best]) if self.score[best] > 0 else None


class _Best:
    """The best of the weights that were offered, at each frequency; score: of all, or the least.

    reaches: whether any of them reached the level; refused: the best score of those that did not.
    """

    def __init__(self, fields: Fields, least: float) -> None:
        count = fields.frequency_count
        self.scores: Single = np.zeros(count, dtype=np.float32)
        self.weights: SingleComplex = np.zeros((count, fields.era_count), dtype=np.complex64)
        self.bound: Single = np.full(count, np.inf, dtype=np.float32)
        self.score, self.refused, self.reaches = least, 0.0, False

    def offer(self, frequencies: IntArray, weights: SingleComplex, fields: Fields) -> Single:
        """Power at the quiet points, errors included (n, q), of weights (n, eras).

        fields: at these frequencies only.
        """
        # A touch waits for this, round by round: every call of numpy that is spared counts.
        row = weights[:, None, :]
        wrong = (_squared(weights)[:, None, :] @ fields.quiet_power)[:, 0]
        likely = _squared((row @ fields.quiet)[:, 0]) + np.float32(ERROR_SHARE**2) * wrong
        power = likely.mean(axis=-1) if fields.is_alone else np.maximum.reduce(likely, axis=-1)
        peak = _peak(fields, weights)
        reaches = peak >= fields.wanted * fields.threshold
        score = peak / np.sqrt(power + _TINY * peak**2)
        count = int(np.count_nonzero(reaches))
        if count < len(reaches):
            self.refused = max(self.refused, float(score[~reaches].max()))
            score = np.where(reaches, score, 0)
        better = np.flatnonzero(score > self.scores[frequencies])
        if len(better) > 0:
            at = frequencies[better]
            self.scores[at] = score[better]
            self.weights[at] = weights[better]
            self.score = max(self.score, float(score.max()))
        self.reaches = self.reaches or count > 0
        return np.asarray(likely, dtype=np.float32)


def _rounds(fields: Fields) -> int:
    """How often the quiet points' shares are worth moving; a mean needs no moving."""
    if fields.is_alone:
        return 1
    return FEWER_STEPS if fields.quiet.shape[-1] > MANY_POINTS else len(STEPS)


def _even_shares(fields: Fields) -> Single:
    """Every quiet point counts the same, (f, q)."""
    f, _, q = fields.quiet.shape
    return np.full((f, q), 1 / q, dtype=np.float32)


def _raised(weights: SingleComplex, gain: float) -> SingleComplex:
    """Weights times a gain, none above full stroke."""
    return np.asarray(weights / np.maximum(np.abs(weights), 1 / gain), dtype=np.complex64)


def _peak(fields: Fields, weights: SingleComplex) -> Single:
    """Peak acceleration (n,) at the lesser target, mean over its points, for weights (n, eras)."""
    row = weights[:, None, :]
    each = [
        np.add.reduce(np.abs((row @ field)[:, 0]), axis=-1) / np.float32(field.shape[-1])
        for field in fields.targets
    ]
    return each[0] if len(each) == 1 else np.asarray(np.min(each, axis=0))


def _quiet_form(fields: Fields, shares: Single, *, sigma: float) -> SingleComplex:
    """R (n, eras, eras) for shares (n, q) of the quiet points."""
    R = np.asarray(fields.quiet_conjugate @ (fields.quiet * shares[:, None, :]).transpose(0, 2, 1))
    diagonal = R.reshape(len(R), -1)[:, :: R.shape[1] + 1]
    wrong = diagonal.real
    # An ERA that does not move the quiet points must still have a weight that is a number.
    floor = _TINY * np.maximum.reduce(wrong, axis=-1, keepdims=True) + np.float32(1e-20)
    diagonal += np.float32(sigma**2) * wrong + floor
    return R


def _squared(values: SingleComplex) -> Single:
    """The squared magnitude."""
    real, imaginary = values.real, values.imag
    return np.asarray(real * real + imaginary * imaginary)


@lru_cache(maxsize=16)
def _starts(targets: int, phases: tuple[int, int]) -> SingleComplex:
    """Phases of the targets to start from, as complex numbers (s, targets)."""
    circles = [
        np.exp(2j * np.pi * np.arange(count) / count)
        for count in (phases[0], *[phases[1]] * (targets - 1))
    ]
    return np.array(list(product(*circles)), dtype=np.complex64)


def _ascend(
    R: SingleComplex,
    targets: SingleComplex,
    solve: Solve,
    *,
    starts: SingleComplex,
    ascents: int,
) -> tuple[SingleComplex, Single]:
    """Weights (n, eras), largest magnitude 1, for targets (t, n, eras), the best of all starts.

    With them what they reach per root of w^H R w, (n,). Each round turns the targets to the phases
    that were reached, which cannot lower what is reached, and gives more weight to a target that
    gets less.
    """
    _, n, eras = targets.shape
    conjugate = targets.conj()
    if len(starts) == 1 and ascents == 1:
        c = conjugate[0] if len(targets) == 1 else conjugate.sum(axis=0)
        w = solve(R, c)
        # Of the solution w^H R w is |c^H w|.
        value = np.sqrt(np.abs(np.add.reduce(c.conj() * w, axis=-1)))
    else:
        s = len(starts)
        turned = np.repeat(starts[:, :, None], n, axis=2)
        forms = np.broadcast_to(R, (s, *R.shape)).reshape(-1, eras, eras)
        tried, values = [], []
        for _ in range(ascents):
            c = np.einsum("stn,tne->sne", turned, conjugate)
            w = solve(forms, c.reshape(-1, eras)).reshape(s, n, eras)
            reached = np.einsum("tne,sne->stn", targets, w)
            magnitude = np.maximum(np.abs(reached), 1e-20)
            cost = np.einsum("sne,nef,snf->sn", w.conj(), R, w).real
            tried.append(w)
            values.append(magnitude.min(axis=1) / np.sqrt(np.maximum(cost, 1e-30)))
            lacking = np.sqrt(magnitude.mean(axis=1, keepdims=True) / magnitude)
            turned = np.abs(turned) * lacking * reached / magnitude
        every = np.concatenate(values)
        best = every.argmax(axis=0)
        w = np.concatenate(tried)[best, np.arange(n)]
        value = every[best, np.arange(n)]
    size = np.maximum.reduce(np.abs(w), axis=-1, keepdims=True)
    return np.asarray(w / np.maximum(size, 1e-30), dtype=np.complex64), value
