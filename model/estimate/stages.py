"""Stages of an identification, and what is known of the parameters after it.

Fitting all parameters at once ends in wrong minima. So springs, damping, thickness and gains come
first, from several thicknesses and with a noise that hides the rest; then one additional mass, from
where it would explain most; then everything with the noise as measured. A second mass is added only
where the first leaves something that it explains. A board with a grain is then fitted again with
the moduli across and of shear that the shifts of its modes suggest: boards of one kind differ in
each by 10 % and more. To first order shifts m (k,), in standard deviations s, with covariance C,
follow from logarithms d of factors on the moduli, of prior variance D:

    d = (J^T (1 - C) J + D^-1)^-1 J^T m,   J = (v^T dK v / lambda) / s,

where the first column of J, all ones, stands for a modulus that is fitted anew.

A response to a moving base does not change if mass, springs and dampers are scaled together, nor
does a contrast if all drives are. Answers depend on each natural frequency, on each spring and
damper relative to the plate's mass, on each gain relative to the others, and levels on the mean of
the gains: responses give only its product with that of the sensors (`relevant`).

The fit is checked on paths from an ERA to a sensor that it was not shown, every fifth one, five
times over; the reverse of a hidden path is hidden as well. Hidden paths show how far fields are off
that are not measured; hidden tones would show whether a resonance was seen, which the covariance
knows. Only the part of the error that neither noise nor uncertain parameters explain counts against
the model. By that part parameters disagree between fits to different paths, beyond their covariance
(a jackknife over groups: B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans, SIAM
1982, ch. 3). Where the measurement leaves a quantity unknown, `unknowns` names the tone and the
sensor that would show it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from model.arrays import NEARLY, ComplexArray, FloatArray, best_by, best_of, ranked_by
from model.estimate.forward import ForwardModel, Sensor, by_mass_at, jacobian
from model.estimate.least_squares import IdentificationProblem, Linearization, solve
from model.estimate.measurement import Measurement
from model.estimate.space import KINDS, MODE_SHIFTS, Space, inwards, plate_with, space_of
from model.finger import Grid
from model.processes import Progress, unseen
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.spectral.direct_solution import grain_slopes
from model.structure.modal_elasticity import lowest_elastic
from model.structure.plate import Plate

_EXTRA_NOISE = 0.05  # of the rms at each frequency, in the first stages
_THICKNESSES = (0.0, 1.5, -1.5)  # standard deviations from which the first stage starts
_FREQUENCY_MARGIN = 1.02  # since layers do not stiffen all modes alike
_GOOD = 0.5  # chi² with the extra noise that needs no further start
_INWARDS = 0.6  # standard deviations by which places start from an edge
_MASS_GRID = Grid(8, 6)  # where an additional mass is sought
_MASS_STARTS = 4
_MORE_MASS_BEYOND = 1.5  # chi²
_MASS_GAINS = 25.0  # of the cost: five standard deviations

_SIMPLE = (
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
_LOCATED = (*_SIMPLE, "place", "masses")

_THEORY = {
    "frequency": KINDS["mode_shifts"].theory / 2,
    "stiffness": KINDS["stiffness"].theory,
    "damping": KINDS["damping_each"].theory,
    "place": KINDS["place"].theory,
}

HELD_OUT_FOLDS = 5
"""One path or sensor in so many is held out."""

_FOLD_EVALUATIONS = 8
_MAX_PREDICTION_ERROR = 0.1  # of the rms at a tone; less certain predictions are no test
_MIN_PREDICTED = 16  # values
_IN_COMMON = 2.0  # factor on standard deviations: what no path shows is wrong in all fits alike

_UNKNOWN = 0.5
"""Share of its standard deviation beforehand, beyond which a quantity was not identified.

The standard deviation is that of a plate that was not measured where the rig states less: answers
need no more.
"""

_SUSPENSION_FELT = 120.0  # Hz; above it a suspension that is 20 % off changes fields by under 5 %

_ADVISED_STEP = 20.0  # Hz between the tones that may be advised
_ADVISED_NOISE = 0.01  # of the rms of the responses at a tone
_ADVISED_PLACES = (0.13, 0.5, 0.87)  # of the sides, where further sensors may be advised

_GRAIN_PRIOR = 0.15  # standard deviation of the logarithms of a board's moduli by its kind
_MIN_GRAIN_CHANGE = 3e-3  # of a logarithm, that is worth another fit
_GRAIN_STARTS = (1.0, 0.85, 1.18)  # factors on the modulus across, since fits end in wrong minima
_GRAIN_ROUNDS = 3  # fits from a start, each with the grain that the one before shows
_GRAIN_GOOD = 1.0  # chi², and mean square of the shifts of modes, that need no further start


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


def fit_board(setting: Setting) -> tuple[Setting, FittedModel]:
    """Fit in stages, and for a board with a grain again with the grain that the fit shows.

    Returns the setting with the grain that was found, and the fit in it.
    """
    if setting.rig.plate.material.orthotropy is None:
        return setting, fit_in_stages(setting)
    found = []
    for start in _GRAIN_STARTS:
        found += _fits_from(_with_grain(setting, start, 1.0))
        if any(_is_good(fitted) for _, fitted in found):
            break
    return best_by(found, lambda each: -each[1].best.cost)


def _fits_from(setting: Setting) -> list[tuple[Setting, FittedModel]]:
    """Fits one after the other, each in the grain that the one before shows."""
    found = [(setting, fit_in_stages(setting))]
    for _ in range(_GRAIN_ROUNDS):
        setting, fitted = found[-1]
        across, shear = _grain_shown(setting, fitted)
        if max(abs(across), abs(shear)) < _MIN_GRAIN_CHANGE:
            break
        other = _with_grain(setting, math.exp(across), math.exp(shear))
        found.append((other, fit_in_stages(other)))
    return found


def _is_good(fitted: FittedModel) -> bool:
    """Whether a fit explains a measurement by a board whose modes need not shift beyond theirs."""
    shifts = fitted.best.x[fitted.space.of("mode_shifts")]
    return chi2(fitted) <= _GRAIN_GOOD and float((shifts**2).mean()) <= _GRAIN_GOOD


def _grain_shown(setting: Setting, fitted: FittedModel) -> tuple[float, float]:
    """Logarithms of the factors on the moduli across and of shear that the shifts of modes show."""
    shifts = fitted.space.of("mode_shifts")
    count = int(shifts.sum())
    posterior = Posterior.of(fitted.space, fitted.best)
    shown = np.eye(count) - posterior.covariance[np.ix_(shifts, shifts)]
    J = _slopes(setting.free, count) / KINDS["mode_shifts"].std
    information = J.T @ shown @ J + np.eye(3) / _GRAIN_PRIOR**2
    _, across, shear = np.linalg.solve(information, J.T @ posterior.x[shifts]).tolist()
    return across, shear


def _with_grain(setting: Setting, across: float, shear: float) -> Setting:
    """The setting of a board with other moduli across and of shear, by factors."""
    rig, of = setting.rig, setting.rig.plate.material.shares
    shares = replace(of, e2=of.e2 * across, g12=of.g12 * shear)
    plate = replace(rig.plate, material=replace(rig.plate.material, orthotropy=shares))
    free = solve_free_plate(plate, setting.free.mesh, frequency_max=setting.free.frequency_max)
    return replace(setting, rig=replace(rig, plate=plate), free=free)


def _slopes(free: FreePlate, count: int) -> FloatArray:
    """Derivatives of the logarithms of the lowest eigenvalues by those of three moduli (k, 3)."""
    modes, mesh = free.modes, free.mesh
    lowest = lowest_elastic(modes.eigenvalues, count)
    shapes = [each[:, lowest] for each in modes.unknowns(np.empty((0, 3)))]
    by_grain = grain_slopes(free.plate, (mesh.nx, mesh.ny), shapes)
    relative = by_grain / modes.eigenvalues[lowest]
    return np.column_stack([np.ones(len(lowest)), *relative])


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


def _simple(problem: IdentificationProblem) -> Linearization:
    """Fit without form errors from several thicknesses."""
    space = problem.model.space
    free = space.of(*_SIMPLE)
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
    free = space.of(*_LOCATED)
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
    plate, points = model.rig.plate, _MASS_GRID.centres(model.rig.plate)
    by_mass = by_mass_at(model.at(x), points)[problem.measurement.known] / problem.std[:, None]
    columns = np.concatenate([by_mass.real, by_mass.imag]) * space.std[own]
    heaviest = Linearization(x[others], now.residuals, now.jacobian[:, others]).further(columns)
    off = (points - [plate.length / 2, plate.width / 2]) / space.std[own + 1 : own + 3]
    return [(off[number], size) for number, size in heaviest[:_MASS_STARTS]]


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
    """Solve a plate on the mesh of another one, with all of its modes though it may be stiffer."""
    stiffer = plate.lowest_bending_frequency / free.plate.lowest_bending_frequency
    frequency_max = free.frequency_max * max(stiffer * _FREQUENCY_MARGIN, 1.0)
    return solve_free_plate(plate, free.mesh, frequency_max=frequency_max)


def chi2(fitted: FittedModel) -> float:
    """Squared residuals in standard deviations, per degree of freedom."""
    r, J = fitted.best.residuals, fitted.best.jacobian
    determined = np.trace(linalg.solve(fitted.best.information, J.T @ J, assume_a="pos"))
    return float(r @ r / max(len(r) - determined, 1.0))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Normal distribution of the parameters about their most likely values."""

    space: Space
    x: FloatArray
    """Most likely values (p,)."""
    covariance: FloatArray
    """Covariance (p, p) of x."""

    @classmethod
    def of(cls, space: Space, best: Linearization) -> "Posterior":
        """Linearise about the most likely parameters: (J^T J + 1)^-1, 0 for known parameters."""
        free = np.flatnonzero(space.uncertain)
        covariance = np.zeros((space.size, space.size))
        covariance[np.ix_(free, free)] = linalg.inv(best.information[np.ix_(free, free)])
        return cls(space, best.x, covariance)

    def within(self, space: Space) -> "Posterior":
        """Extend to a space with further parameters, which are 0 and without variance."""
        own = [space.index(name) for name in self.space.names]
        x, covariance = np.zeros(space.size), np.zeros((space.size, space.size))
        x[own] = self.x
        covariance[np.ix_(own, own)] = self.covariance
        return Posterior(space, x, covariance)

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviation of each parameter in its unit (p,)."""
        return np.asarray(self.space.std * np.sqrt(np.diagonal(self.covariance)))

    def std_of(self, combinations: FloatArray) -> FloatArray:
        """Standard deviations of linear combinations (m, p) of parameters in their units, (m,)."""
        scaled = combinations * self.space.std
        return np.asarray(np.sqrt(np.einsum("mp,pq,mq->m", scaled, self.covariance, scaled)))

    def stds(self) -> dict[str, FloatArray]:
        """Standard deviations of what answers depend on, with the errors of the theory, by kind."""
        own = {kind: self.std_of(rows) for kind, rows in relevant(self.space).items()}
        own["place"] = self.std[self.space.groups["place"]]
        return {
            kind: np.where(std > 0, np.hypot(std, _THEORY.get(kind, 0.0)), 0.0)
            for kind, std in own.items()
        }

    def uncertainty(
        self, before: Uncertainty, *, gain: float, phase_deg: float, field: float
    ) -> Uncertainty:
        """The `uncertainty` of the rig after its identification.

        before: that of the rig, whose fingers and harmonics stay; its common_gain, which no fit
        narrows, is added to the error of the gains' mean. gain, phase_deg: repeatability of drives;
        field: share of fields that the model leaves unexplained.
        """
        mean = _rows(self.space, "gain").mean(axis=0, keepdims=True)
        rms = {kind: _rms(std) for kind, std in self.stds().items()}
        damping = max(rms["damping"], rms["loss"])
        return Uncertainty.clipped(
            gain=math.hypot(rms["gain"], gain),
            phase_deg=math.hypot(math.degrees(rms["phase"]), phase_deg),
            **Uncertainty.of_frequency(rms["frequency"]),
            stiffness=rms["stiffness"],
            damping=math.exp(damping),
            fingertip=before.fingertip,
            common_gain=math.hypot(before.common_gain, self.std_of(mean)[0]),
            field=field,
            place=rms["place"],
            harmonic=before.harmonic,
            supports=_rms(self.std[self.space.groups["supports"]]),
        )


def relevant(space: Space) -> dict[str, FloatArray]:
    """Combinations (m, p) of parameters that answers depend on, by name."""
    mass = _rows(space, "thickness")
    by_rigidity = mass + _rows(space, "modulus") / 2
    gain, phase = _rows(space, "gain"), _rows(space, "phase")
    damping = _rows(space, "damping_each") + _rows(space, "damping") - mass
    factor = space.groups["force_factor"]
    if factor.stop > factor.start:
        # An exciter damps and pushes by its coil: the share of its suspension shows little alone.
        damping = damping[space.std[factor] == 0]
        gain = gain + _rows(space, "force_factor")
    return {
        "frequency": by_rigidity + _rows(space, "mode_shifts") / 2,
        "stiffness": _rows(space, "stiffness") - mass,
        "damping": damping,
        "loss": _rows(space, "loss") + _rows(space, "mode_losses"),
        "gain": gain - gain.mean(axis=0),
        "phase": phase - phase.mean(axis=0),
    }


def _rows(space: Space, kind: str) -> FloatArray:
    """One row for each parameter of a kind, (m, p)."""
    return np.eye(space.size)[space.groups[kind]]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0


@dataclass(frozen=True, eq=False)
class HeldOutPaths:
    """Errors of prediction at paths held out of a fit, rms relative to the responses at a tone."""

    total: float
    """Without the part that noise explains."""
    unexplained: float
    """Without the part that noise and the uncertain parameters explain together."""
    disagreement: FloatArray
    """Covariance (p, p) of x to add to that of the fit."""


def hold_out(fitted: FittedModel, *, progress: Progress = unseen) -> HeldOutPaths | None:
    """Predict paths from fits to the others; None where these do not determine enough of them."""
    measurement, model = fitted.problem.measurement, fitted.problem.model
    folds = (model.observed[:, None] + np.arange(len(model.rig.eras))) % HELD_OUT_FOLDS
    squares, variance = np.full((2, *measurement.values.shape), np.nan)
    free, fits = np.flatnonzero(fitted.space.uncertain), []
    noise = min(chi2(fitted), 1.0)  # readings may be better than they are stated
    for fold in range(HELD_OUT_FOLDS):
        progress(1 + fold, 1 + HELD_OUT_FOLDS)
        unseen = measurement.known & (folds == fold)
        if not unseen.any():
            continue
        if (unseen == measurement.known).all():
            return None
        shown = IdentificationProblem(model, measurement.part(folds != fold))
        found = solve(shown, fitted.best.x, fitted.space.uncertain, evaluations=_FOLD_EVALUATIONS)
        fits.append(found.x)
        plate = model.at(found.x)
        error = (plate.responses - measurement.values)[unseen]
        squares[unseen] = np.abs(error) ** 2 - 2 * noise * measurement.std[unseen] ** 2
        J = jacobian(plate)[unseen][:, free]
        covariance = linalg.inv(found.information[np.ix_(free, free)])
        variance[unseen] = ((J @ covariance) * J.conj()).sum(axis=1).real
    mean_square = np.broadcast_to(measurement.tone_rms**2, variance.shape)
    predicted = variance < _MAX_PREDICTION_ERROR**2 * mean_square
    if predicted.sum() < _MIN_PREDICTED:
        return None

    total, unexplained = (
        relative_rms(parts[predicted], mean_square[predicted])
        for parts in (squares, squares - variance)
    )
    share = (unexplained / total) ** 2 if unexplained else 0.0
    off = np.array(fits) - np.mean(fits, axis=0)
    jackknife = (1 - 1 / len(fits)) * off.T @ off
    return HeldOutPaths(total, unexplained, share * _IN_COMMON**2 * jackknife)


def relative_rms(squares: FloatArray, mean_squares: FloatArray) -> float:
    """Root mean square of errors, each relative to the rms of its responses, by their squares.

    0 where what was subtracted from the squares, such as noise, exceeds them; infinite without any
    finite value.
    """
    share = squares / mean_squares
    known = share[np.isfinite(share)]
    return float(np.sqrt(max(known.mean(), 0.0))) if len(known) else np.inf


@dataclass(frozen=True)
class UnknownQuantity:
    """A quantity that was not identified, and the measurement that would show it."""

    name: str
    before: float
    """Standard deviation before the measurement."""
    after: float
    """Standard deviation after it."""
    era: str
    """ERA to play."""
    frequency: float
    """Frequency to play [Hz]."""
    sensor: Sensor
    """Where to measure."""

    def __str__(self) -> str:
        sensor = self.sensor
        place = f"ERA {sensor.era}" if sensor.era else f"({sensor.x:.3g}, {sensor.y:.3g}) m"
        return (
            f"{self.name}: known to {100 * self.after:.2g} %, before {100 * self.before:.2g} %; "
            f"play ERA {self.era} at {self.frequency:.0f} Hz and measure at {place}"
        )


def unknowns(setting: Setting, fitted: FittedModel, posterior: Posterior) -> list[UnknownQuantity]:
    """Find the quantities that answers depend on and the measurement leaves unknown."""
    space, found = posterior.space, []
    prior = replace(posterior, covariance=np.diag(space.uncertain.astype(float)))
    built = replace(prior, space=space.as_built)
    for kind, rows in relevant(space).items():
        before, after = prior.std_of(rows), posterior.std_of(rows)
        unknown = np.flatnonzero((before > 0) & (after > _UNKNOWN * built.std_of(rows)))
        if kind == "stiffness" and setting.measurement.frequencies[0] > _SUSPENSION_FELT:
            excites = ["force_factor" in era.fields for era in setting.rig.eras]
            unknown = unknown[~np.array(excites)[unknown]]
        # Of losses and frequencies of single modes only those count that no tone has shown.
        if not len(unknown) or (kind in ("frequency", "loss") and len(unknown) < len(rows)):
            continue
        worst = unknown[best_of(after[unknown])]
        name = kind if kind in ("frequency", "loss") else _name(rows[worst], space.names)
        best = _best(setting, fitted, posterior, rows[worst])
        found.append(UnknownQuantity(name, float(before[worst]), float(after[worst]), *best))
    return found


def _name(row: FloatArray, names: tuple[str, ...]) -> str:
    return names[best_of(np.abs(row))]


def _best(
    setting: Setting, fitted: FittedModel, posterior: Posterior, row: FloatArray
) -> tuple[str, float, Sensor]:
    """ERA, frequency and sensor whose response would narrow a combination (p,) most."""
    rig, model = setting.rig, fitted.problem.model
    plate, limits = rig.plate, rig.limits
    measured = {sensor.era for sensor in model.sensors}
    more = [Sensor(f"ERA {era.name}", era.name) for era in rig.eras if era.name not in measured]
    more += [
        Sensor(f"{x:g} {y:g}", x=x * plate.length, y=y * plate.width)
        for x in _ADVISED_PLACES
        for y in _ADVISED_PLACES
    ]
    sensors = [*model.sensors, *more]
    tones = np.arange(limits.frequency_min, limits.frequency_max + 1e-9, _ADVISED_STEP)
    wider = replace(setting.model(model.mass_count, more=more), frequencies=tones, free=model.free)
    space = wider.space
    own = [space.index(name) for name in posterior.space.names]
    known, combination, unknown = posterior.within(space), np.zeros(space.size), space.std > 0
    combination[own], unknown[own] = row, False
    covariance = known.covariance + np.diag(unknown.astype(float))
    at = wider.at(known.x)
    scale = _ADVISED_NOISE * np.sqrt((np.abs(at.responses) ** 2).mean(axis=(0, 2), keepdims=True))
    direction = covariance @ (combination * space.std)
    gains = _gains(jacobian(at) / scale[..., None], covariance, direction)
    f, s, e = np.unravel_index(best_of(gains.ravel()), gains.shape)
    return rig.eras[e].name, float(tones[f]), sensors[s]


def _gains(J: ComplexArray, covariance: FloatArray, direction: FloatArray) -> FloatArray:
    """Decrease of a combination's variance by each response measured on its own, (f, s, e)."""
    total = np.zeros(J.shape[:3])
    for part in (J.real, J.imag):
        variance = ((part @ covariance) * part).sum(axis=-1)
        total += (part @ direction) ** 2 / (1 + variance)
    return total
