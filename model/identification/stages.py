"""The stages of an identification, since all parameters at once end in wrong minima.

Springs, damping, thickness and gains first, with a noise that hides the rest, from several
thicknesses; then one additional mass, sought where it would explain most; then everything with the
noise as measured. A second mass only where the first leaves something that it explains.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from model.arrays import NEARLY, FloatArray, best_by, ranked_by
from model.finger import Grid
from model.identification.derivatives import by_mass_at
from model.identification.forward import ForwardModel, Sensor
from model.identification.least_squares import (
    IdentificationProblem,
    Linearization,
    solve,
)
from model.identification.measurement import Measurement
from model.identification.parameters import MODE_SHIFTS, Space, inwards, space_of
from model.identification.values import plate_with
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig
from model.structure.modal_elasticity import lowest_elastic
from model.structure.plate import Plate

_EXTRA_NOISE = 0.05  # of the rms at each frequency
_THICKNESSES = (0.0, 1.5, -1.5)  # standard deviations
_MARGIN = 1.02  # of frequency, since layers do not stiffen all modes alike
_GOOD = 0.5  # chi² under the raised noise that needs no further start
_INWARDS = 0.6  # standard deviations
_SCANNED = Grid(8, 6)
_KEPT = 4
_MORE_MASS_BEYOND = 1.5  # chi²
_MASS_GAINS = 25.0  # of the cost: five standard deviations

SIMPLE = (
    "thickness",
    "stiffness",
    "damping",
    "damping_each",
    "loss",
    "gain",
    "phase",
    "inertia",
    "drag",
    "delay",
    "sensor_gain",
    "sensor_phase",
)
LOCATED = (*SIMPLE, "place", "masses")


@dataclass(frozen=True, eq=False)
class Setting:
    """What is fitted to what: a rig with its solved plate, and a measurement on it."""

    rig: Rig
    free: FreePlate
    measurement: Measurement

    def model(self, masses: int, *, more: Sequence[Sensor] = ()) -> ForwardModel:
        """The rig with a number of additional masses at the tones that were measured.

        more: further sensors beside those of the measurement.
        """
        sensors = (*self.measurement.sensors, *more)
        amplifiers = sorted(self.measurement.clock_errors)
        space = space_of(
            self.rig,
            [sensor.name for sensor in sensors],
            self.rig.uncertainty,
            drives_lag=self.measurement.drives_lag,
            amplifiers=amplifiers,
            masses=masses,
            mode_count=len(lowest_elastic(self.free.modes.eigenvalues, MODE_SHIFTS)),
        )
        return ForwardModel(
            self.rig,
            sensors,
            self.measurement.frequencies,
            space,
            self.free,
            amplifiers=amplifiers,
        )


@dataclass(frozen=True, eq=False)
class FittedModel:
    """The most likely parameters in one model, and the problem that they solve."""

    problem: IdentificationProblem
    best: Linearization

    @property
    def space(self) -> Space:
        """The parameters."""
        return self.problem.model.space


def fit_in_stages(setting: Setting) -> FittedModel:
    """Find the most likely parameters of a measurement."""
    measurement = setting.measurement
    model = setting.model(masses=1)
    raised = IdentificationProblem(model, measurement, _EXTRA_NOISE * measurement.tone_rms)
    simple = _simple(raised)
    located = _with_mass(raised, simple.x, number=0)
    found = _in_full(IdentificationProblem(model, measurement), located)
    while chi2(found) > _MORE_MASS_BEYOND and found.problem.model.mass_count < 2:
        more = _another_mass(setting, found)
        if more.best.cost > found.best.cost - _MASS_GAINS:
            break
        found = more
    return _solved_anew(setting, found)


def _solved_anew(setting: Setting, found: FittedModel) -> FittedModel:
    """Fit from there with the plate solved for its thickness and modulus, as a table will be."""
    values, plate = found.problem.model.at(found.best.x).values, setting.rig.plate
    identified = plate_with(plate, values)
    identified = replace(identified, mode_deviations=plate.mode_deviations)
    free = solved_with_modes_of(setting.free, identified)
    model = replace(found.problem.model, free=free, last_places={})
    problem = IdentificationProblem(model, setting.measurement)
    return FittedModel(problem, solve(problem, found.best.x, found.space.uncertain))


def solved_with_modes_of(free: FreePlate, plate: Plate) -> FreePlate:
    """Solve a plate on the mesh of another, with all modes of that one though it may be stiffer."""
    stiffer = plate.lowest_bending_frequency / free.plate.lowest_bending_frequency
    frequency_max = free.frequency_max * max(stiffer * _MARGIN, 1.0)
    return solve_free_plate(plate, free.mesh, frequency_max=frequency_max)


def chi2(fitted: FittedModel) -> float:
    """Squared residuals in standard deviations, per value beyond the parameters they determine."""
    r, J = fitted.best.residuals, fitted.best.jacobian
    determined = np.trace(linalg.solve(fitted.best.information, J.T @ J, assume_a="pos"))
    return float(r @ r / max(len(r) - determined, 1.0))


def _simple(problem: IdentificationProblem) -> Linearization:
    """Fit without form errors from several thicknesses."""
    space = problem.model.space
    free = space.of(*SIMPLE)
    best: Linearization | None = None
    for thickness in _THICKNESSES:
        start = np.zeros(space.size)
        start[space.groups["thickness"]] = thickness
        found = solve(problem, start, free)
        if best is None or found.cost < (1 - NEARLY) * best.cost:
            best = found
        if best.residuals @ best.residuals < _GOOD * len(best.residuals):
            break
    assert best is not None  # noqa: S101  the loop has starts
    return best


def _with_mass(
    problem: IdentificationProblem, x: FloatArray, *, number: int
) -> list[Linearization]:
    """Fit places and an additional mass from where it explains most, and from none."""
    space = problem.model.space
    start = inwards(space, x, by=_INWARDS)
    own = space.groups["masses"].start + 3 * number
    starts = [start]
    for place, mass in _scan(problem, start, own):
        moved = start.copy()
        moved[own : own + 3] = mass, *place
        starts.append(moved)
    free = space.of(*LOCATED)
    found = [solve(problem, each, free) for each in starts]
    return ranked_by(found, lambda each: -each.cost)


def _scan(
    problem: IdentificationProblem, x: FloatArray, own: int
) -> list[tuple[FloatArray, float]]:
    """Places and sizes of x at which an additional mass would explain most, all else linear."""
    model = problem.model
    space = model.space
    now = problem.linearised(x)
    kinds = [
        kind
        for kind in space.groups
        if kind not in ("masses", "mode_shifts", "mode_losses", "fingers")
    ]
    others = np.flatnonzero(space.of(*kinds))
    plate, points = model.rig.plate, _SCANNED.centres(model.rig.plate)
    by_mass = by_mass_at(model.at(x), points)[problem.measurement.known] / problem.std[:, None]
    columns = np.concatenate([by_mass.real, by_mass.imag]) * space.std[own]
    heaviest = Linearization(x[others], now.residuals, now.jacobian[:, others]).further(columns)
    off = (points - [plate.length / 2, plate.width / 2]) / space.std[own + 1 : own + 3]
    return [(off[number], size) for number, size in heaviest[:_KEPT]]


def _in_full(problem: IdentificationProblem, starts: list[Linearization]) -> FittedModel:
    """Fit everything to the noise as it is, from the two best starts."""
    free = problem.model.space.uncertain
    found = [solve(problem, each.x, free) for each in starts[:2]]
    return FittedModel(problem, best_by(found, lambda each: -each.cost))


def _another_mass(setting: Setting, found: FittedModel) -> FittedModel:
    """Fit with one mass more."""
    before = found.problem.model.mass_count
    model = setting.model(masses=before + 1)
    raised = IdentificationProblem(
        model, setting.measurement, _EXTRA_NOISE * setting.measurement.tone_rms
    )
    at = found.space.groups["masses"].stop
    x = np.insert(found.best.x, at, np.zeros(3))
    starts = _with_mass(raised, x, number=before)
    return _in_full(IdentificationProblem(model, setting.measurement), starts)
