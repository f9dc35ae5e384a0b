"""What may have happened to a plate at once.

One spring, one gain, the thickness, a mass, a hand that stays or a crack: each is a wide prior of
the parameters that would have changed, those of a hand and a crack beside the plate's
(`model.identification.alterations`). The most likely one is that whose batch estimate over the last
patterns costs least, a further cost for each parameter that changed; where even that leaves
residuals that chance does not, the plate has changed in a way not known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import FloatArray
from model.choice import ranked_by
from model.identification.alarm import PLACES
from model.identification.alterations import Alteration, Altered, Crack, Hand, scores
from model.identification.derivatives import by_mass_at
from model.identification.least_squares import single_changes
from model.identification.parameters import Space
from model.identification.settled import Touched, finger_covariance
from model.identification.settled_update import State, Updated, update

_SPRING, _THICKNESS, _GAIN, _PHASE = 0.3, 0.05, 0.3, 0.5  # of logarithms, and radians
_MASS = 5e-3
_COST_OF_CHANGE = 4.0
_UNLIKELY, _FAR_AHEAD, _ROUGHLY = 1e-4, 25.0, 4.0
_STARTS, _ALTERED_STARTS = 3, 2
_ALTERATIONS: tuple[Alteration, ...] = (Hand(), Crack())
_FIRST_EVALUATIONS, _ALTERED_EVALUATIONS, _EVALUATIONS = 10, 15, 40
BY_MASS = "a mass"
_WITHIN_REACH = 300.0  # of the least cost
_FOLLOWED = 3  # of the least cost after the first evaluations


@dataclass(frozen=True, eq=False)
class Explanation:
    """What explains some patterns: its name, "" for nothing known, and the state it leads to.

    change: of the parameter, a mass in kg, others as the logarithm of a factor; lead: by how much
    the next best costs more; resembles: what explains most of it, though not enough; found: of a
    hand or a crack, where it is and how large. No parameter of a plate stands for these, and the
    state is that before.
    """

    name: str
    change: float
    lead: float
    state: State
    resembles: str = ""
    found: str = ""

    @property
    def can_be_followed(self) -> bool:
        """Whether the state has taken up the change."""
        return bool(self.name) and not self.found

    @property
    def amount(self) -> str:
        """The change with its unit."""
        if self.name == BY_MASS:
            return f"{1000 * self.change:+.3g} g"
        return f"{100 * np.expm1(self.change):+.2g} %"

    def __str__(self) -> str:
        if self.found:
            return f"{self.name}, {self.found}"
        if self.name:
            return f"{self.name} by {self.amount}"
        return f"the plate has changed, most as if {self.resembles} had"


def explain(before: State, patterns: Sequence[Touched]) -> Explanation:
    """Find the one change that explains patterns, from the state before it."""
    space = patterns[0].space
    tried = [
        _Tried(name, changed, wider, update(wider, patterns, evaluations=_FIRST_EVALUATIONS))
        for name, changed in _kinds(space)
        for wider in [_widened(before, space, changed)]
    ]
    tried += _by_mass(before, patterns)
    for alteration in _ALTERATIONS:
        tried += _by_alteration(before, patterns, alteration)
    tried = ranked_by(tried, lambda each: -each.cost)
    names = list(dict.fromkeys(each.name for each in tried))
    # Hands and cracks may still be far from their least cost.
    followed = {*names[:_FOLLOWED], *(each.name for each in _ALTERATIONS)}
    within = tried[0].cost + _WITHIN_REACH
    for number, each in enumerate(tried):
        if each.name not in followed or each.cost > within:
            continue
        followed.remove(each.name)
        x = np.concatenate([each.after.state.x, each.after.fingers])
        measured = each.altered or patterns
        after = update(each.prior, measured, evaluations=_EVALUATIONS, start=x)
        tried[number] = replace(each, after=after)
    tried = ranked_by(tried, lambda each: -each.cost)
    best = tried[0]
    others = [each.cost for each in tried if each.name != best.name]
    lead = min(others) - best.cost
    # What a crack leaves is the error of its model, which is of the first order.
    is_rough = best.is_coarse and lead > _FAR_AHEAD and best.cost < _ROUGHLY * best.after.count
    if not is_rough and chdtrc(best.after.count, best.cost) < _UNLIKELY:
        return Explanation("", 0.0, 0.0, before, resembles=best.name)
    if best.altered:
        theta = best.after.state.x[len(before.x) :]
        first = best.altered[0]
        x, y = 100 * first.place(theta)
        what = f"{first.alteration.described(theta[2:])} at {x:.1f}, {y:.1f} cm"
        return Explanation(best.name, float(theta[2]), lead, before, found=what)
    index = next(iter(best.changed))
    change = float(space.std[index] * (best.after.state.x[index] - before.x[index]))
    return Explanation(best.name, change, lead, best.after.state)


@dataclass(frozen=True, eq=False)
class _Tried:
    """One hypothesis: name, what changes by which deviation, its prior, and what it leads to.

    altered: the patterns with a hand or a crack, none for a change of the plate's parameters.
    """

    name: str
    changed: dict[int, float]
    prior: State
    after: Updated
    altered: tuple[Altered, ...] = ()

    @property
    def is_coarse(self) -> bool:
        """Whether its model is known to leave something."""
        return bool(self.altered) and self.altered[0].alteration.is_of_modes

    @property
    def cost(self) -> float:
        """Of residuals and changes, and of supposing a change."""
        return self.after.cost + _COST_OF_CHANGE * len(self.changed)


def _kinds(space: Space) -> list[tuple[str, dict[int, float]]]:
    """Names, and by number of the parameters that change their standard deviations."""
    kinds = [(space.names[n], {n: _SPRING}) for n in space.indices("stiffness")]
    for gain, phase in zip(space.indices("gain"), space.indices("phase"), strict=True):
        kinds.append((space.names[gain], {gain: _GAIN, phase: _PHASE}))
    kinds.append(("thickness", {space.groups["thickness"].start: _THICKNESS}))
    return [kind for kind in kinds if all(space.std[n] > 0 for n in kind[1])]


def _widened(before: State, space: Space, changed: dict[int, float]) -> State:
    covariance = before.covariance.copy()
    for number, std in changed.items():
        covariance[number, number] += (std / space.std[number]) ** 2
    return State(before.x, covariance)


def _by_mass(before: State, patterns: Sequence[Touched]) -> list[_Tried]:
    """Batch estimates with a mass, from the places where it would explain most."""
    space, sides = patterns[0].space, _sides(patterns)
    mass = space.groups["masses"].stop - 3
    changed = {mass: _MASS, mass + 1: sides[0] / 3, mass + 2: sides[1] / 3}
    wider = _widened(before, space, changed)
    found = []
    for size, place in _scan(before, patterns, None, _MASS)[:_STARTS]:
        start = before.x.copy()
        start[mass] = size / space.std[mass]
        start[mass + 1 : mass + 3] = (place - sides / 2) / space.std[mass + 1 : mass + 3]
        after = update(wider, patterns, evaluations=_FIRST_EVALUATIONS, start=start)
        found.append(_Tried(BY_MASS, changed, wider, after))
    return found


def _by_alteration(
    before: State, patterns: Sequence[Touched], alteration: Alteration
) -> list[_Tried]:
    """Batch estimates with a hand or a crack, from the places where it would explain most."""
    altered = tuple(Altered.by(alteration, each) for each in patterns)
    p, e = len(before.x), alteration.size
    x = np.concatenate([before.x, np.zeros(e)])
    wider = State(x, linalg.block_diag(before.covariance, np.eye(e)))
    changed = {p + number: 1.0 for number in range(e)}
    found = []
    for size, place in _scan(before, patterns, alteration, 1.0)[:_ALTERED_STARTS]:
        theta = altered[0].parameters(place, alteration.start(size))
        start = np.concatenate([before.x, theta])
        after = update(wider, altered, evaluations=_ALTERED_EVALUATIONS, start=start)
        found.append(_Tried(alteration.name, changed, wider, after, altered))
    return found


def _scan(
    before: State, patterns: Sequence[Touched], alteration: Alteration | None, std: float
) -> list[tuple[float, FloatArray]]:
    """Sizes and places [m] of an alteration that would explain most, best first, all else linear.

    None: a mass [kg]; std: of sizes.
    """
    points = PLACES.centres(patterns[0].touched.rig.plate)
    slope, curvature = np.zeros(len(points)), np.zeros(len(points))
    for each in patterns:
        fingers = np.zeros(each.touched.space.size - len(before.x))
        predicted, H = each.predicted(before.x, fingers)
        P = linalg.block_diag(before.covariance, finger_covariance([each.pattern]))
        S = H @ P @ H.T + np.diag(each.std**2)
        at = each.touched.at(np.concatenate([before.x, fingers]))
        if alteration is None:
            bases = each.pattern.bases
            columns = np.einsum("snp,n->sp", by_mass_at(at, points)[0], bases)
            _, column = each.as_numbers(at.responses[0] @ bases, columns)
        else:
            column = scores(each, at, alteration, points)
        weighted = linalg.solve(S, column, assume_a="pos")
        slope += (each.pattern.numbers - predicted) @ weighted
        curvature += (column * weighted).sum(axis=0)
    return [(size, points[n]) for n, size in single_changes(slope, curvature, std)]


def _sides(patterns: Sequence[Touched]) -> FloatArray:
    plate = patterns[0].touched.rig.plate
    return np.array([plate.length, plate.width])
