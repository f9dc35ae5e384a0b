"""Iterated update of a plate by settled patterns, the fingers of each estimated with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.identification.settled import Measured, finger_count, finger_covariance

_CONVERGED = 3e-3  # standard deviations
_MAX_STEP = 1.5
_BACK, _MIN_SHARE = 0.3, 0.01  # of a step that leads up


@dataclass(frozen=True, eq=False)
class State:
    """Parameters x (p,) of a plate with their covariance (p, p)."""

    x: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Updated:
    """A state after some patterns.

    nis: normalised innovation squared before the update, of `count` real numbers; cost: squared
    residuals and changes after it, in standard deviations; misfit: squared residuals alone, of
    `freedom` numbers that plate and fingers do not take up; fingers (q,): parameters of all of
    them; innovation (count,): at the slopes (count, p) by the plate where the update ended;
    precision (count, count): the inverse of its covariance, what the theory gets wrong included.
    """

    state: State
    nis: float
    count: int
    cost: float
    misfit: float
    freedom: float
    fingers: FloatArray
    innovation: FloatArray
    slopes: FloatArray
    precision: FloatArray


def update(
    before: State,
    patterns: Sequence[Measured],
    *,
    iterations: int,
    start: FloatArray | None = None,
    theory: FloatArray | None = None,
) -> Updated:
    """Most likely state after patterns, by Gauss-Newton steps from the state or from a start.

    start: of the plate (p,), or of plate and fingers (p + q,); theory (p,): variances of what the
    theory gets wrong, which count in how unlikely an innovation is, and only there. In the form of
    the innovation: only a matrix as large as the patterns' numbers is inverted.
    """
    space = patterns[0].space
    settled = [each.pattern for each in patterns]
    p, q = len(before.x), finger_count(settled)
    prior = linalg.block_diag(before.covariance, finger_covariance(settled))
    centre = np.concatenate([before.x, np.zeros(q)])
    values = np.concatenate([each.pattern.numbers for each in patterns])
    std = np.concatenate([each.std for each in patterns])
    at = centre.copy()
    if start is not None:
        at[: len(start)] = start
    # From the state itself steps are short; from elsewhere they are taken back where they lead up.
    weights = None if start is None else linalg.pinvh(prior)
    best, reached, target, share = np.inf, at, at, 1.0
    for _ in range(iterations):
        predicted, H = _linearised(patterns, at, p, q)
        cost = 0.0
        if weights is not None:
            moved = at - centre
            cost = float((((values - predicted) / std) ** 2).sum() + moved @ weights @ moved)
        if cost > best:
            share *= _BACK
            if share < _MIN_SHARE:
                break
            at = reached + share * (target - reached)
            continue
        best, reached = cost, at
        innovation = values - predicted - H @ (centre - at)
        gain = prior @ H.T
        S = linalg.cho_factor(H @ gain + np.diag(std**2))
        weighted = linalg.cho_solve(S, innovation)
        target = centre + gain @ weighted
        target[:p] = np.clip(target[:p], space.lower, space.upper)
        change = np.abs(target - at).max()
        # What is loose moves far where a step's slopes no longer hold.
        share = min(1.0, _MAX_STEP / max(change, 1e-12))
        at = reached + share * (target - reached)
        if change < _CONVERGED:
            break
    if weights is not None:
        at = reached
    predicted, H = _linearised(patterns, at, p, q)
    gain = prior @ H.T
    inverse = linalg.inv(H @ gain + np.diag(std**2))
    covariance = prior - gain @ inverse @ gain.T
    residuals = (values - predicted) / std
    # Of the change that led there: (x - x0)^T P^-1 (x - x0) through the numbers it explains.
    innovation = values - predicted - H @ (centre - at)
    weighted = inverse @ innovation
    changes = float(weighted @ H @ gain @ weighted)
    wrong = np.zeros(p + q)
    wrong[:p] = 0.0 if theory is None else theory
    expected = H @ (gain + wrong[:, None] * H.T) + np.diag(std**2)
    # In the slopes where it ended: those before are wrong for a finger of another load.
    precision = linalg.inv(expected)
    nis = float(innovation @ precision @ innovation)
    own = covariance[:p, :p]
    return Updated(
        State(at[:p], (own + own.T) / 2),
        nis,
        len(values),
        float(residuals @ residuals) + changes,
        float(residuals @ residuals),
        float(std**2 @ np.diagonal(inverse)),
        at[p:],
        innovation,
        H[:, :p],
        precision,
    )


def _linearised(
    patterns: Sequence[Measured], at: FloatArray, p: int, q: int
) -> tuple[FloatArray, FloatArray]:
    """Numbers of all patterns, and their derivatives by plate and fingers (m, p + q)."""
    predicted, rows, first = [], [], p
    for each in patterns:
        own = finger_count([each.pattern])
        values, J = each.predicted(at[:p], at[first : first + own])
        row = np.zeros((len(values), p + q))
        row[:, :p], row[:, first : first + own] = J[:, :p], J[:, p:]
        predicted.append(values)
        rows.append(row)
        first += own
    return np.concatenate(predicted), np.concatenate(rows)
