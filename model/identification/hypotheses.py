"""What may have happened to a plate at once.

One spring, one gain, the thickness or a mass: each is a wide prior of the parameters that would
have changed. The most likely one is that whose batch estimate over the last patterns costs least, a
further cost for each parameter that changed; where even that leaves residuals that chance does not,
the plate has changed in a way not known.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import FloatArray
from model.choice import ranked_by
from model.identification.alarm import PLACES
from model.identification.least_squares import single_changes
from model.identification.parameters import Space
from model.identification.settled import PatternModel, State, StateUpdate, finger_covariance, update

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
class PlateChange:
    """What explains some patterns: its name, "" for nothing known, and the state it leads to.

    change: of the parameter, a mass in kg, others as the logarithm of a factor; lead: by how much
    the next best costs more; resembles: what explains most of it, though not enough.
    """

    name: str
    change: float
    lead: float
    state: State
    resembles: str = ""

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
    """What may have changed: name, numbers of the parameters, and their prior.

    starts: of the first estimates; None: the state before.
    """

    name: str
    changed: tuple[int, ...]
    prior: State
    starts: Sequence[FloatArray | None] = (None,)


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
