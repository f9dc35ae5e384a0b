"""Search for a single parameter of the rig that explains a measurement of another plate.

Each is varied over a range with the rest of the rig unchanged; for the best the rest may then vary
within its priors (`model.diagnosis.plate_match`).

Not tried: two causes at once, plates that are not rectangles, further supports, and density, which
cannot be distinguished from the others.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from model.arrays import ComplexArray, FloatArray, best_by, ranked_by
from model.calibration.fit import Parameter, SensedPlate, modal_assurance, sensed_plate
from model.diagnosis.plate_match import Match, match_plate
from model.errors import InputError
from model.identification.parameters import VALUE_UNITS
from model.rig.rig import Rig
from model.spectral.mesh import stretched
from model.structure.actuators import Actuator

_SIZES = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
_LOSSES = (0.1, 0.3, 3.0, 10.0, 30.0)
_MASSES = (0.01, 0.02, 0.04, 0.08, 0.16)  # of the plate's mass, at every ERA
_FITTED_CAUSES = 5  # causes for which the rest of the rig is fitted
_REFINED_CAUSES = 2  # of these, whose value is refined
_REFINEMENTS = 7  # values
_CORRELATION = 4.0  # errors of a model are correlated over sensors and frequencies


@dataclass(frozen=True)
class Cause:
    """A value of the rig that may differ: of the plate, or of one ERA or all, "" for all.

    factors: by which it is tried; of bolts shares of the plate's mass, which are added.
    """

    key: str
    what: str
    factors: tuple[float, ...]
    era: str = ""

    @property
    def unit(self) -> str:
        """Unit of its value."""
        return VALUE_UNITS[self.what]

    @property
    def is_geometry(self) -> bool:
        """Whether the plate must be solved again."""
        return self.what in ("length", "width")

    def value(self, rig: Rig) -> float:
        """The value in a rig [unit], of all ERAs their mean."""
        names = [era.name for era in rig.eras if self._is_of(era)]
        names = [""] if self.key.startswith("plate.") else names
        return float(np.mean([Parameter(self.what, name).of(rig) for name in names]))

    def scaled(self, rig: Rig, factor: float) -> Rig:
        """The rig with another value; raises InputError for one that it cannot have."""
        plate, what = rig.plate, self.what
        if what in ("thickness", "modulus"):
            return replace(rig, plate=plate.scaled(**{what: factor}))
        if what == "loss_factor":
            return replace(
                rig, plate=replace(plate, loss_factor=min(plate.loss_factor * factor, 0.9))
            )
        if self.is_geometry:
            return _stretched(rig, *((factor, 1.0) if what == "length" else (1.0, factor)))
        return replace(
            rig,
            eras=tuple(
                self._changed(era, factor, plate.mass) if self._is_of(era) else era
                for era in rig.eras
            ),
        )

    def _is_of(self, era: Actuator) -> bool:
        return self.era in ("", era.name)

    def _changed(self, era: Actuator, factor: float, plate_mass: float) -> Actuator:
        if self.what == "bolt_mass":
            field = era.fields[self.what]
            return replace(era, **{field: getattr(era, field) + factor * plate_mass})
        return era.loosened(factor) if self.era else era.varied(stiffness=factor)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause with its best value, the plate with it, and its share 0..1 of the likelihood."""

    cause: Cause
    value: float
    expected: float
    match: Match
    share: float


def causes_of(rig: Rig) -> list[Cause]:
    """Causes that are tried."""
    moduli = tuple(size**2 for size in _SIZES)
    return [
        Cause("plate.thickness", "thickness", _SIZES),
        Cause("plate.length", "length", _SIZES),
        Cause("plate.width", "width", _SIZES),
        Cause("plate.material.E", "modulus", moduli),
        Cause("plate.loss_factor", "loss_factor", _LOSSES),
        Cause("eras.stiffness", "stiffness", _STIFFNESSES),
        Cause("eras.bolt_mass", "bolt_mass", _MASSES),
        *(
            Cause(f"eras.{era.name}.stiffness", "stiffness", _STIFFNESSES, era.name)
            for era in rig.eras
        ),
    ]


def explain(
    plate: SensedPlate,
    points: FloatArray,
    frequencies: FloatArray,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float,
) -> list[Explanation]:
    """Find what explains values (f, e, s) best, most likely first; see `match_plate`."""

    rig = plate.rig

    def solved(cause: Cause, factor: float) -> SensedPlate | None:
        try:
            other = cause.scaled(rig, factor)
        except InputError:
            return None
        if not cause.is_geometry:
            return plate.of(other)
        # A sensor that would be off the plate counts as at its edge.
        on_plate = np.clip(points, 0, [other.plate.length, other.plate.width])
        return sensed_plate(other, on_plate, frequencies, masses=plate.masses)

    def matched(cause: Cause, factor: float) -> Match | None:
        found = solved(cause, factor)
        if found is None:
            return None
        return match_plate(found, values, drives=drives, model_error=model_error)

    scores = []
    for cause in causes_of(rig):
        tried = []
        for factor in cause.factors:
            if found := solved(cause, factor):
                model = found.responses()[:, list(drives)]
                tried.append((_misfit(values, model), factor))
        if tried:
            scores.append((*best_by(tried, lambda each: -each[0]), cause))
    fits = []
    for _, factor, cause in ranked_by(scores, lambda each: -each[0])[:_FITTED_CAUSES]:
        match = matched(cause, factor)
        if match is not None:
            fits.append((cause, factor, match))
    fits = ranked_by(fits, lambda each: -each[2].cost)
    fits[:_REFINED_CAUSES] = [
        (cause, *_refined(cause, factor, match, matched))
        for cause, factor, match in fits[:_REFINED_CAUSES]
    ]
    costs = np.array([match.cost for _, _, match in fits])
    weights = np.exp(-(costs - costs.min()) / _CORRELATION)
    explained = [
        Explanation(
            cause,
            cause.value(match.rig),
            cause.value(rig),
            match,
            float(weight),
        )
        for (cause, _, match), weight in zip(fits, weights / weights.sum(), strict=True)
    ]
    return ranked_by(explained, lambda each: each.share)


def _refined(
    cause: Cause,
    factor: float,
    match: Match,
    matched: Callable[[Cause, float], Match | None],
) -> tuple[float, Match]:
    """Search for the best factor between the neighbours of one in the cause's range."""
    at = cause.factors.index(factor)
    low = cause.factors[max(at - 1, 0)] if at else factor / 1.5
    high = cause.factors[at + 1] if at + 1 < len(cause.factors) else factor * 1.5
    known = {factor: match}

    def cost(logarithm: float) -> float:
        tried = matched(cause, math.exp(logarithm))
        if tried is None:
            return match.cost * 1e3
        known[math.exp(logarithm)] = tried
        return tried.cost

    minimize_scalar(
        cost,
        bounds=(math.log(low), math.log(high)),
        method="bounded",
        options={"maxiter": _REFINEMENTS, "xatol": 3e-3},
    )
    return best_by([*known.items()], lambda each: -each[1].cost)


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Difference of shapes and, up to a gain of each channel, of magnitudes; 0 if equal."""
    mac = modal_assurance(values, model)
    measured = np.isfinite(values)
    norms = (np.linalg.norm(np.where(measured, each, 0), axis=2) for each in (values, model))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.divide(*norms))
    ratio = ratio[:, measured.any(axis=(0, 2))]
    deviation = np.minimum(np.abs(ratio - np.nanmedian(ratio, axis=0)), 1.0)
    return float(np.nanmean(1 - mac) + 0.5 * np.nanmean(deviation))


def _stretched(rig: Rig, along_x: float, along_y: float) -> Rig:
    """Plate of another size with everything attached in proportion."""
    plate = replace(rig.plate, length=rig.plate.length * along_x, width=rig.plate.width * along_y)
    eras = tuple(replace(era, x=era.x * along_x, y=era.y * along_y) for era in rig.eras)
    masses = tuple(replace(mass, x=mass.x * along_x, y=mass.y * along_y) for mass in rig.masses)
    mesh = stretched(rig.mesh, plate)
    return replace(rig, plate=plate, eras=eras, masses=masses, mesh=mesh)
