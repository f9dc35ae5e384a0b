"""Values of a rig that can be wrong, and the alternative plates that explain a measurement best.

Each `Variation` changes one value of the rig over a range of factors. The best factor of each is
found from shapes and magnitudes alone. The best variations are then matched, with the other values
of the rig fitted within their priors.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.optimize import minimize_scalar

from model.arrays import ComplexArray, best_by, ranked_by
from model.errors import InputError
from model.estimate.gains import row_rms
from model.estimate.plate_match import FALSE_ALARM, MAX_FIT_ERROR, Match, likeliest, match_plate
from model.estimate.sensed_plate import SensedPlate, sensed_plate
from model.estimate.shape_match import modal_assurance
from model.rig.rig import Rig
from model.structure.exciter import Actuator

# Factors on sizes, stiffnesses and loss factors, so close that a local search finds the best factor
# between two neighbors. Stiffnesses reach from a detached ERA to a rigid one.
SIZE_FACTORS = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
_LOSSES = (0.1, 0.3, 3.0, 10.0, 30.0)
_BOLTS = (0.01, 0.02, 0.04, 0.08, 0.16)  # added mass of each bolt, relative to the plate's mass

_MAX_LOSS_FACTOR = 0.9
"""Maximum loss factor of a hypothesis; no plate has more."""

_BEYOND_RANGE = 1.5
"""Extension of the search for the best factor beyond the ends of a range, a factor."""

_MIN_SCALED_FREQUENCY = 0.85
"""Minimum ratio of natural frequencies to the solved plate's for scaling its solution. Its modes
then still extend well beyond the tones."""

FITTED_HYPOTHESES = 5
"""Number of variations for which the rest of the rig is fitted, in order of their misfit."""

REFINED_HYPOTHESES = 2
"""Number of variations whose factor is refined, in order of the cost of their fit."""

_REFINEMENTS = 7
"""Maximum number of factors that a refinement tries."""

_IMPOSSIBLE_COST = 1e3
"""Cost of an impossible value, relative to the cost of the match."""

_CORRELATION = 4.0
"""Number of values that count as one, because model errors are correlated over sensors and
frequencies."""

_LEVEL_WEIGHT = 0.5
"""Weight of the difference of log magnitudes against 1 - MAC: gains vary, shapes do not."""

_MAX_LEVEL_DIFFERENCE = 1.0
"""Largest difference of log magnitudes that counts, so that antiresonances do not dominate."""


@dataclass(frozen=True)
class Variation(ABC):
    """A value of a rig that can be wrong."""

    key: str
    """Key in the rig file; `eras.NAME` for the values of all ERAs."""
    unit: str
    factors: tuple[float, ...]
    """Factors on the value to compare; for bolts, fractions of the plate's mass."""
    era: str = ""
    """Name of the ERA if the value belongs to a single ERA, otherwise ""."""

    is_size: ClassVar[bool] = False
    """Whether it is a side of the plate, whose free modes are then solved again."""

    @abstractmethod
    def value(self, rig: Rig) -> float:
        """Return the value in a rig, the mean over all ERAs."""

    @abstractmethod
    def applied(self, rig: Rig, factor: float) -> Rig:
        """Return the rig with another value; raises InputError for an impossible value."""


class _Thickness(Variation):
    def value(self, rig: Rig) -> float:
        return rig.plate.thickness

    def applied(self, rig: Rig, factor: float) -> Rig:
        return replace(rig, plate=rig.plate.scaled(thickness=factor))


class _Modulus(Variation):
    def value(self, rig: Rig) -> float:
        return rig.plate.material.E

    def applied(self, rig: Rig, factor: float) -> Rig:
        return replace(rig, plate=rig.plate.scaled(modulus=factor))


class _LossFactor(Variation):
    def value(self, rig: Rig) -> float:
        return rig.plate.loss_factor

    def applied(self, rig: Rig, factor: float) -> Rig:
        loss_factor = min(rig.plate.loss_factor * factor, _MAX_LOSS_FACTOR)
        return replace(rig, plate=replace(rig.plate, loss_factor=loss_factor))


class _Length(Variation):
    is_size = True

    def value(self, rig: Rig) -> float:
        return rig.plate.length

    def applied(self, rig: Rig, factor: float) -> Rig:
        return _resized(rig, length=factor, width=1.0)


class _Width(Variation):
    is_size = True

    def value(self, rig: Rig) -> float:
        return rig.plate.width

    def applied(self, rig: Rig, factor: float) -> Rig:
        return _resized(rig, length=1.0, width=factor)


class _Stiffness(Variation):
    """Stiffness of all ERAs, with their damping unchanged."""

    def value(self, rig: Rig) -> float:
        return float(np.mean([era.stiffness for era in rig.eras]))

    def applied(self, rig: Rig, factor: float) -> Rig:
        return _with_eras(rig, lambda era: era.varied(stiffness=factor))


class _Contact(Variation):
    """Stiffness of one ERA with a partial contact."""

    def value(self, rig: Rig) -> float:
        return rig.era(self.era).stiffness

    def applied(self, rig: Rig, factor: float) -> Rig:
        return _with_eras(rig, lambda era: era.loosened(factor) if era.name == self.era else era)


class _BoltMass(Variation):
    """Mass that moves with the plate at every ERA; exciters have a coil."""

    def value(self, rig: Rig) -> float:
        return float(np.mean([getattr(era, era.fields["bolt_mass"]) for era in rig.eras]))

    def applied(self, rig: Rig, factor: float) -> Rig:
        def with_bolt(era: Actuator) -> Actuator:
            field = era.fields["bolt_mass"]
            return replace(era, **{field: getattr(era, field) + factor * rig.plate.mass})

        return _with_eras(rig, with_bolt)


def _with_eras(rig: Rig, changed: Callable[[Actuator], Actuator]) -> Rig:
    """Return the rig with changed ERAs."""
    return replace(rig, eras=tuple(map(changed, rig.eras)))


def _resized(rig: Rig, *, length: float, width: float) -> Rig:
    """Return the rig with its sides multiplied by factors; attachments move in proportion."""
    plate = rig.plate
    plate = replace(plate, length=plate.length * length, width=plate.width * width)
    return replace(
        rig,
        plate=plate,
        eras=tuple(replace(era, x=era.x * length, y=era.y * width) for era in rig.eras),
        masses=tuple(replace(mass, x=mass.x * length, y=mass.y * width) for mass in rig.masses),
        mesh=rig.mesh.stretched(plate),
    )


def _variations(rig: Rig) -> list[Variation]:
    """Return the values of a rig that can be wrong.

    Density is not varied, since it is the inverse of modulus and stiffnesses.
    """
    variations: list[Variation] = [
        _Thickness("plate.thickness", "m", SIZE_FACTORS),
        _Length("plate.length", "m", SIZE_FACTORS),
        _Width("plate.width", "m", SIZE_FACTORS),
        # Natural frequencies follow the root of the modulus.
        _Modulus("plate.material.E", "Pa", tuple(factor**2 for factor in SIZE_FACTORS)),
        _LossFactor("plate.loss_factor", "", _LOSSES),
        _Stiffness("eras.stiffness", "N/m", _STIFFNESSES),
        _BoltMass("eras.bolt_mass", "kg", _BOLTS),
    ]
    for era in rig.eras:
        variations.append(_Contact(f"eras.{era.name}.stiffness", "N/m", _STIFFNESSES, era.name))
    return variations


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Alternative plate: one value of the rig differs, and the rest is fitted."""

    key: str
    """Key of the value in the rig file."""
    era: str
    """Name of the ERA if the value belongs to a single ERA, otherwise ""."""
    unit: str
    expected: float
    """Value in the rig."""
    value: float
    """Value that explains the measurement best."""
    match: Match
    """The plate with that value."""
    share: float
    """Fraction 0 to 1 of the likelihood among all hypotheses."""

    @property
    def explains(self) -> bool:
        """Whether the rest of the rig is within its priors."""
        return self.match.error <= MAX_FIT_ERROR and self.match.chance >= FALSE_ALARM


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A variation with one of its factors."""

    variation: Variation
    factor: float
    plate: SensedPlate
    """The plate with that factor."""
    misfit: float
    """Before the rest of the rig is fitted."""


def compare_hypotheses(match: Match) -> list[Hypothesis]:
    """Find other plates that explain the values of a match, most likely first."""
    fits = []
    for candidate in _candidates(match)[:FITTED_HYPOTHESES]:
        fits.append((candidate, _rematch(match, candidate.plate)))
    fits = ranked_by(fits, lambda pair: -pair[1].fit.cost)
    variations = [candidate.variation for candidate, _ in fits]
    matches = [rematch for _, rematch in fits]
    for number, (candidate, rematch) in enumerate(fits[:REFINED_HYPOTHESES]):
        matches[number] = _refined(match, candidate, rematch)
    costs = np.array([rematch.fit.cost for rematch in matches])
    likelihoods = np.exp(-(costs - costs.min()) / _CORRELATION)
    shares = likelihoods / likelihoods.sum()
    hypotheses = []
    for variation, rematch, share in zip(variations, matches, shares.tolist(), strict=True):
        hypotheses.append(
            Hypothesis(
                key=variation.key,
                era=variation.era,
                unit=variation.unit,
                expected=variation.value(match.plate.rig),
                value=variation.value(rematch.rig),
                match=rematch,
                share=share,
            )
        )
    return ranked_by(hypotheses, lambda hypothesis: hypothesis.share)


def _candidates(match: Match) -> list[_Candidate]:
    """Return all variations with their best factors, the best variation first."""
    best = []
    for variation in _variations(match.plate.rig):
        candidates = []
        for factor in variation.factors:
            plate = _solved(match, variation, factor)
            if plate:
                misfit = _misfit(match.values, plate.responses()[..., match.drives])
                candidates.append(_Candidate(variation, factor, plate, misfit))
        if candidates:
            best.append(best_by(candidates, lambda candidate: -candidate.misfit))
    return ranked_by(best, lambda candidate: -candidate.misfit)


def _solved(match: Match, variation: Variation, factor: float) -> SensedPlate | None:
    """Return the plate of a match with another value, None if the value is impossible.

    The free plate is solved again for another size, and for a plate too soft for the kept modes.
    """
    try:
        rig = variation.applied(match.plate.rig, factor)
    except InputError:
        return None
    solved_frequency = match.plate.free.plate.lowest_bending_frequency
    is_soft = rig.plate.lowest_bending_frequency < _MIN_SCALED_FREQUENCY * solved_frequency
    if not variation.is_size and not is_soft:
        return match.plate.with_rig(rig)
    measurement = match.fit.measurement
    highest = float(measurement.frequencies.max())
    if highest > rig.mesh.highest_frequency(rig.plate):
        rig = replace(rig, mesh=rig.mesh.resolving(rig.plate, highest))
    # A sensor that would be off the plate is moved to its edge.
    points = np.clip(measurement.points, 0, [rig.plate.length, rig.plate.width])
    return sensed_plate(rig, measurement.moved(points).sensors, measurement.frequencies)


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Difference of shapes and, up to one gain per channel, of magnitudes; 0 if equal."""
    mac = modal_assurance(values.swapaxes(1, 2), model.swapaxes(1, 2))
    measured = np.isfinite(values)
    is_driven = measured.any(axis=(0, 1))
    ratio = row_rms(values) / row_rms(np.where(measured, model, np.nan))
    log_ratio = np.log(ratio)[:, 0, is_driven]
    difference = np.abs(log_ratio - np.nanmedian(log_ratio, axis=0))
    level_misfit = np.nanmean(np.minimum(difference, _MAX_LEVEL_DIFFERENCE))
    return float(np.nanmean(1 - mac) + _LEVEL_WEIGHT * level_misfit)


def _rematch(match: Match, plate: SensedPlate) -> Match:
    """Match another plate with the values of a match."""
    return match_plate(plate, match.values, drives=match.drives, model_error=match.model_error)


def _refined(match: Match, candidate: _Candidate, rematch: Match) -> Match:
    """Search for the best factor between the neighbors of a candidate's factor.

    rematch: the match with the candidate's factor.
    """
    factors = candidate.variation.factors
    padded = (factors[0] / _BEYOND_RANGE, *factors, factors[-1] * _BEYOND_RANGE)
    number = 1 + factors.index(candidate.factor)
    matches = [rematch]

    def cost(log_factor: float) -> float:
        plate = _solved(match, candidate.variation, math.exp(log_factor))
        if plate is None:
            return rematch.fit.cost * _IMPOSSIBLE_COST
        varied = _rematch(match, plate)
        matches.append(varied)
        return varied.fit.cost

    minimize_scalar(
        cost,
        bounds=(math.log(padded[number - 1]), math.log(padded[number + 1])),
        method="bounded",
        options={"maxiter": _REFINEMENTS, "xatol": 3e-3},
    )
    return likeliest(matches)
