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
from model.drive_modes.fields import (
    ERROR_SHARE,
    Fields,
    Single,
    SingleComplex,
    added_by_errors,
)

Solve = Callable[[SingleComplex, SingleComplex], SingleComplex]
"""Weights (n, eras) for R (n, eras, eras) and c (n, eras), within what a mode allows."""

PROMISING = 12  # frequencies at which shares are moved, at the most
MOVES = np.array([1.0] + [0.7] * 5, dtype=np.float32)  # how far, one after the other, at the most
FEWER_MOVES, MANY_POINTS = 4, 100  # of six fingers and more, where one takes longer
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
        weights, bound = self._weights(fields, _even_form(fields, sigma=ERROR_SHARE))
        likely = _likely_power(fields, weights)
        every = np.arange(fields.frequency_count)
        found.offer(every, weights, fields, likely=likely, bound=bound)
        if not found.reaches:
            self._offer_louder(fields, found)
        elif not fields.is_alone:  # a mean needs no moving
            self._move_shares(fields, found, likely=likely, bound=bound)
        return found.search()

    def _move_shares(
        self, fields: Fields, found: "_Best", *, likely: Single, bound: Single
    ) -> None:
        """Let the loud quiet points count for more, time and again, where that may find better.

        likely (f, q), bound (f,): what came of points that count the same. A touch waits for this:
        every call of numpy that is spared counts.
        """
        near = CLOSE if found.least == 0 else 1.0
        chosen, shares = np.arange(fields.frequency_count), np.ones_like(likely)
        many = fields.quiet.shape[-1] > MANY_POINTS
        for move in MOVES[:FEWER_MOVES] if many else MOVES:
            kept = (bound > near * found.score).nonzero()[0]
            if len(kept) == 0:
                return
            if len(kept) > PROMISING:
                kept = kept[np.argsort(-bound[kept])[:PROMISING]]
            if len(kept) < len(chosen):
                chosen, fields = chosen[kept], fields.at(kept)
                shares, likely = shares[kept], likely[kept]
            shares = shares * likely**move
            shares /= np.add.reduce(shares, axis=-1, keepdims=True)
            weights, bound = self._weights(fields, _mean_form(fields, shares))
            likely = _likely_power(fields, weights)
            found.offer(chosen, weights, fields, likely=likely, bound=bound)

    def loudest(self, fields: Fields) -> float:
        """How many times above threshold the targets can be made to feel it."""
        sigma, gain = GIVEN_UP[-1]
        weights, _ = self._weights(fields, _even_form(fields, sigma=sigma))
        peak = _peak(fields, _raised(weights, gain))
        return float((peak / fields.threshold).max())

    def _offer_louder(self, fields: Fields, found: "_Best") -> None:
        every = np.arange(fields.frequency_count)
        unknown = np.full(len(every), np.inf, dtype=np.float32)
        for sigma, gain in GIVEN_UP:
            weights, _ = self._weights(fields, _even_form(fields, sigma=sigma))
            weights = _raised(weights, gain)
            likely = _likely_power(fields, weights)
            found.offer(every, weights, fields, likely=likely, bound=unknown)
            if found.reaches:
                break

    def _weights(self, fields: Fields, R: SingleComplex) -> tuple[SingleComplex, Single]:
        """Weights (n, eras), and what they reach per root of w^H R w, (n,)."""
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


class _Best:
    """The best of the weights that were offered; least: a score that is there already.

    score: of all that reach the level, or the least; reaches: whether any do; refused: the best
    score of those that do not.
    """

    def __init__(self, fields: Fields, least: float) -> None:
        self._shape = fields.frequency_count, fields.era_count
        self._offers: list[tuple[IntArray, SingleComplex, Single, Single]] = []
        self.least = self.score = least
        self.refused, self.reaches = 0.0, False

    def offer(
        self,
        frequencies: IntArray,
        weights: SingleComplex,
        fields: Fields,
        *,
        likely: Single,
        bound: Single,
    ) -> None:
        """Weights (n, eras) with their power at the quiet points (n, q), errors included.

        fields: at these frequencies only; bound (n,): what no weights can have at them.
        """
        power = likely.mean(axis=-1) if fields.is_alone else np.maximum.reduce(likely, axis=-1)
        peak = _peak(fields, weights)
        reaches = peak >= fields.wanted * fields.threshold
        score = peak / np.sqrt(power + _TINY * (peak * peak))
        count = int(np.count_nonzero(reaches))
        if count < len(reaches):
            self.refused = max(self.refused, float(score[~reaches].max()))
            score = np.where(reaches, score, 0)
        self._offers.append((frequencies, weights, score, bound))
        self.score = max(self.score, float(score.max()))
        self.reaches = self.reaches or count > 0

    def search(self) -> "Search":
        """The best at each frequency."""
        at, weights, score, bound = map(np.concatenate, zip(*self._offers, strict=True))
        found = Search(
            score=np.zeros(self._shape[0], dtype=np.float32),
            weights=np.zeros(self._shape, dtype=np.complex64),
            bound=np.full(self._shape[0], np.inf, dtype=np.float32),
            is_held_back=self.refused > self.score,
        )
        # The best is written last, and so stays.
        order = np.argsort(-score, kind="stable")[::-1]
        found.score[at[order]] = score[order]
        found.weights[at[order]] = weights[order]
        np.minimum.at(found.bound, at, bound)
        return found


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


def _even_form(fields: Fields, *, sigma: float) -> SingleComplex:
    """R (f, eras, eras) of quiet points that all count the same."""
    quiet = fields.quiet
    R = np.asarray(quiet.conj() @ quiet.transpose(0, 2, 1), dtype=np.complex64)
    R /= np.float32(quiet.shape[-1])
    diagonal = R.reshape(len(R), -1)[:, :: R.shape[1] + 1]
    diagonal += added_by_errors(diagonal.real, sigma=sigma)
    return R


def _mean_form(fields: Fields, shares: Single) -> SingleComplex:
    """R (n, eras, eras) for shares (n, q) of the quiet points."""
    mean = np.matvec(fields.quiet_forms, shares).view(np.complex64)
    return np.asarray(mean.reshape(len(mean), fields.era_count, -1))


def _likely_power(fields: Fields, weights: SingleComplex) -> Single:
    """Power at the quiet points, errors included (n, q), of weights (n, eras)."""
    wrong = np.vecmat(_squared(weights), fields.quiet_power)
    right = _squared((weights[:, None, :] @ fields.quiet)[:, 0])
    return np.asarray(right + np.float32(ERROR_SHARE**2) * wrong)


def _squared(values: SingleComplex) -> Single:
    """The squared magnitude."""
    magnitude = np.abs(values)
    return np.asarray(magnitude * magnitude)


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
        value = np.sqrt(np.abs(np.vecdot(c, w)))
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
