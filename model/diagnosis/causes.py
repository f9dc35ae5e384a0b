"""What single thing about a rig, if it were another, would explain a measurement that it does not.

Every cause is tried over a range of values, the rig otherwise as it is; from the best of them on
the rest of the rig may move within what its author can know (`model.diagnosis.plate_match`).

Not tried: two causes at once, plates that are no rectangles, further supports. A plate that is t
times as thick moves as one of t² times the modulus on ERAs and masses of 1/t: shear and rotary
inertia apart, which a thin plate does not show. Density cannot be told from these.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from model.arrays import ComplexArray, FloatArray
from model.calibration.fast_plate import FastPlate, fast_plate
from model.calibration.variable_projection import modal_assurance
from model.diagnosis.plate_match import Match, match_plate
from model.errors import InputError
from model.rig.rig import Rig

_SIZES = (0.6, 0.67, 0.75, 0.82, 0.88, 0.94, 1.06, 1.13, 1.21, 1.33, 1.5, 1.67)
_STIFFNESSES = (0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
_LOSSES = (0.1, 0.3, 3.0, 10.0, 30.0)
_MASSES = (0.01, 0.02, 0.04, 0.08, 0.16)  # of the plate's mass, at every ERA
_FITTED_CAUSES = 5  # causes for which the rest of the rig is let move
_FOLLOWED = 2  # of these, whose value is searched for finely
_FINELY = 7  # values
_TOGETHER = 4.0  # errors of a model go together over sensors and frequencies, and count less


@dataclass(frozen=True)
class Cause:
    """A thing that may be another: value of it in a rig [unit], and a rig with another value.

    geometry: whether the plate has to be solved anew. era: whose, "" for the plate or all.
    """

    key: str
    unit: str
    era: str
    value: Callable[[Rig], float]
    changed: Callable[[Rig, float], Rig]
    factors: tuple[float, ...]
    geometry: bool = False


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause with the value that explains most, and the plate with it; share: 0..1 among all."""

    cause: Cause
    value: float
    expected: float
    match: Match
    share: float = 0.0


def causes_of(rig: Rig) -> list[Cause]:
    """What may be another."""
    found = [
        Cause("plate.thickness", "m", "", lambda r: r.plate.thickness, _thickness, _SIZES),
        Cause("plate.length", "m", "", lambda r: r.plate.length, _length, _SIZES, True),
        Cause("plate.width", "m", "", lambda r: r.plate.width, _width, _SIZES, True),
        Cause(
            "plate.material.E",
            "Pa",
            "",
            lambda r: r.plate.material.E,
            _modulus,
            tuple(size**2 for size in _SIZES),
        ),
        Cause("plate.loss_factor", "", "", lambda r: r.plate.loss_factor, _loss, _LOSSES),
        Cause("eras.stiffness", "N/m", "", _mean_stiffness, _stiffnesses, _STIFFNESSES),
        Cause("eras.bolt_mass", "kg", "", _mean_bolt, _bolts, _MASSES),
    ]
    for number, era in enumerate(rig.eras):
        found.append(
            Cause(
                f"eras.{era.name}.stiffness",
                "N/m",
                era.name,
                lambda r, n=number: r.eras[n].stiffness,  # type: ignore[misc]
                lambda r, f, n=number: _one_stiffness(r, f, n),  # type: ignore[misc]
                _STIFFNESSES,
            )
        )
    return found


def explain(
    rig: Rig,
    plate: FastPlate,
    points: FloatArray,
    frequencies: FloatArray,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    floor: FloatArray | None,
    model_error: float,
) -> list[Explanation]:
    """What would explain values (f, e, s) best, the likeliest first; see `match_plate`."""

    def matched(cause: Cause, factor: float) -> Match | None:
        other = _rig(cause, rig, factor)
        if other is None:
            return None
        solved = _solved(other, points, frequencies) if cause.geometry else plate
        return match_plate(
            other, solved, values, drives=drives, floor=floor, model_error=model_error
        )

    scores = []
    for cause in causes_of(rig):
        tried = []
        for factor in cause.factors:
            other = _rig(cause, rig, factor)
            if other is not None:
                solved = _solved(other, points, frequencies) if cause.geometry else plate
                tried.append((_misfit(values, solved.responses(other)[:, list(drives)]), factor))
        if tried:
            scores.append((*min(tried), cause))
    scores.sort(key=lambda each: each[0])
    found = []
    for _, factor, cause in scores[:_FITTED_CAUSES]:
        match = matched(cause, factor)
        if match is not None:
            found.append((cause, factor, match))
    found.sort(key=lambda each: each[2].cost)
    followed = [
        (cause, *_finely(cause, factor, match, matched)) if number < _FOLLOWED else found[number]
        for number, (cause, factor, match) in enumerate(found)
    ]
    costs = np.array([match.cost for _, _, match in followed])
    weights = np.exp(-(costs - costs.min()) / _TOGETHER)
    explained = [
        Explanation(
            cause,
            _value(cause, rig, factor, match),
            cause.value(rig),
            match,
            float(weight),
        )
        for (cause, factor, match), weight in zip(followed, weights / weights.sum(), strict=True)
    ]
    return sorted(explained, key=lambda each: -each.share)


def _value(cause: Cause, rig: Rig, factor: float, match: Match) -> float:
    """The cause's value in the plate that was found."""
    if cause.key == "plate.thickness":
        return cause.value(rig) * factor
    return cause.value(match.rig)


def _finely(
    cause: Cause,
    factor: float,
    match: Match,
    matched: Callable[[Cause, float], Match | None],
) -> tuple[float, Match]:
    """The best factor between the neighbours of one in the cause's range."""
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
        options={"maxiter": _FINELY, "xatol": 3e-3},
    )
    best = min(known, key=lambda each: known[each].cost)
    return best, known[best]


def _misfit(values: ComplexArray, model: ComplexArray) -> float:
    """Disagreement of shapes and, up to a gain of each channel, of sizes; 0 for none."""
    mac = modal_assurance(values, model)
    measured = np.isfinite(values)
    norms = (np.linalg.norm(np.where(measured, each, 0), axis=2) for each in (values, model))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.divide(*norms))
    ratio = ratio[:, measured.any(axis=(0, 2))]
    deviation = np.minimum(np.abs(ratio - np.nanmedian(ratio, axis=0)), 1.0)
    return float(np.nanmean(1 - mac) + 0.5 * np.nanmean(deviation))


def _rig(cause: Cause, rig: Rig, factor: float) -> Rig | None:
    """The rig with another value, if there can be one."""
    try:
        return cause.changed(rig, factor)
    except InputError:
        return None


def _solved(rig: Rig, points: FloatArray, frequencies: FloatArray) -> FastPlate:
    """Its plate; a sensor that would be off it counts as at its edge."""
    on = np.clip(points, 0, [rig.plate.length, rig.plate.width])
    return fast_plate(rig, on, frequencies)


def _thickness(rig: Rig, factor: float) -> Rig:
    """Not the thicker plate itself but one of the old thickness that moves as it does."""
    eras = tuple(
        replace(
            era,
            stiffness=era.stiffness / factor,
            damping=era.damping / factor,
            bolt_mass=era.bolt_mass / factor,
        )
        for era in rig.eras
    )
    masses = tuple(replace(mass, mass=mass.mass / factor) for mass in rig.masses)
    return replace(_modulus(rig, factor**2), eras=eras, masses=masses)


def _length(rig: Rig, factor: float) -> Rig:
    return _stretched(rig, factor, 1.0)


def _width(rig: Rig, factor: float) -> Rig:
    return _stretched(rig, 1.0, factor)


def _stretched(rig: Rig, along_x: float, along_y: float) -> Rig:
    """A plate of another size; what is attached to it moves along in proportion."""
    plate = replace(rig.plate, length=rig.plate.length * along_x, width=rig.plate.width * along_y)
    eras = tuple(replace(era, x=era.x * along_x, y=era.y * along_y) for era in rig.eras)
    masses = tuple(replace(mass, x=mass.x * along_x, y=mass.y * along_y) for mass in rig.masses)
    mesh = replace(
        rig.mesh,
        nx=math.ceil(rig.mesh.nx * max(along_x, 1.0)),
        ny=math.ceil(rig.mesh.ny * max(along_y, 1.0)),
        length=plate.length,
        width=plate.width,
    )
    return replace(rig, plate=plate, eras=eras, masses=masses, mesh=mesh)


def _modulus(rig: Rig, factor: float) -> Rig:
    material = replace(rig.plate.material, E=rig.plate.material.E * factor)
    return replace(rig, plate=replace(rig.plate, material=material))


def _loss(rig: Rig, factor: float) -> Rig:
    loss = min(rig.plate.loss_factor * factor, 0.9)
    return replace(rig, plate=replace(rig.plate, loss_factor=loss))


def _stiffnesses(rig: Rig, factor: float) -> Rig:
    return replace(
        rig, eras=tuple(replace(era, stiffness=era.stiffness * factor) for era in rig.eras)
    )


def _one_stiffness(rig: Rig, factor: float, number: int) -> Rig:
    """A loose ERA neither holds nor damps."""
    eras = list(rig.eras)
    era = eras[number]
    eras[number] = replace(
        era, stiffness=era.stiffness * factor, damping=era.damping * min(factor, 1.0)
    )
    return replace(rig, eras=tuple(eras))


def _bolts(rig: Rig, factor: float) -> Rig:
    more = factor * rig.plate.mass
    return replace(
        rig, eras=tuple(replace(era, bolt_mass=era.bolt_mass + more) for era in rig.eras)
    )


def _mean_stiffness(rig: Rig) -> float:
    return float(np.mean([era.stiffness for era in rig.eras]))


def _mean_bolt(rig: Rig) -> float:
    return float(np.mean([era.bolt_mass for era in rig.eras]))
