"""Settled patterns as measurements of the plate that plays them: updates, alarms and explanations.

An update estimates the loads of a pattern's fingers together with the plate; the noise of readings
follows from what updates leave.

An alarm means that some of the last innovations are unlikely together, or along one change: a
spring, a gain, the thickness, or a mass in one of many places. The latter is a generalised
likelihood ratio test, which finds what fingers and noise hide in the sum (M. Basseville, I. V.
Nikiforov, Detection of Abrupt Changes, 1993, section 2.4.3). One pattern alone raises no alarm,
since a finger may be unlike any other, but it does not update the state either.

An explanation is one such change, as a wide prior of the parameters that would have changed. The
most likely one costs least in a batch estimate over the last patterns, plus a cost for each changed
parameter. Where it still leaves residuals beyond chance, the change is of an unknown kind.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import ComplexArray, FloatArray, best_of, ranked_by
from model.estimate.forward import ForwardModel, PlateAt, RestingFinger, by_mass_at, jacobian
from model.estimate.least_squares import search, single_changes
from model.estimate.space import FINGER_PARTS, Space
from model.finger import Grid

_PART_SHARE = 0.5  # deviation of each part of a finger, in that of the whole
_NOISE, _FLOOR = 0.01, 0.1
"""Largest noise of a reading relative to its size, and its floor relative to the sensors' rms."""

_MIN_VARIANCE = 1e-14  # of the largest
_INSIDE = 0.1  # standard deviations from a bound, of a start
_NOISE_PATTERNS = 60  # of which the noise is estimated
_FIRST_NOISE = 8.0  # numbers for which the first noise counts
_MIN_NOISE = 0.3  # relative to the largest

WINDOW: Final = 8
_UNLIKELY_TOGETHER, _UNLIKELY_ALONE, _UNLIKELY_REST = 1e-7, 1e-6, 1e-2
_ALONG_REST = 8.0  # without the pattern that deviates most
_ALONG = 22.0  # squared standard deviations, of a hundred directions in some thousand patterns
_REFERENCE = 0.4  # of nis / count: a change adds more, without one there is less most of the time
PLACES: Final = Grid(9, 7)
"""Cells in whose middles masses are looked for."""

_KINDS = ("stiffness", "gain", "phase", "thickness")

_SPRING, _THICKNESS, _GAIN, _PHASE = 0.3, 0.05, 0.3, 0.5  # of logarithms, and radians
_MASS = 5e-3
_COST_OF_CHANGE = 4.0
_UNLIKELY = 1e-4
_STARTS = 3
_FIRST_EVALUATIONS, _EVALUATIONS = 10, 40
BY_MASS = "a mass"
_WITHIN_REACH = 300.0  # of the least cost
_FOLLOWED = 3  # of the least cost after the first evaluations


@dataclass(frozen=True, eq=False)
class SettledPattern:
    """A tone that has settled, as it was played and measured."""

    time: float
    """Time of the measurement [s]."""
    frequency: float
    """Frequency of the tone [Hz]."""
    bases: ComplexArray
    """Amplitude of each ERA's base as commanded (n,) [m]."""
    values: ComplexArray
    """Acceleration at each sensor (s,) [m/s²], phases as exp(+i omega t)."""
    fingers: tuple[RestingFinger, ...] = ()
    """Fingers on the plate, as far as they are known."""
    has_phase: bool = True
    """Whether phases of values count from those of bases; otherwise one phase, common to all
    sensors, is unknown, and no update depends on it."""

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
    own = _PART_SHARE**2 * np.eye(parts) + np.ones((parts, parts))
    return np.asarray(np.kron(np.eye(finger_count(patterns) // parts), own), dtype=float)


@dataclass(frozen=True, eq=False)
class PatternModel:
    """The plate of a forward model under the fingers of one pattern."""

    pattern: SettledPattern
    space: Space
    """Space of the model without the fingers."""
    forward: ForwardModel
    """The model with the fingers."""
    noise: float = 1.0
    """Noise of the pattern's readings, relative to the largest."""

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


@dataclass(frozen=True, eq=False)
class State:
    """Parameters of a plate as known at a time."""

    x: FloatArray
    """Parameters (p,)."""
    covariance: FloatArray
    """Covariance (p, p) of x."""


@dataclass(frozen=True, eq=False)
class StateUpdate:
    """A state after some patterns."""

    state: State
    nis: float
    """Normalised innovation squared before the update."""
    count: int
    """Number of real numbers in the innovation."""
    cost: float
    """Squared residuals and changes after the update, in standard deviations."""
    misfit: float
    """Squared residuals alone."""
    freedom: float
    """Number of residuals that plate and fingers do not take up."""
    fingers: FloatArray
    """Parameters of all fingers (q,)."""
    innovation: FloatArray
    """Innovation (count,) with the slopes where the update ended."""
    slopes: FloatArray
    """Derivatives of the numbers by the plate there (count, p)."""
    precision: FloatArray
    """Inverse covariance of the innovation, the theory's errors included (count, count)."""


def update(
    before: State,
    patterns: Sequence[PatternModel],
    *,
    evaluations: int,
    start: FloatArray | None = None,
    theory: FloatArray | None = None,
) -> StateUpdate:
    """Find the most likely state after patterns, within its bounds.

    evaluations: largest number of those of the model; start: of the plate (p,), or of plate and
    fingers (p + q,), by default the state before; theory (p,): variances of the theory's errors,
    which count only in the likelihood of the innovation.
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
    rows = (axes / np.sqrt(np.maximum(variance, _MIN_VARIANCE * variance.max()))).T
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
        self._recent: deque[tuple[float, float]] = deque(maxlen=_NOISE_PATTERNS)
        self.relative = 1.0

    def take(self, updated: StateUpdate) -> None:
        """Take what an update by a pattern of this noise has left of it."""
        self._recent.append((self.relative**2 * updated.misfit, updated.freedom))
        misfit, freedom = np.array(self._recent).sum(axis=0) + _FIRST_NOISE
        self.relative = float(np.clip(np.sqrt(misfit / freedom), _MIN_NOISE, 1.0))


@dataclass(frozen=True, eq=False)
class Observation:
    """A pattern with the state before it and its innovation, along d directions of change."""

    model: PatternModel
    before: State
    time: float | None
    """When that state was updated [s]."""
    nis: float
    count: int
    slopes: FloatArray
    """Slope of half the squared innovation by each direction (d,)."""
    curvatures: FloatArray
    """Curvature of the same (d,)."""
    masses: int
    """Number of the last directions, masses, which can only grow."""

    @classmethod
    def of(
        cls,
        model: PatternModel,
        before: State,
        time: float | None,
        found: StateUpdate,
        at: FloatArray,
    ) -> "Observation":
        """Make it of a pattern and its update; at (m, 2) [m]: places of masses."""
        space = model.space
        own = np.flatnonzero(space.of(*_KINDS))
        plate = model.forward.at(np.concatenate([found.state.x, found.fingers]))
        masses = model.by_mass_at(plate, at)
        columns = np.hstack([found.slopes[:, own], masses])
        slopes = columns.T @ (found.precision @ found.innovation)
        curvatures = (columns * (found.precision @ columns)).sum(axis=0)
        return cls(model, before, time, found.nis, found.count, slopes, curvatures, masses.shape[1])


class Alarm:
    """The last patterns of a plate, tested for being those of the plate as known.

    chi² is computed with `scipy.special`: `scipy.stats` takes a second to load.
    """

    def __init__(self) -> None:
        self._recent: deque[Observation] = deque(maxlen=WINDOW)

    @property
    def is_full(self) -> bool:
        """Whether a whole window of patterns has come without an alarm."""
        return len(self._recent) == WINDOW

    def clear(self) -> None:
        """Discard the patterns."""
        self._recent.clear()

    def take(self, observation: Observation) -> list[Observation] | None:
        """Take a pattern; return the last patterns since the plate changed, None if it did not."""
        self._recent.append(observation)
        last = list(self._recent)[::-1]
        along, confirmed = self._along(last)
        if confirmed.max() > _ALONG:
            return last[: best_of(along) + 1][::-1]
        squares = np.cumsum([each.nis for each in last])
        numbers = np.cumsum([each.count for each in last])
        largest = np.maximum.accumulate([each.nis for each in last])
        unlikely = chdtrc(numbers, squares) < _UNLIKELY_TOGETHER
        rest = (
            chdtrc(np.maximum(numbers - observation.count, 1), squares - largest) < _UNLIKELY_REST
        )
        if np.any(unlikely & rest):
            return last[: best_of(squares - _REFERENCE * numbers) + 1][::-1]
        return None

    @property
    def is_odd(self) -> bool:
        """Whether the last pattern is unlikely on its own, as under a finger unlike any other."""
        last = self._recent[-1]
        is_unlikely = chdtrc(last.count, last.nis) < _UNLIKELY_ALONE
        return bool(
            is_unlikely or _squares(last.slopes, last.curvatures, last.masses).max() > _ALONG
        )

    @staticmethod
    def _along(last: list[Observation]) -> tuple[FloatArray, FloatArray]:
        """Largest squared deviation along a direction, by the number of last patterns.

        The second is that of directions along which the others deviate without any one pattern.
        """
        slopes = np.array([each.slopes for each in last])
        curvatures = np.array([each.curvatures for each in last])
        masses, along, confirmed = last[0].masses, np.zeros(len(last)), np.zeros(len(last))
        for number in range(len(last)):
            own, weights = slopes[: number + 1], curvatures[: number + 1]
            total, weight = own.sum(axis=0), weights.sum(axis=0)
            rest = _squares(total - own, weight - weights, masses).min(axis=0)
            squares = _squares(total, weight, masses)
            along[number] = squares.max()
            confirmed[number] = np.where(rest > _ALONG_REST, squares, 0.0).max()
        return along, confirmed


def _squares(slopes: FloatArray, curvatures: FloatArray, masses: int) -> FloatArray:
    """Squared deviations along directions (..., d), of which the last can only be upwards."""
    up = slopes.copy()
    first = slopes.shape[-1] - masses
    up[..., first:] = np.maximum(up[..., first:], 0.0)
    return np.divide(up**2, curvatures, out=np.zeros_like(up), where=curvatures > 1e-12)


@dataclass(frozen=True, eq=False)
class PlateChange:
    """Explanation of some patterns by one change of the plate."""

    name: str
    """Name of the change, "" if none explains them."""
    change: float
    """Size of the change: of a mass in kg, of others the logarithm of a factor."""
    lead: float
    """Further cost of the next best explanation."""
    state: State
    """State of the plate after the change."""
    resembles: str = ""
    """Name of the change that explains most, though not enough."""

    def __str__(self) -> str:
        if self.name == BY_MASS:
            return f"{self.name} by {1000 * self.change:+.3g} g"
        if self.name:
            return f"{self.name} by {100 * np.expm1(self.change):+.2g} %"
        return f"the plate has changed, most as if {self.resembles} had"


def explain(before: State, patterns: Sequence[PatternModel]) -> PlateChange:
    """Find the one change that explains patterns, from the state before it."""
    tried = [
        (each, update(each.prior, patterns, evaluations=_FIRST_EVALUATIONS, start=start))
        for each in _hypotheses(before, patterns)
        for start in each.starts
    ]
    tried = ranked_by(tried, _likelihood)
    followed = set(list(dict.fromkeys(each.name for each, _ in tried))[:_FOLLOWED])
    least = _likelihood(tried[0]) - _WITHIN_REACH
    for number, (supposed, after) in enumerate(tried):
        if supposed.name not in followed or _likelihood((supposed, after)) < least:
            continue
        followed.remove(supposed.name)
        x = np.concatenate([after.state.x, after.fingers])
        after = update(supposed.prior, patterns, evaluations=_EVALUATIONS, start=x)
        tried[number] = supposed, after
    best, *others = ranked_by(tried, _likelihood)
    (supposed, after), likelihood = best, _likelihood(best)
    rivals = [_likelihood(each) for each in others if each[0].name != supposed.name]
    if chdtrc(after.count, -likelihood) < _UNLIKELY:
        return PlateChange("", 0.0, 0.0, before, resembles=supposed.name)
    index = supposed.changed[0]
    change = float(patterns[0].space.std[index] * (after.state.x[index] - before.x[index]))
    return PlateChange(supposed.name, change, likelihood - max(rivals), after.state)


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A change that may have happened."""

    name: str
    changed: tuple[int, ...]
    """Numbers of the changed parameters."""
    prior: State
    """State before the patterns if it has."""
    starts: Sequence[FloatArray | None] = (None,)
    """Starts of the first estimates, None for the state before."""


def _likelihood(tried: tuple[_Hypothesis, StateUpdate]) -> float:
    """Less the cost of residuals and changes after an update, and of supposing a change."""
    supposed, after = tried
    return -(after.cost + _COST_OF_CHANGE * len(supposed.changed))


def _hypotheses(before: State, patterns: Sequence[PatternModel]) -> Iterator[_Hypothesis]:
    """All that may have changed; a mass where it would explain most."""
    space = patterns[0].space
    kinds = [(space.names[n], {n: _SPRING}) for n in space.indices("stiffness")]
    for gain, phase in zip(space.indices("gain"), space.indices("phase"), strict=True):
        kinds.append((space.names[gain], {gain: _GAIN, phase: _PHASE}))
    kinds.append(("thickness", {space.groups["thickness"].start: _THICKNESS}))
    for name, changed in kinds:
        if all(space.std[n] > 0 for n in changed):
            yield _Hypothesis(name, (*changed,), _widened(before, space, changed))
    yield _by_mass(before, patterns)


def _widened(before: State, space: Space, changed: dict[int, float]) -> State:
    """The state with further deviations of some parameters, in their units."""
    covariance = before.covariance.copy()
    for number, std in changed.items():
        covariance[number, number] += (std / space.std[number]) ** 2
    return State(before.x, covariance)


def _by_mass(before: State, patterns: Sequence[PatternModel]) -> _Hypothesis:
    space, plate = patterns[0].space, patterns[0].forward.rig.plate
    sides, mass = np.array([plate.length, plate.width]), space.groups["masses"].stop - 3
    changed = {mass: _MASS, mass + 1: sides[0] / 3, mass + 2: sides[1] / 3}
    starts = []
    for size, place in _scan(before, patterns)[:_STARTS]:
        start = before.x.copy()
        start[mass] = size / space.std[mass]
        start[mass + 1 : mass + 3] = (place - sides / 2) / space.std[mass + 1 : mass + 3]
        starts.append(start)
    prior = _widened(before, space, changed)
    return _Hypothesis(BY_MASS, (*changed,), prior, starts)


def _scan(before: State, patterns: Sequence[PatternModel]) -> list[tuple[float, FloatArray]]:
    """Masses [kg] and their places [m] that would explain most, best first, all else linear."""
    points = PLACES.centres(patterns[0].forward.rig.plate)
    slope, curvature = np.zeros(len(points)), np.zeros(len(points))
    for each in patterns:
        fingers = np.zeros(each.forward.space.size - len(before.x))
        predicted, H = each.predicted(before.x, fingers)
        P = linalg.block_diag(before.covariance, finger_covariance([each.pattern]))
        S = H @ P @ H.T + np.diag(each.std**2)
        at = each.forward.at(np.concatenate([before.x, fingers]))
        column = each.by_mass_at(at, points)
        weighted = linalg.solve(S, column, assume_a="pos")
        slope += (each.pattern.numbers - predicted) @ weighted
        curvature += (column * weighted).sum(axis=0)
    return [(size, points[n]) for n, size in single_changes(slope, curvature, _MASS)]
