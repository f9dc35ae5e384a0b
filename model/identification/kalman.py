"""Iterated update of a plate by settled patterns, the fingers of each estimated with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.identification.settled import Touched, finger_count

_CONVERGED = 3e-3  # standard deviations
_MAX_STEP = 1.5


@dataclass(frozen=True, eq=False)
class State:
    """Parameters x (p,) of a plate with their covariance (p, p)."""

    x: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Updated:
    """A state after some patterns.

    nis: normalised innovation squared before the update, of `count` real numbers; cost: squared
    residuals and changes after it, in standard deviations; fingers (q,): parameters of all fingers.
    """

    state: State
    nis: float
    count: int
    cost: float
    fingers: FloatArray


def update(
    before: State,
    patterns: Sequence[Touched],
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
    p, q = len(before.x), finger_count([each.pattern for each in patterns])
    prior = linalg.block_diag(before.covariance, np.eye(q))
    centre = np.concatenate([before.x, np.zeros(q)])
    values = np.concatenate([each.pattern.numbers for each in patterns])
    std = np.concatenate([each.pattern.std for each in patterns])
    at = centre.copy()
    if start is not None:
        at[: len(start)] = start
    nis = np.nan
    for step in range(iterations):
        predicted, H = _linearised(patterns, at, p, q)
        innovation = values - predicted - H @ (centre - at)
        gain = prior @ H.T
        S = linalg.cho_factor(H @ gain + np.diag(std**2))
        weighted = linalg.cho_solve(S, innovation)
        if step == 0 and start is None:
            wrong = np.zeros(p + q)
            wrong[:p] = 0.0 if theory is None else theory
            expected = H @ (gain + wrong[:, None] * H.T) + np.diag(std**2)
            nis = float(innovation @ linalg.solve(expected, innovation, assume_a="pos"))
        moved = centre + gain @ weighted
        moved[:p] = np.clip(moved[:p], space.lower, space.upper)
        change = np.abs(moved - at).max()
        # What is loose moves far where a step's slopes no longer hold.
        at = at + min(1.0, _MAX_STEP / max(change, 1e-12)) * (moved - at)
        if change < _CONVERGED:
            break
    predicted, H = _linearised(patterns, at, p, q)
    gain = prior @ H.T
    covariance = prior - gain @ linalg.solve(H @ gain + np.diag(std**2), gain.T, assume_a="pos")
    residuals = (values - predicted) / std
    # Of the change that led there: (x - x0)^T P^-1 (x - x0) through the numbers it explains.
    innovation = values - predicted - H @ (centre - at)
    weighted = linalg.solve(H @ gain + np.diag(std**2), innovation, assume_a="pos")
    changes = float(weighted @ H @ gain @ weighted)
    own = covariance[:p, :p]
    return Updated(
        State(at[:p], (own + own.T) / 2),
        nis,
        len(values),
        float(residuals @ residuals) + changes,
        at[p:],
    )


def _linearised(
    patterns: Sequence[Touched], at: FloatArray, p: int, q: int
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
