"""What of a plate is beyond tolerances: masses, a finger, its thickness, or something unnamed.

A plate is matched once more with form errors, each held by its tolerance (`KINDS` in
`model.identification.parameters`): places of ERAs and sensors, scales of sensors, foreign mass,
sides, Poisson's ratio, single modes. They explain what builders and rulers do, but for foreign mass
in one place, above all near an edge: mass in the middles of cells does not have its field. What
lies on the plate is therefore sought where it would explain most beside all of them, one after
another, and named if it is beyond a tolerance. Of the rest each kind of form error is judged by its
sum of squares, at equal shares of a stated false alarm, and a thickness at as much by itself. A
plate that is thinner at one end moves more there, by as much as it is thinner: scales of sensors
rise along it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import chdtrc

from model.arrays import ComplexArray, FloatArray, best_by
from model.calibration.fit import (
    SensedPlate,
    plate_of,
    project_gains,
    projection_slopes,
    responses_of,
    row_rms,
)
from model.calibration.responses import Responses
from model.diagnosis.plate_match import FALSE_ALARM, Match, match_plate
from model.finger import Grid
from model.identification.derivatives import by_mass_at
from model.identification.least_squares import Linearization
from model.structure.attachments import Fingertip, FingertipLoad, PointLoad

MAX_ERROR = 0.05
"""Share of a response that form errors leave unexplained at most, if they explain the plate."""

_NOISE = (0.01, 0.05)  # of a row's rms: least and largest that a fit is weighted by
_FIRST_NOISE = 0.02
_SCANNED = Grid(32, 24)
_MAX_LOADS = 2
_HEAVY = 0.02  # of the plate's mass, all masses together: twice the tolerance of foreign mass
_LIGHT, _FIRM = 0.3, 3.0  # of a fingertip
_LEAST_SHOWN = 1e-6  # of a variance
_CLEAR = 40.0  # of half the sum of squares

_THICKNESS = "thickness"
_WORDS = {
    "place": "places of ERAs",
    "mode_shifts": "natural frequencies",
    "sensor_scale": "scales of sensors",
    "sensor_place": "places of sensors",
    "foreign_mass": "distribution of mass",
    "side": "length and width",
    "poisson": "Poisson's ratio",
}


@dataclass(frozen=True, eq=False)
class BeyondTolerances:
    """What is not as written.

    loads: what lies on the plate, masses or a finger; farthest: the form error that is least
    likely, in words; deviation: its rms in standard deviations, 0 where none is too large; chance:
    in how many of all plates as written one is as unlikely, at most; error: of the response,
    unexplained; taper: how much thicker the plate is at the ends of x and of y than in the middle,
    relative, None where that is not what is farthest.
    """

    loads: tuple[PointLoad | FingertipLoad, ...]
    farthest: str
    deviation: float
    chance: float
    error: float
    taper: tuple[float, float] | None = None

    @property
    def kind(self) -> str:
        """Its name in reports."""
        if not self.loads:
            return "unnamed" if self.taper is None else "thickness"
        return "mass" if isinstance(self.loads[0], PointLoad) else "finger"


def match_with_form(
    plate: SensedPlate, observation: Responses, values: ComplexArray, drives: Sequence[int]
) -> tuple[Match, BeyondTolerances | None]:
    """Match values (f, e, s) of channels that drive ERAs with form errors, and with a load.

    Return also what of the plate is beyond tolerances, None for nothing.
    """

    def matched(loads: Sequence[PointLoad | FingertipLoad], noise: float) -> Match:
        rig = replace(plate.rig, masses=(*plate.rig.masses, *loads))  # type: ignore[arg-type]
        sensed = plate_of(rig, observation, has_form=True)
        return match_plate(sensed, values, drives=drives, model_error=noise)

    noise = float(np.clip(matched((), _FIRST_NOISE).error, *_NOISE))
    best = matched((), noise)
    loads: list[PointLoad | FingertipLoad] = []
    further, fitted = _loads(best, values, drives, noise)
    while further and len(loads) < _MAX_LOADS:
        tried = [(each, matched((*loads, each), noise)) for each in further]
        load, found = best_by(tried, lambda each: -each[1].cost)
        if found.cost > best.cost - _CLEAR:
            break
        best, loads = found, [*loads, load]
        further, fitted = _loads(best, values, drives, noise)
    mass = sum(each.mass for each in loads if isinstance(each, PointLoad))
    is_heavy = mass >= _HEAVY * plate.rig.plate.mass
    # A mass within tolerance is no fault, nor are form errors that would stand in for it.
    named = tuple(each for each in loads if is_heavy or not isinstance(each, PointLoad))
    if named:
        return best, BeyondTolerances(named, "", 0.0, 1.0, best.error)
    rises, slopes = _along_plate(best, observation.points, fitted)
    farthest, deviation, chance = _farthest(best, rises)
    if best.error <= MAX_ERROR and not deviation:
        return best, None
    taper = slopes if farthest == _THICKNESS else None
    return best, BeyondTolerances((), farthest, deviation, chance, best.error, taper)


def _farthest(match: Match, rises: FloatArray) -> tuple[str, float, float]:
    """The kind of form error that is least likely, its rms in standard deviations, its chance."""
    space = match.plate.model.space
    kinds = {words: match.x[space.of(kind)] for kind, words in _WORDS.items()}
    kinds[_THICKNESS] = rises
    found = [("", 0.0, 1.0)]
    for words, own in kinds.items():
        among = 1 if words == _THICKNESS else len(_WORDS)
        chance = among * float(chdtrc(len(own), own @ own))
        if chance < FALSE_ALARM:
            found.append((words, float(np.sqrt((own**2).mean())), chance))
    return best_by(found, lambda each: -each[2])


def _along_plate(
    match: Match, points: FloatArray, fitted: Linearization
) -> tuple[FloatArray, tuple[float, float]]:
    """What of the scales of sensors rises along the sides (2,), in standard deviations.

    And the thickness that does this, relative, at the ends of x and of y. A fit holds scales back,
    so that those of sound plates vary by less than they are, in the mean by as much.
    """
    space, plate = match.plate.model.space, match.plate.rig.plate
    own = space.of("sensor_scale")[_searched(match)]
    scales = match.x[space.groups["sensor_scale"]]
    along = 2 * points / [plate.length, plate.width] - 1
    basis = np.linalg.qr(np.column_stack([np.ones(len(points)), along]))[0][:, 1:]
    shown = np.eye(len(points)) - linalg.inv(fitted.information)[np.ix_(own, own)]
    shown, rises = basis.T @ shown @ basis + _LEAST_SHOWN * np.eye(2), basis.T @ scales
    thinner = basis @ linalg.solve(shown, rises) * space.std[space.groups["sensor_scale"]]
    x, y = -np.linalg.lstsq(along - along.mean(axis=0), thinner)[0]
    return linalg.solve(linalg.cholesky(shown, lower=True), rises), (float(x), float(y))


def _searched(match: Match) -> NDArray[np.bool_]:
    """Mask (p,) of the parameters that are searched beside free gains."""
    space = match.plate.model.space
    return space.uncertain & ~space.of("gain")


def _loads(
    match: Match, values: ComplexArray, drives: Sequence[int], noise: float
) -> tuple[list[PointLoad | FingertipLoad], Linearization]:
    """A mass and a finger where each would explain most, the latter if it is of a size that counts.

    And the match beside which they were sought.
    """
    plate, of_eras = match.plate, list(drives)
    model, mass = plate.model, plate.rig.plate.mass
    tip = plate.rig.fingertip or Fingertip()
    searched = _searched(match)
    found, by_x = responses_of(model, match.x, searched)
    points = _SCANNED.centres(plate.rig.plate)
    by_mass = by_mass_at(model.at(match.x), points).transpose(3, 0, 2, 1)[:, :, of_eras]
    found, by_x = found[:, of_eras], by_x[:, :, of_eras]
    kept = np.isfinite(values) & ~match.outliers
    weight = kept / (noise * row_rms(values, kept)[:, :, None])
    _, left = project_gains(found, values, weight)

    def real(slopes: ComplexArray) -> FloatArray:
        """Derivatives (2 m, n) of all residuals."""
        own = projection_slopes(found, slopes, values, weight)[1][:, kept].T
        return np.concatenate([own.real, own.imag])

    residual = np.concatenate([left[kept].real, left[kept].imag])
    fitted = Linearization(match.x[searched], residual, real(by_x))
    of_finger = -tip.dynamic_stiffness(model.omega) / model.omega**2
    heaviest: list[PointLoad | FingertipLoad] = []
    for number, size in fitted.further(real(mass * by_mass))[:1]:
        x, y = points[number].tolist()
        heaviest.append(PointLoad(x, y, mass=size * mass))
    for number, size in fitted.further(real(of_finger[:, None, None] * by_mass))[:1]:
        if size >= _LIGHT:
            x, y = points[number].tolist()
            heaviest.append(FingertipLoad(x, y, tip.multiplied(min(size, _FIRM))))
    return heaviest, fitted
