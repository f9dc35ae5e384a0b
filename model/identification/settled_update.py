"""Update of a plate by settled patterns, the fingers of each estimated with it; their noise."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.identification.least_squares import search
from model.identification.settled import PatternModel, finger_count, finger_covariance

_LEAST = 1e-14  # of the largest variance
_INSIDE = 0.1  # standard deviations
_PATTERNS = 60
_FIRST_NOISE = 8.0
_LEAST_NOISE = 0.3


@dataclass(frozen=True, eq=False)
class State:
    """Parameters x (p,) of a plate with their covariance (p, p)."""

    x: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class StateUpdate:
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
    patterns: Sequence[PatternModel],
    *,
    evaluations: int,
    start: FloatArray | None = None,
    theory: FloatArray | None = None,
) -> StateUpdate:
    """Most likely state after patterns within its bounds, from the state or from a start.

    evaluations: of the model, at most; start: of the plate (p,), or of plate and fingers (p + q,);
    theory (p,): variances of what the theory gets wrong, which count in how unlikely an innovation
    is, and only there.
    """
    space = patterns[0].space
    settled = [each.pattern for each in patterns]
    p, q = len(before.x), finger_count(settled)
    prior = linalg.block_diag(before.covariance, finger_covariance(settled))
    centre = np.concatenate([before.x, np.zeros(q)])
    values = np.concatenate([each.pattern.numbers for each in patterns])
    std = np.concatenate([each.std for each in patterns])
    loose = np.diagonal(prior) > 0
    variance, axes = np.linalg.eigh(prior[np.ix_(loose, loose)])
    rows = (axes / np.sqrt(np.maximum(variance, _LEAST * variance.max()))).T
    at = centre.copy()
    if start is not None:
        at[: len(start)] = start

    def linearised(z: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        predicted, H = _linearised(patterns, z, p, q)
        return (predicted - values) / std + 0j, H[:, loose] / std[:, None] + 0j

    bounds = np.full((2, p + q), [[-np.inf], [np.inf]])
    bounds[:, :p] = space.lower, space.upper
    found = search(
        linearised,
        at,
        bounds,
        loose,
        prior=(rows, rows @ centre[loose]),
        evaluations=evaluations,
        inside=_INSIDE,
    )
    at = found.x
    predicted, H = _linearised(patterns, at, p, q)
    gain = prior @ H.T
    inverse = linalg.inv(H @ gain + np.diag(std**2))
    covariance = prior - gain @ inverse @ gain.T
    residuals = (values - predicted) / std
    # Of the change that led there.
    innovation = values - predicted - H @ (centre - at)
    wrong = np.zeros(p + q)
    wrong[:p] = 0.0 if theory is None else theory
    expected = H @ (gain + wrong[:, None] * H.T) + np.diag(std**2)
    # In the slopes where it ended: those before are wrong for a finger of another load.
    precision = linalg.inv(expected)
    nis = float(innovation @ precision @ innovation)
    own = covariance[:p, :p]
    return StateUpdate(
        State(at[:p], (own + own.T) / 2),
        nis,
        len(values),
        2 * found.cost,
        float(residuals @ residuals),
        float(std**2 @ np.diagonal(inverse)),
        at[p:],
        innovation,
        H[:, :p],
        precision,
    )


def _linearised(
    patterns: Sequence[PatternModel], at: FloatArray, p: int, q: int
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


class NoiseLevel:
    """Noise of readings relative to the largest that a `SettledPattern` states, 0.3 to 1.

    An error that is taken too large hides a change until other parameters have taken it up. The
    most likely variance is that of the residuals over the numbers that no parameter takes up
    (D. J. C. MacKay, Bayesian interpolation, Neural Computation 4, 1992, 415-447, eq. 4.11).

    It begins at the largest. Below 0.3 a plate is never known: what a finger's model leaves counts
    as noise, too. Never above 1, or a change would make itself unremarkable.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[float, float]] = deque(maxlen=_PATTERNS)
        self.relative = 1.0

    def take(self, updated: StateUpdate) -> None:
        """Take what an update by a pattern of this noise has left of it."""
        self._recent.append((self.relative**2 * updated.misfit, updated.freedom))
        misfit, freedom = np.array(self._recent).sum(axis=0) + _FIRST_NOISE
        self.relative = float(np.clip(np.sqrt(misfit / freedom), _LEAST_NOISE, 1.0))
