"""Settled patterns as measurements of the plate that plays them, and its update by these.

The fingers of each pattern are estimated with the plate, and its noise from what updates leave.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import by_mass_at, jacobian
from model.identification.forward import ForwardModel, PlateAt, RestingFinger
from model.identification.least_squares import search
from model.identification.parameters import FINGER_PARTS, Space

_OWN = 0.5  # of a finger's deviation as a whole
_NOISE, _FLOOR = 0.01, 0.1
"""Of a reading at most, relative to its size; of those near zero, to the mean of all sensors."""


@dataclass(frozen=True, eq=False)
class SettledPattern:
    """A tone that has settled: time [s], frequency [Hz], and what it was played and measured with.

    bases (n,): amplitude of each ERA's base as commanded [m]; values (s,): acceleration at each
    sensor [m/s²], phases as exp(+i omega t); fingers: on the plate, as far as they are known.
    has_phase: whether phases of values count from those of bases; otherwise one phase is unknown,
    the same for all sensors, and no update depends on it.
    """

    time: float
    frequency: float
    bases: ComplexArray
    values: ComplexArray
    fingers: tuple[RestingFinger, ...] = ()
    has_phase: bool = True

    @property
    def std(self) -> FloatArray:
        """Largest error of each real number of `numbers`, one standard deviation (2 s,)."""
        rms2 = (np.abs(self.values) ** 2).mean()
        own = _NOISE * np.sqrt(np.abs(self.values) ** 2 + _FLOOR**2 * rms2)
        return np.concatenate([own, own])

    @property
    def numbers(self) -> FloatArray:
        """Real parts and imaginary parts of the values, (2 s,)."""
        return np.concatenate([self.values.real, self.values.imag])


def finger_count(patterns: Sequence[SettledPattern]) -> int:
    """Number of parameters of all fingers of some patterns."""
    return len(FINGER_PARTS) * sum(len(pattern.fingers) for pattern in patterns)


def finger_covariance(patterns: Sequence[SettledPattern]) -> FloatArray:
    """Covariance (q, q) of the parameters of all fingers of some patterns before any of them.

    A finger loads a plate more or less as a whole, and each of its parts differs half as much
    beside that: parts that varied on their own only would make a heavy finger as unlikely as four.
    """
    parts = len(FINGER_PARTS)
    own = _OWN**2 * np.eye(parts) + np.ones((parts, parts))
    return np.asarray(np.kron(np.eye(finger_count(patterns) // parts), own), dtype=float)


@dataclass(frozen=True, eq=False)
class PatternModel:
    """The plate of a forward model under the fingers of one pattern.

    space: of the model, which has no fingers of its own; forward: the model with the fingers;
    noise: of the pattern's readings, relative to its largest.
    """

    pattern: SettledPattern
    space: Space
    forward: ForwardModel
    noise: float = 1.0

    @classmethod
    def of(
        cls,
        model: ForwardModel,
        pattern: SettledPattern,
        finger_std: float,
        *,
        noise: float = 1.0,
    ) -> "PatternModel":
        """A model under the fingers of a pattern, of loads known to finger_std (of logarithms)."""
        count, space = len(FINGER_PARTS) * len(pattern.fingers), model.space
        names = [f"finger part {number}" for number in range(count)]
        wider = space.and_further("fingers", names, finger_std)
        forward = replace(
            model,
            frequencies=np.array([pattern.frequency]),
            fingers=pattern.fingers,
            space=wider,
            last_places={},
        )
        return cls(pattern, space, forward, noise)

    @property
    def std(self) -> FloatArray:
        """Error of each number of the pattern, (2 s,)."""
        return self.noise * self.pattern.std

    def predicted(self, x: FloatArray, fingers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Numbers that a pattern is expected to give (2 s,), and their derivatives (2 s, p + q).

        x (p,): of the plate; fingers (q,): of theirs.
        """
        plate = self.forward.at(np.concatenate([x, fingers]))
        values = plate.responses[0] @ self.pattern.bases
        changes = np.einsum("snp,n->sp", jacobian(plate)[0], self.pattern.bases)
        return self._as_numbers(values, changes)

    def by_mass_at(self, plate: PlateAt, points: FloatArray) -> FloatArray:
        """Change of the numbers of the pattern by a mass [kg] at points (m, 2) [m], (2 s, m)."""
        changes = np.einsum("snp,n->sp", by_mass_at(plate, points)[0], self.pattern.bases)
        return self._as_numbers(plate.responses[0] @ self.pattern.bases, changes)[1]

    def _as_numbers(
        self, values: ComplexArray, changes: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Real and imaginary parts of values at the sensors (s,) and their changes (s, q).

        Without a known phase the values are turned to that of the pattern's own, v: a exp(-i phi)
        with phi = arg(v^H a), which changes by d phi = Im(v^H da / v^H a).
        """
        if not self.pattern.has_phase:
            measured = self.pattern.values.conj()
            along = measured @ values
            turned = (measured @ changes / along).imag
            phase_factor = abs(along) / along
            changes = phase_factor * (changes - 1j * np.outer(values, turned))
            values = phase_factor * values
        return (
            np.concatenate([values.real, values.imag]),
            np.concatenate([changes.real, changes.imag]),
        )


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
