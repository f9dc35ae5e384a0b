"""A plate that settled patterns follow while it is driven.

The parameters of an identification drift. Each settled pattern updates them, together with the
loads of its fingers, which are dropped afterwards: the one fit, with what was known before as its
prior. The noise of readings follows from what updates leave.

An alarm means that some of the last innovations are unlikely together, or along one change: a
spring, a gain, the thickness, or a mass in one of many places. The latter is a generalised
likelihood ratio test, which finds what fingers and noise hide in the sum (M. Basseville, I. V.
Nikiforov, Detection of Abrupt Changes, 1993, section 2.4.3). One pattern alone raises no alarm,
since a finger may be unlike any other, but it does not update the plate either.

An update would smear a sudden change over all parameters. So after an alarm what is known goes back
to where the odd patterns began and is held, until one change explains the patterns since then:
a hypothesis is a wide prior of the parameters that would have changed. The most likely one costs
least in a fit of the held patterns, plus a cost for each changed parameter, and is followed. Where
it still leaves residuals beyond chance, as for a crack or a hand that rests on the plate, the plate
counts as changed until patterns fit it again as it was: its table is that of the plate as last
known, with the errors of one that was not measured.

An object of 10 g or more, such as a cup, is such a change as well, whose place and mass are found.
It is sought where forces of any size and phase at each tone explain most, which holds for a load of
any kind, and fitted as a mass on a contact spring. Its residuals are not held against it, since a
cup is no point. The plate is as known before, so that its table has that mass in its uncertainty.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final, Self

import numpy as np
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import ComplexArray, FloatArray, best_by, best_of, ranked_by
from model.estimate.fit import Fit, best_gains, fit
from model.estimate.forward import (
    FINGER_PARTS,
    MODE_SHIFTS,
    ForwardModel,
    PlateValues,
    Prior,
    RestingFinger,
    Sensor,
    by_mass_at,
)
from model.estimate.identify import solved_for
from model.estimate.measurement import Measurement
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.space import rig_with, space_of
from model.finger import Grid
from model.rig.rig import BOUNDS, Rig, Uncertainty
from model.structure.attachments import object_load
from model.structure.modal_elasticity import lowest_elastic

_NOISE, _FLOOR = 0.01, 0.1
"""Largest noise of a reading relative to its size, and its floor relative to the sensors' rms."""

_PART_SHARE = 0.5  # deviation of each part of a finger, in that of the whole
_ONLY_PHASE = 1e-6  # deviation of a gain whose phase alone is free
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
_EVALUATIONS, _FIRST_EVALUATIONS, _LAST_EVALUATIONS = 20, 10, 40  # of an update, of hypotheses
BY_MASS = "a mass"
_WITHIN_REACH = 300.0  # of the least cost
_OF_MASS = -2  # of the last load
_FOLLOWED = 3  # of the least cost after the first evaluations

_MIN_EXPLAINED, _MAX_EXPLAINED = 4, 6  # patterns that are explained together
_AFTER_ALARM = 2  # patterns before a change counts as unexplained
_CERTAIN = 12.0  # lead in cost of an explanation that is accepted early

_NOT_STATED = (
    "modulus",
    "damping_each",
    "loss_exponent",
    "bolt_mass",
    "place",
    "mode_shifts",
    "mode_losses",
)
"""Kinds whose uncertainty a rig does not state."""

OBJECT = "an object"
_LEAST_OBJECT = 0.01  # kg; what is lighter is followed as a mass where it explains all
_OBJECT_STARTS = ((0.02, 0.005), (0.02, 0.05), (0.1, 0.005), (0.1, 0.05))
"""Masses [kg] from which to search, each with one by whose contact's damping."""
_PLACE_STEPS = (0.01, 0.005)  # m; by which the place of an object is refined
_OBJECT_STD = (0.0, 0.5, 1.0, 0.0)  # of the logarithms of contact stiffness and mass
_OBJECT_COST = 3 * _COST_OF_CHANGE  # of its mass and of its place
_OBJECT_PLACES: Final = Grid(18, 14)
"""Cells in whose middles objects are looked for."""


@dataclass(frozen=True, eq=False)
class SettledPattern:
    """Tones that have settled under the same fingers, as they were played and measured."""

    time: float
    """Time of the measurement [s]."""
    frequencies: FloatArray
    """Frequency of each tone (k,) [Hz]."""
    bases: ComplexArray
    """Amplitude of each ERA's base as commanded (k, n) [m]."""
    values: ComplexArray
    """Acceleration at each sensor (k, s) [m/s²], phases as exp(+i omega t)."""
    fingers: tuple[RestingFinger, ...] = ()
    """Fingers on the plate, as far as they are known."""
    has_phase: bool = True
    """Whether phases of values count from those of bases; otherwise one phase of each tone, common
    to all sensors, is unknown, and no update depends on it."""
    noise: float = 1.0
    """Noise of the reading, relative to the largest."""

    @property
    def std(self) -> FloatArray:
        """Error of the real and of the imaginary part of each value (k, s)."""
        squares = np.abs(self.values) ** 2
        mean = squares.mean(axis=-1, keepdims=True)
        return np.asarray(self.noise * _NOISE * np.sqrt(squares + _FLOOR**2 * mean))


@dataclass(frozen=True, eq=False)
class PlateEstimate:
    """What is known of a plate in service at a time."""

    model: ForwardModel
    """Forward model of the rig that parameters count from, with a spare mass."""
    x: FloatArray
    """Parameters (p,)."""
    covariance: FloatArray
    """Covariance (p, p) of x."""
    time: float | None = None
    """When it was updated [s], since which it has drifted; None before the first pattern."""
    why_off: str = ""
    """Why patterns only raise alarms, "" where they update what is known."""
    change: str = ""
    """How it has changed in a way that its parameters do not follow, "" where it has not."""
    lying: tuple[float, float, float] | None = None
    """Place x, y [m] and mass [kg] of an object that lies on it, where that is the change."""

    @property
    def rig(self) -> Rig:
        """The rig as it is known now."""
        before = self.model.rig
        return rig_with(before, PlateValues(before, self.model.space, self.x), before.uncertainty)

    @property
    def cautious_rig(self) -> Rig:
        """The rig as last known, with an object on it or the errors of one never measured."""
        uncertainty = self.model.rig.uncertainty
        if self.lying is None:
            return replace(self.rig, uncertainty=widest(uncertainty))
        mass = min(max(uncertainty.foreign_mass, self.lying[2]), BOUNDS["foreign_mass"][1])
        return replace(self.rig, uncertainty=replace(uncertainty, foreign_mass=mass))

    @classmethod
    def of_rig(cls, rig: Rig, sensors: Sequence[Sensor]) -> Self:
        """Start from a rig's `uncertainty`; gains of the sensors are not known.

        What the rig does not state counts as known as well as its thickness, as by identification.
        """
        free = solved_for(rig, rig.limits.frequency_max)
        # Counted in the deviations of a plate that was not measured, which steps are limited by.
        count = len(lowest_elastic(free.modes.eigenvalues, MODE_SHIFTS))
        space, stated = (
            space_of(rig, [each.name for each in sensors], known, masses=1, mode_count=count)
            for known in (widest(rig.uncertainty), rig.uncertainty)
        )
        model = ForwardModel(rig, sensors, np.array([rig.limits.frequency_max]), space, free)
        std = np.divide(stated.std, space.std, out=np.zeros(space.size), where=space.uncertain)
        std[space.of(*_NOT_STATED)] = std[space.index("thickness")]
        std[space.groups["masses"]] = 0.0
        return cls(model, np.zeros(space.size), np.diag(std**2))

    @property
    def unchanged(self) -> Self:
        """The same plate, once it is again as it was."""
        return replace(self, change="", lying=None)

    def at(self, time: float) -> Self:
        """Return it for a later time [s], less certain by the drift since its last update."""
        space = self.model.space
        hours = 0.0 if self.time is None else max(time - self.time, 0.0) / 3600
        drift, limits = (
            (space.of_kinds(of) / space.scale) ** 2
            for of in (lambda kind: kind.drift, lambda kind: kind.widest)
        )
        room = np.maximum(limits - np.diag(self.covariance), 0.0)
        further = np.diag(np.minimum(drift * hours, room))
        return replace(self, covariance=self.covariance + further)


def widest(uncertainty: Uncertainty) -> Uncertainty:
    """The larger of each standard deviation and that of a plate that was not measured."""
    names, built = [each.name for each in fields(Uncertainty)], Uncertainty()
    return Uncertainty(
        **{name: max(getattr(uncertainty, name), getattr(built, name)) for name in names}
    )


@dataclass(frozen=True, eq=False)
class PlateUpdate:
    """A plate after some patterns, with the innovation in standard deviations."""

    before: PlateEstimate
    """What was known before them."""
    patterns: Sequence[SettledPattern]
    known: PlateEstimate
    """What is known after them."""
    fit: Fit
    """Fit of plate and fingers."""
    innovation: FloatArray
    """Innovation (m,) with the slopes where the update ended."""
    precision: FloatArray
    """Inverse covariance of the innovation, the theory's errors included (m, m)."""
    freedom: float
    """Number of residuals that plate and fingers do not take up."""

    @property
    def nis(self) -> float:
        """Normalised innovation squared."""
        return float(self.innovation @ self.precision @ self.innovation)

    @property
    def misfit(self) -> float:
        """Squared residuals after the update."""
        left, _ = self.fit.of_values
        return float(left @ left)

    @cached_property
    def directions(self) -> tuple[FloatArray, FloatArray, int]:
        """Slopes (d,) and curvatures (d,) of half the nis by directions of change.

        The last directions are masses, which can only grow: their number is returned, too.
        """
        best, points = self.fit, PLACES.centres(self.fit.model.rig.plate)
        driven = best.measurement.driven
        by_mass = driven(by_mass_at(best.plate, points))
        _, _, _, masses = best_gains(driven(best.plate.responses), by_mass, best.measurement)
        kinds = best.space.of(*_KINDS)[best.searched]
        columns = np.hstack([best.of_values[1][:, kinds], np.vstack([masses.real, masses.imag])])
        weighted = self.precision @ columns
        return weighted.T @ self.innovation, (columns * weighted).sum(axis=0), len(points)

    def explained_at(self, points: FloatArray) -> FloatArray:
        """Squared deviations that a force at each point (p, 2) explains (p,).

        It may have any size and phase at each tone, as that of a load of any kind.
        """
        best, tones = self.fit, len(self.fit.model.frequencies)
        driven = best.measurement.driven
        forces = driven(by_mass_at(best.plate, points))
        forces = np.concatenate([forces, 1j * forces], axis=-1)
        _, _, _, slopes = best_gains(driven(best.plate.responses), forces, best.measurement)
        of_tone = np.repeat(np.eye(tones), len(slopes) // tones, axis=0)
        columns = np.vstack([slopes.real, slopes.imag]).reshape(2 * len(slopes), 2, -1)
        columns = np.einsum("mt,map->pmta", np.vstack([of_tone, of_tone]), columns)
        columns = columns.reshape(*columns.shape[:2], -1)
        weighted = self.precision @ columns
        along, curvature = (
            weighted.swapaxes(1, 2) @ self.innovation,
            columns.swapaxes(1, 2) @ weighted,
        )
        curvature += 1e-9 * np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(2 * tones)
        return np.asarray(
            (along * np.linalg.solve(curvature, along[..., None])[..., 0]).sum(axis=1)
        )


def update(
    before: PlateEstimate,
    patterns: Sequence[SettledPattern],
    *,
    evaluations: int = _EVALUATIONS,
    start: FloatArray | None = None,
    theory: FloatArray | None = None,
    lying: Sequence[RestingFinger] = (),
) -> PlateUpdate:
    """Find the most likely plate after patterns, within its bounds.

    evaluations: of the model, at most; start: of the plate (p,), or of plate and fingers, by
    default what was known before; theory (p,): variances of the theory's errors, which count only
    in the likelihood of the innovation; lying: objects that lie there during all patterns.
    """
    model = before.model
    of_tone = np.repeat(np.arange(len(patterns)), [len(each.frequencies) for each in patterns])
    fingers = [
        replace(finger, tones=tuple(np.flatnonzero(of_tone == number).tolist()))
        for number, each in enumerate(patterns)
        for finger in each.fingers
    ]
    count, fingers = len(fingers), [*fingers, *lying]
    parts, p = len(FINGER_PARTS), len(before.x)
    names = [f"finger part {number}" for number in range(parts * len(fingers))]
    whole = replace(
        model,
        frequencies=np.concatenate([each.frequencies for each in patterns]),
        fingers=fingers,
        space=model.space.extended(
            PARAMETER_KINDS["fingers"], names, Prior(PARAMETER_KINDS["fingers"].std)
        ),
        last_places={},
    )
    measurement = Measurement(
        model.sensors,
        np.arange(len(of_tone), dtype=float),
        np.concatenate([each.values for each in patterns])[..., None],
        np.concatenate([each.std for each in patterns])[..., None],
        gain_std=0.0 if patterns[0].has_phase else _ONLY_PHASE,
        bases=np.concatenate([each.bases for each in patterns]),
    )
    # A finger loads a plate more or less as a whole, and each of its parts differs half as much
    # beside that: with parts that varied on their own a heavy finger would be as unlikely as four.
    of_finger = _PART_SHARE**2 * np.eye(parts) + np.ones((parts, parts))
    of_object = np.diag(_OBJECT_STD) ** 2
    blocks = [of_finger] * count + [of_object] * len(lying)
    P = linalg.block_diag(before.covariance, *blocks)
    mean = np.zeros(len(P))
    mean[:p] = before.x
    first = mean.copy()
    if start is not None:
        first[: len(start)] = start
    found = fit(
        whole,
        measurement,
        searched=np.diagonal(P) > 0,
        start=first,
        prior=(mean, P),
        evaluations=evaluations,
        inside=_INSIDE,
    )
    left, slopes = found.of_values
    H = np.zeros((len(left), len(P)))
    H[:, found.searched] = slopes
    inverse = linalg.inv(H @ P @ H.T + np.eye(len(left)))
    covariance = (P - P @ H.T @ inverse @ H @ P)[:p, :p]
    wrong = np.zeros(len(P))
    wrong[:p] = 0.0 if theory is None else theory
    # In the slopes where it ended: those before are wrong for a finger of another load.
    expected = H @ (P @ H.T + wrong[:, None] * H.T) + np.eye(len(left))
    covariance = (covariance + covariance.T) / 2
    return PlateUpdate(
        before,
        patterns,
        replace(before, x=found.x[:p], covariance=covariance, time=patterns[-1].time),
        found,
        H @ (found.x - mean) - left,
        linalg.inv(expected),
        float(np.trace(inverse)),
    )


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

    def take(self, misfit: float, freedom: float) -> None:
        """Take squared residuals that an update of this noise has left, and of how many numbers."""
        self._recent.append((self.relative**2 * misfit, freedom))
        total, numbers = np.array(self._recent).sum(axis=0) + _FIRST_NOISE
        self.relative = float(np.clip(np.sqrt(total / numbers), _MIN_NOISE, 1.0))


class Alarm:
    """The last patterns of a plate, tested for being those of the plate as known.

    chi² is computed with `scipy.special`: `scipy.stats` takes a second to load.
    """

    def __init__(self) -> None:
        self._recent: deque[PlateUpdate] = deque(maxlen=WINDOW)

    @property
    def is_full(self) -> bool:
        """Whether as many tones as a window has patterns have come without an alarm."""
        return _tones([each.patterns[0] for each in self._recent]) >= WINDOW

    @property
    def is_odd(self) -> bool:
        """Whether the last pattern is unlikely on its own, as under a finger unlike any other."""
        last = self._recent[-1]
        along = _squares(*last.directions).max()
        return bool(chdtrc(len(last.innovation), last.nis) < _UNLIKELY_ALONE or along > _ALONG)

    def take(self, update: PlateUpdate) -> list[PlateUpdate] | None:
        """Take a pattern; return the last patterns since the plate changed, None if it did not."""
        self._recent.append(update)
        last = list(self._recent)[::-1]
        masses = last[0].directions[2]
        slopes, weights = (np.array([each.directions[n] for each in last]) for n in (0, 1))
        total, weight = slopes.cumsum(axis=0), weights.cumsum(axis=0)
        along = _squares(total, weight, masses)
        # Directions along which the others deviate without any one pattern.
        rest = _squares(total[:, None] - slopes, weight[:, None] - weights, masses)
        rest[np.triu_indices(len(last), 1)] = np.inf
        if np.where(rest.min(axis=1) > _ALONG_REST, along, 0.0).max() > _ALONG:
            return last[: best_of(along.max(axis=1)) + 1][::-1]
        counts = [len(each.innovation) for each in last]
        squares, numbers = np.cumsum([each.nis for each in last]), np.cumsum(counts)
        rest = squares - np.maximum.accumulate([each.nis for each in last])
        unlikely = chdtrc(numbers, squares) < _UNLIKELY_TOGETHER
        if np.any(unlikely & (chdtrc(np.maximum(numbers - counts[0], 1), rest) < _UNLIKELY_REST)):
            return last[: best_of(squares - _REFERENCE * numbers) + 1][::-1]
        return None


def _tones(patterns: Sequence[SettledPattern]) -> int:
    """Number of tones of patterns."""
    return sum(len(each.frequencies) for each in patterns)


def _squares(slopes: FloatArray, curvatures: FloatArray, masses: int) -> FloatArray:
    """Squared deviations along directions (..., d), of which the last can only be upwards."""
    up = slopes.copy()
    first = slopes.shape[-1] - masses
    up[..., first:] = np.maximum(up[..., first:], 0.0)
    return np.divide(up**2, curvatures, out=np.zeros_like(up), where=curvatures > 1e-12)


@dataclass(frozen=True, eq=False)
class PlateChange:
    """One change of the plate that may have happened, with a fit of patterns that supposes it."""

    name: str
    """Name of the change, "" where none explains the patterns."""
    widened: Mapping[int, float]
    """Deviation by which each changed parameter may have changed, in its unit."""
    after: PlateUpdate
    """The plate after the change."""
    change: float
    """Size of the change: of a mass in kg, of others the logarithm of a factor."""
    lead: float = 0.0
    """Further cost of the next best explanation."""
    resembles: str = ""
    """Name of the change that explains most, though not enough."""
    lying: tuple[RestingFinger, ...] = ()
    """The object that has come, where that is the change."""

    @property
    def likelihood(self) -> float:
        """Less the cost of residuals and changes, and of supposing a change."""
        cost = _COST_OF_CHANGE * len(self.widened) + _OBJECT_COST * len(self.lying)
        return -(2 * self.after.fit.cost + cost)

    @property
    def of_object(self) -> tuple[float, float, float] | None:
        """Place x, y [m] and mass [kg] of the object, None where the change is another."""
        if self.name != OBJECT:
            return None
        (one,) = self.lying
        return one.x, one.y, self.change

    def __str__(self) -> str:
        if self.of_object is not None:
            x, y, mass = self.of_object
            return f"something of about {mass:.1g} kg lies near ({x:.2f}, {y:.2f}) m"
        if self.name == BY_MASS:
            known = self.after.known
            x, y = (known.model.space.std * known.x)[[*self.widened][1:]]  # from the middle
            plate = known.model.rig.plate
            at = f"({x + plate.length / 2:.2f}, {y + plate.width / 2:.2f}) m"
            return f"{self.name} by {1000 * self.change:+.3g} g at {at}"
        if self.name:
            return f"{self.name} by {100 * np.expm1(self.change):+.2g} %"
        return f"the plate has changed, most as if {self.resembles} had"


def explain(known: PlateEstimate, patterns: Sequence[SettledPattern]) -> PlateChange:
    """Find the one change that explains patterns, from the plate as known before it."""

    def supposed(
        name: str,
        widened: Mapping[int, float],
        start: FloatArray | None,
        lying: tuple[RestingFinger, ...],
        evaluations: int,
    ) -> PlateChange:
        std, covariance = known.model.space.std, known.covariance.copy()
        for number, deviation in widened.items():
            covariance[number, number] += (deviation / std[number]) ** 2
        prior = replace(known, covariance=covariance)
        after = update(prior, patterns, evaluations=evaluations, start=start, lying=lying)
        change = [std[n] * (after.known.x[n] - known.x[n]) for n in widened]
        change += [one.fingertip.phalanx_mass * np.exp(after.fit.x[_OF_MASS]) for one in lying]
        return PlateChange(name, widened, after, float(change[0]), lying=lying)

    tried = [supposed(*each, _FIRST_EVALUATIONS) for each in _hypotheses(known, patterns)]
    tried = ranked_by(tried, lambda each: each.likelihood)
    least = tried[0].likelihood - _WITHIN_REACH
    best_of_name = {each.name: number for number, each in reversed([*enumerate(tried)])}
    for number in sorted(best_of_name.values())[:_FOLLOWED]:
        if (each := tried[number]).likelihood >= least:
            start = each.after.fit.x
            tried[number] = supposed(each.name, each.widened, start, each.lying, _LAST_EVALUATIONS)
    best, *others = ranked_by(tried, lambda each: each.likelihood)
    for step in _PLACE_STEPS if best.lying else ():
        (one,) = best.lying
        start, moves = best.after.fit.x, ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step))
        near = [replace(one, x=one.x + x, y=one.y + y) for x, y in moves]
        tried = [supposed(OBJECT, {}, start, (each,), _FIRST_EVALUATIONS) for each in near]
        best = best_by([best, *tried], lambda each: each.likelihood)
    rival = max(each.likelihood for each in others if each.name != best.name)
    best = replace(best, lead=best.likelihood - rival)
    is_whole = chdtrc(len(best.after.innovation), -best.likelihood) >= _UNLIKELY
    # An object's shape is not known, so that it may leave residuals.
    is_object = best.lying and best.change >= _LEAST_OBJECT and best.lead > _CERTAIN
    is_named = is_object if best.lying else is_whole
    return best if is_named else replace(best, name="", resembles=best.name)


def _hypotheses(
    known: PlateEstimate, patterns: Sequence[SettledPattern]
) -> Iterator[tuple[str, Mapping[int, float], FloatArray | None, tuple[RestingFinger, ...]]]:
    """All that may have changed, by name: with what, how far, and where a fit starts.

    A mass starts where it would explain most, and so does an object, which is a load on a contact
    spring and held by nothing. A new kind of change is one more of them.
    """
    space, plate = known.model.space, known.model.rig.plate
    kinds = [(space.names[n], {n: _SPRING}) for n in space.indices("stiffness")]
    for gain, phase in zip(space.indices("gain"), space.indices("phase"), strict=True):
        kinds.append((space.names[gain], {gain: _GAIN, phase: _PHASE}))
    kinds.append(("thickness", {space.groups["thickness"].start: _THICKNESS}))
    for name, changed in kinds:
        if all(space.std[n] > 0 for n in changed):
            yield name, changed, None, ()
    points, mass = PLACES.centres(plate), space.groups["masses"].stop - 3
    own, sides = slice(mass, mass + 3), np.array([plate.length, plate.width])
    unchanged = update(known, patterns, evaluations=1)
    for number, size in unchanged.fit.loads(points, std=_MASS)[:_STARTS]:
        start = known.x.copy()
        start[own] = [size, *(points[number] - sides / 2)] / space.std[own]
        yield BY_MASS, dict(zip(range(mass, mass + 3), [_MASS, *sides / 3], strict=True)), start, ()
    points = _OBJECT_PLACES.centres(plate)
    x, y = points[best_of(unchanged.explained_at(points))].tolist()
    for size, damped in _OBJECT_STARTS:
        load = replace(object_load(damped), phalanx_mass=size)
        yield OBJECT, {}, None, (RestingFinger(x, y, load),)


@dataclass(frozen=True, eq=False)
class PatternReport:
    """Result of one settled pattern."""

    nis: float = np.nan
    """Squared innovation in its covariance."""
    count: int = 0
    """Number of real numbers in the innovation."""
    alarm: bool = False
    """Whether it began an alarm; not while the plate counts as changed."""
    is_held: bool = False
    """Whether patterns wait for an explanation."""
    explanation: PlateChange | None = None
    """The change that explains the held patterns, if it was found now."""


class LivePlate:
    """An identified plate in service, updated by settled patterns."""

    def __init__(self, known: PlateEstimate) -> None:
        self.known = known
        """What is known of the plate now."""
        self._alarm = Alarm()
        self._noise = NoiseLevel()
        self._held: list[SettledPattern] = []
        self._suspects = 0

    def take(self, pattern: SettledPattern) -> PatternReport:
        """Take a settled pattern: update what is known, or hold it and explain what happened."""
        pattern, known = replace(pattern, noise=self._noise.relative), self.known
        if known.time is None:
            known = self.known = replace(known, time=pattern.time)
        if self._held:
            self._held.append(pattern)
            return self._explained(pattern.time)
        space = known.model.space
        theory = (space.of_kinds(lambda kind: kind.theory) / space.scale) ** 2
        after = update(known.at(pattern.time), [pattern], theory=theory)
        suspect = self._alarm.take(replace(after, before=known))  # from which drift counts
        report = PatternReport(after.nis, len(after.innovation))
        if suspect is not None:
            self._alarm = Alarm()
            if not known.why_off and not known.change:
                self.known = suspect[0].before.unchanged
                self._held, self._suspects = [e.patterns[0] for e in suspect], len(suspect)
                report = self._explained(pattern.time)
            return replace(report, alarm=not known.change)
        if known.change and self._alarm.is_full:
            known = self.known = known.unchanged
        if not known.why_off and not known.change and not self._alarm.is_odd:
            self.known = after.known.unchanged
            self._noise.take(after.misfit, after.freedom)
        return report

    def _explained(self, time: float) -> PatternReport:
        """Explain the held patterns, early if the explanation is certain."""
        count, before = _tones(self._held), self.known.at(time)
        is_full = count >= _MAX_EXPLAINED and len(self._held) >= self._suspects + _AFTER_ALARM
        found = explain(before, self._held) if count >= _MIN_EXPLAINED else None
        if is_full and found and not found.name:
            # The first of them may be from before the change.
            later = explain(before, self._held[-_MIN_EXPLAINED:])
            found = later if later.name else found
        if found is None or not (is_full or (found.name and found.lead > _CERTAIN)):
            return PatternReport(is_held=True)
        self._held = []
        is_followed = found.name and not found.lying
        changed = replace(self.known, change=str(found), lying=found.of_object)
        self.known = found.after.known if is_followed else changed
        return PatternReport(explanation=found)
