"""Identify a rig from responses measured in place, and report the contrast it gives.

Fitting all parameters simultaneously ends in wrong minima. Springs, damping, thickness and gains
are therefore fitted first, from several thicknesses and with extra noise that hides the rest. Next
come one additional mass, starting where it would explain most, and then all parameters with the
measured noise. A second mass is added only if it explains part of the remaining error. For a board
with a grain, the fit is then repeated with other transverse and shear moduli, which follow from the
shifts of its modes; boards of one kind differ by 10 % and more in each modulus. To first order
shifts m (k,), in standard deviations s, with covariance C, follow from logarithms d of factors on
the moduli, with prior variance D:

    d = (J^T (1 - C) J + D^-1)^-1 J^T m,   J = (v^T dK v / lambda) / s,

where the first column of J, all ones, represents a modulus that is fitted again.

A response to a moving base does not change if mass, springs and dampers are scaled together, and
neither does a contrast if all drives are. Answers depend on each natural frequency, on each spring
and damper relative to the plate's mass, and on each gain relative to the others. Levels depend on
the mean of the gains, but responses determine only its product with the mean sensor gain
(`relevant`).

The fit is validated on held-out paths from an ERA to a sensor, in five folds; the reverse of a
held-out path is held out as well. Held-out paths show the error of fields that are not measured.
Held-out tones would show only whether a resonance was measured, which the covariance shows already.
Only the part of the error that neither noise nor uncertain parameters explain counts against the
model. It also makes fits to different paths disagree in their parameters beyond their covariance (a
jackknife over groups: B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans, SIAM 1982,
ch. 3). If the measurement leaves a quantity unknown, `unknowns` names the tone and the sensor that
would determine it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from model.arrays import FloatArray, best_of, ranked_by, rms
from model.config.document import KeyPath
from model.errors import InputError
from model.estimate.fit import (
    HELD_OUT_FOLDS,
    Fit,
    are_impossible,
    errors_by_key,
    fit,
    likeliest_fit,
    parameters_of,
)
from model.estimate.forward import MODE_SHIFTS, ForwardModel, PlateValues, Sensor, Space, jacobian
from model.estimate.measurement import Measurement
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.space import inwards, plate_with, rig_with, space_of
from model.finger import Grid
from model.processes import Progress, unseen
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_mesh import mesh_of
from model.spectral.direct_solution import grain_slopes
from model.spectral.modes import PlateMesh, SpectralMesh
from model.structure.modal_elasticity import check_is_plate, check_measurable, lowest_elastic
from model.structure.plate import Plate

MAX_CHI2 = 2.0
"""Largest chi² of a model that explains a measurement, so that answers can be promised from it."""

MAX_MODE_SHIFT = 2.0
"""Largest RMS shift of the lowest modes, in standard deviations, for a well-known plate. Beyond it,
fields between the sensors are wrong even if the sensors agree."""

# Day-to-day repeatability of a drive, which a single measurement cannot show.
_DRIVE_GAIN, _DRIVE_PHASE_DEG = 0.01, 1.0

_MIN_VALUES = 16
_GAIN_STDS = 5.0  # standard errors beyond which a gain is wrong
_GAIN_ALLOWED, _PHASE_ALLOWED = (
    0.3,
    math.radians(20),
)  # limits that apply even if the rig states a larger uncertainty
_LEVEL_ALLOWED = math.log(
    2.5
)  # of the common factor of all responses; g is 9.8 m/s², an inch 25.4 mm


_EXTRA_NOISE = 0.05  # of the RMS at each frequency, in the first stages
_THICKNESSES = (0.0, 1.5, -1.5)  # start values of the first stage, in standard deviations
_FREQUENCY_MARGIN = 1.02  # because layers do not stiffen all modes equally
_GOOD = 0.5  # chi² with the extra noise; below it no further start is tried
_INWARDS = 0.6  # standard deviations; positions on an edge start this far inside
_MASS_GRID = Grid(8, 6)  # start positions of an additional mass
_MASS_STARTS = 4
_MORE_MASS_BEYOND = 1.5  # chi²
_MASS_GAINS = 25.0  # of the cost, five standard deviations

_SIMPLE, _LOCATED = (
    [name for name, kind in PARAMETER_KINDS.items() if kind.stage <= stage] for stage in (0, 1)
)

_THEORY = {
    "frequency": PARAMETER_KINDS["mode_shifts"].theory / 2,
    "stiffness": PARAMETER_KINDS["stiffness"].theory,
    "damping": PARAMETER_KINDS["damping_each"].theory,
    "place": PARAMETER_KINDS["place"].theory,
}

_MAX_PREDICTION_STD = 0.1  # of the RMS at a tone; less certain predictions prove nothing
_MIN_PREDICTED = 16  # values
_REFITTED = 8  # evaluations of a fit to the remaining paths
_IN_COMMON = 2.0  # factor on standard deviations, for errors that all fits share and no path shows

_UNKNOWN = 0.5
"""Fraction of the prior standard deviation above which a quantity counts as not identified.

If the rig states less, the prior is the one for an unmeasured plate: answers need no more.
"""

_SUSPENSION_FELT = (
    120.0  # Hz; above it, a 20 % error of a suspension changes fields by less than 5 %
)

_ADVISED_STEP = 20.0  # Hz between candidate tones for advice
_ADVISED_NOISE = 0.01  # of the RMS of the responses at a tone
_ADVISED_PLACES = (
    0.13,
    0.5,
    0.87,
)  # of the sides, candidate positions of additional sensors for advice

_GRAIN_PRIOR = 0.15  # standard deviation of the logarithms of a board's moduli within its kind
_MIN_GRAIN_CHANGE = 3e-3  # of a logarithm; smaller changes do not justify another fit
_GRAIN_STARTS = (
    1.0,
    0.85,
    1.18,
)  # factors on the transverse modulus, since fits can end in wrong minima
_GRAIN_ROUNDS = 3  # fits per start, each with the grain found by the previous one
_GRAIN_GOOD = 1.0  # chi² and mean square mode shift below which no further start is tried


@dataclass(frozen=True, eq=False)
class HeldOutPaths:
    """Prediction errors at held-out paths, RMS relative to the responses at a tone."""

    total: float
    """Without the part explained by noise."""
    unexplained: float
    """Without the part explained by noise and uncertain parameters together."""
    disagreement: FloatArray
    """Covariance (p, p) of x, to be added to the fit's covariance."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Rig identified from responses."""

    before: Rig
    """The rig as written."""
    rig: Rig
    """Rig with identified values and, if the model explains the measurement, their uncertainty."""
    fitted: Fit
    """The most likely parameters."""
    covariance: FloatArray
    """Covariance (p, p) of the parameters, widened by the disagreement of held-out paths."""
    held_out: HeldOutPaths | None
    """Prediction of held-out paths, None if there are too few."""

    @property
    def chi2(self) -> float:
        """Squared residuals per degree of freedom."""
        return self.fitted.chi2

    @property
    def values(self) -> PlateValues:
        """Values of the parameters, including sensor gains."""
        return self.fitted.plate.values

    @property
    def mode_shift(self) -> float:
        """RMS shift of the lowest modes, in standard deviations, 0 without any."""
        return _mode_shift(self.fitted)

    @property
    def is_explained(self) -> bool:
        """Whether the model explains the measurement, so that answers can rely on it."""
        return self.chi2 <= MAX_CHI2 and self.is_known_well

    @property
    def is_known_well(self) -> bool:
        """Whether the modes match the rig's plate, and therefore also the fields between
        sensors."""
        return self.mode_shift <= MAX_MODE_SHIFT

    @property
    def can_promise(self) -> bool:
        """Whether contrasts can be promised: explained, with held-out paths."""
        return self.is_explained and self.held_out is not None

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviation of each parameter in its unit (p,)."""
        return np.asarray(self.fitted.space.std * np.sqrt(np.diagonal(self.covariance)))

    def stds(self) -> dict[str, FloatArray]:
        """Standard deviations of the quantities that answers depend on, with model errors, by
        kind."""
        space = self.fitted.space
        own = {kind: std_of(rows, space, self.covariance) for kind, rows in relevant(space).items()}
        own["place"] = self.std[space.groups["place"]]
        return {
            kind: np.where(std > 0, np.hypot(std, _THEORY.get(kind, 0.0)), 0.0)
            for kind, std in own.items()
        }

    def within(self, space: Space) -> tuple[FloatArray, FloatArray]:
        """Return parameters (p,) and covariance (p, p) in a larger space; additional ones are 0 and
        known."""
        own = [space.index(name) for name in self.fitted.space.names]
        x, covariance = np.zeros(space.size), np.zeros((space.size, space.size))
        x[own], covariance[np.ix_(own, own)] = self.fitted.x, self.covariance
        return x, covariance

    def uncertainty(self, unexplained: float) -> Uncertainty:
        """Return the `uncertainty` of the identified rig.

        unexplained: fraction of the fields that the model does not explain. Fingers and harmonics
        keep their uncertainty. common_gain, which no fit narrows, is added to the error of the mean
        gain.
        """
        space, before = self.fitted.space, self.fitted.model.rig.uncertainty
        mean = _rows(space, "gain").mean(axis=0, keepdims=True)
        by_kind = {kind: rms(std) for kind, std in self.stds().items()}
        return Uncertainty.clipped(
            gain=math.hypot(by_kind["gain"], _DRIVE_GAIN),
            phase_deg=math.hypot(math.degrees(by_kind["phase"]), _DRIVE_PHASE_DEG),
            **Uncertainty.of_frequency(by_kind["frequency"]),
            stiffness=by_kind["stiffness"],
            damping=math.exp(max(by_kind["damping"], by_kind["loss"])),
            fingertip=before.fingertip,
            common_gain=math.hypot(before.common_gain, std_of(mean, space, self.covariance)[0]),
            field=unexplained,
            place=by_kind["place"],
            harmonic=before.harmonic,
            supports=rms(self.std[space.groups["supports"]]),
            weather=before.weather,
            foreign_mass=before.foreign_mass,
        )


def identify(rig: Rig, measurement: Measurement, *, progress: Progress = unseen) -> Identification:
    """Identify a rig from a measurement on it.

    progress: called with the number of fits done and the total (one full fit, one per fold). Raises
    InputError for a rig with a part that does not scale, for a plate that was not linear or has
    changed during the measurement, for impossible gains of drives or sensors (another unit, a wrong
    sign), and for undetermined quantities that answers depend on, with the tone and the sensor that
    would determine them.
    """
    _check(rig, measurement)
    fitted = fit_board(rig, measurement)
    board = fitted.model.rig
    found = Identification(rig, board, fitted, fitted.stated_covariance, None)
    _check_level(found.values)
    if found.is_explained:
        _check_gains(board, measurement, found.values, fitted.space)
    unknown = unknowns(found)
    if unknown:
        raise InputError("measurement must show more: " + "; ".join(unknown))
    held_out, uncertainty = hold_out(fitted, progress=progress), board.uncertainty
    if found.is_explained:
        uncertainty = found.uncertainty(held_out.unexplained if held_out else 0.0)
    covariance = found.covariance + (held_out.disagreement if held_out else 0.0)
    progress(1 + HELD_OUT_FOLDS, 1 + HELD_OUT_FOLDS)
    known = rig_with(board, found.values, uncertainty)
    return replace(found, rig=known, covariance=covariance, held_out=held_out)


def _check(rig: Rig, measurement: Measurement) -> None:
    check_measurable(rig.plate)  # remaining uncertainty of modes is written as thickness
    names = [era.name for era in rig.eras]
    for sensor in measurement.sensors:
        if sensor.era and sensor.era not in names:
            raise InputError(
                f"sensor {sensor.name} must be at one of {', '.join(names)}, got {sensor.era}"
            )
        if not sensor.era and not rig.plate.contains(sensor.x, sensor.y):
            raise InputError(
                f"sensor {sensor.name} must be on the plate, got ({sensor.x:g}, {sensor.y:g}) m"
            )
    if measurement.count < _MIN_VALUES:
        raise InputError(
            f"a measurement must have at least {_MIN_VALUES} values, got {measurement.count}; "
            "play more tones"
        )
    limits, tones = rig.limits, measurement.frequencies
    if tones[0] < limits.frequency_min or tones[-1] > limits.frequency_max:
        raise InputError(
            "tones must be within the rig's limits.frequency of "
            f"{limits.frequency_min:g} to {limits.frequency_max:g} Hz, got {tones[0]:g} to "
            f"{tones[-1]:g} Hz"
        )
    measurement.check()


def solved_for(rig: Rig, frequency_max: float) -> FreePlate:
    """Return the free plate of a rig, solved for tones up to a frequency [Hz]."""
    check_is_plate(rig.plate, "a fit or check with measurements")
    mesh: PlateMesh = rig.mesh
    if not isinstance(mesh, SpectralMesh):
        # Positions move freely only on a plate with global basis functions.
        mesh = mesh_of("auto", rig.plate, frequency_max=rig.limits.frequency_max)
    return solve_free_plate(rig.plate, mesh, frequency_max=max(frequency_max, 200.0))


def model_of(
    rig: Rig,
    free: FreePlate,
    measurement: Measurement,
    *,
    masses: int,
    more: Sequence[Sensor] = (),
) -> ForwardModel:
    """Return the model of a rig with additional masses at the measured tones.

    free: solved free plate of the rig; masses: their number; more: additional sensors.
    """
    sensors = (*measurement.sensors, *more)
    space = space_of(
        rig,
        [sensor.name for sensor in sensors],
        rig.uncertainty,
        drives_lag=measurement.drives_lag,
        masses=masses,
        mode_count=len(lowest_elastic(free.modes.eigenvalues, MODE_SHIFTS)),
    )
    return ForwardModel(rig, sensors, measurement.frequencies, space, free)


def fit_board(rig: Rig, measurement: Measurement) -> Fit:
    """Fit in stages; for a board with a grain, fit again with the grain found.

    The rig of the resulting model has this grain.
    """
    if rig.plate.material.orthotropy is None:
        return fit_in_stages(rig, measurement)
    found: list[Fit] = []
    for start in _GRAIN_STARTS:
        found.append(fit_in_stages(_with_grain(rig, start, 1.0), measurement))
        for _ in range(_GRAIN_ROUNDS):
            across, shear = _grain_shown(found[-1])
            if max(abs(across), abs(shear)) < _MIN_GRAIN_CHANGE:
                break
            other = _with_grain(found[-1].model.rig, math.exp(across), math.exp(shear))
            found.append(fit_in_stages(other, measurement))
        if any(
            each.chi2 <= _GRAIN_GOOD and _mode_shift(each) ** 2 <= _GRAIN_GOOD for each in found
        ):
            break
    return likeliest_fit(found)


def _mode_shift(found: Fit) -> float:
    """Return the RMS shift of the lowest modes, in standard deviations, 0 without any."""
    return rms(found.x[found.space.of("mode_shifts")])


def _grain_shown(found: Fit) -> tuple[float, float]:
    """Return logarithms of factors on the transverse and shear moduli from the shifts of modes."""
    shifts, free = found.space.of("mode_shifts"), found.model.free
    lowest = lowest_elastic(free.modes.eigenvalues, int(shifts.sum()))
    shapes = [each[:, lowest] for each in free.modes.unknowns(np.empty((0, 3)))]
    by_grain = grain_slopes(free.plate, (free.mesh.nx, free.mesh.ny), shapes)
    relative = by_grain / free.modes.eigenvalues[lowest]
    J = np.column_stack([np.ones(len(lowest)), *relative]) / PARAMETER_KINDS["mode_shifts"].std
    shown = np.eye(len(lowest)) - found.stated_covariance[np.ix_(shifts, shifts)]
    information = J.T @ shown @ J + np.eye(3) / _GRAIN_PRIOR**2
    _, across, shear = np.linalg.solve(information, J.T @ found.x[shifts]).tolist()
    return across, shear


def _with_grain(rig: Rig, across: float, shear: float) -> Rig:
    """Return the rig of a board with transverse and shear moduli multiplied by factors."""
    of = rig.plate.material.shares
    shares = replace(of, e2=of.e2 * across, g12=of.g12 * shear)
    material = replace(rig.plate.material, orthotropy=shares)
    return replace(rig, plate=replace(rig.plate, material=material))


def fit_in_stages(rig: Rig, measurement: Measurement) -> Fit:
    """Find the most likely parameters of a measurement."""
    free = solved_for(rig, float(measurement.frequencies[-1]))
    std = np.hypot(measurement.std, _EXTRA_NOISE * measurement.tone_rms)
    rough, model = replace(measurement, errors=std), model_of(rig, free, measurement, masses=1)
    located = _with_mass(model, rough, _simple(model, rough).x, number=0)
    found = _in_full(located, measurement)
    if found.chi2 > _MORE_MASS_BEYOND:
        wider = model_of(rig, free, measurement, masses=2)
        x = np.insert(found.x, found.space.groups["masses"].stop, np.zeros(3))
        more = _in_full(_with_mass(wider, rough, x, number=1), measurement)
        if more.cost <= found.cost - _MASS_GAINS / 2:
            found = more
    # Solve the plate for its identified thickness and modulus, as for a table.
    identified = plate_with(rig.plate, found.plate.values)
    identified = replace(identified, mode_deviations=rig.plate.mode_deviations)
    anew = replace(found.model, free=solved_with_modes_of(free, identified), last_places={})
    return fit(anew, measurement, start=found.x)


def _simple(model: ForwardModel, rough: Measurement) -> Fit:
    """Fit without form errors from several thicknesses."""
    found = []
    for thickness in _THICKNESSES:
        start = np.zeros(model.space.size)
        start[model.space.groups["thickness"]] = thickness
        found.append(fit(model, rough, searched=model.space.of(*_SIMPLE), start=start))
        r, _ = likeliest_fit(found).of_values
        if r @ r < _GOOD * len(r):
            break
    return likeliest_fit(found)


def _with_mass(model: ForwardModel, rough: Measurement, x: FloatArray, *, number: int) -> list[Fit]:
    """Fit positions and an additional mass, starting where it explains most, and from none; best
    first."""
    space, plate = model.space, model.rig.plate
    start = inwards(space, x, by=_INWARDS)
    others = space.uncertain & ~space.of("masses", "mode_shifts", "mode_losses")
    linear = fit(model, rough, searched=others, start=start, evaluations=1)
    points, own = _MASS_GRID.centres(plate), space.groups["masses"].start + 3 * number
    starts = [start]
    for point, mass in linear.loads(points, std=space.std[own])[:_MASS_STARTS]:
        moved = start.copy()
        off = points[point] - [plate.length / 2, plate.width / 2]
        moved[own : own + 3] = [mass, *off] / space.std[own : own + 3]
        starts.append(moved)
    located = space.of(*_LOCATED)
    fits = [fit(model, rough, searched=located, start=each) for each in starts]
    return ranked_by(fits, lambda each: -each.cost)


def _in_full(starts: list[Fit], measurement: Measurement) -> Fit:
    """Fit all parameters with the measured noise, from the two best starts."""
    return likeliest_fit([fit(each.model, measurement, start=each.x) for each in starts[:2]])


def solved_with_modes_of(free: FreePlate, plate: Plate) -> FreePlate:
    """Solve a plate on another one's mesh, with all of its modes even if it is stiffer."""
    stiffer = plate.lowest_bending_frequency / free.plate.lowest_bending_frequency
    frequency_max = free.frequency_max * max(stiffer * _FREQUENCY_MARGIN, 1.0)
    return solve_free_plate(plate, free.mesh, frequency_max=frequency_max)


def _check_level(values: PlateValues) -> None:
    """Raise InputError if all responses are far too large or small because of a wrong unit.

    Also applied to poor fits, since a wrong unit can be the reason.
    """
    drive_level = np.log(np.abs(values["gain"])).mean()
    sensor_level = np.log(np.abs(values["sensor_gain"])).mean()
    level = float(drive_level + sensor_level)
    if abs(level) > _LEVEL_ALLOWED:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got responses "
            f"of about {math.exp(level):.2g} times the rig's; check the units of sensors and drives"
        )


def _check_gains(rig: Rig, measurement: Measurement, values: PlateValues, space: Space) -> None:
    """Raise InputError for impossible gains of drives or sensors: a wrong unit, sign or plug.

    A response determines only the product of a drive's and a sensor's gain. The fit therefore
    splits an error between both, and its residuals do not show a wrong unit or sign.
    """
    wrong = []
    for kind, names in (
        ("gain", [f"drive {era.name}" for era in rig.eras]),
        ("sensor_gain", [f"sensor {sensor.name}" for sensor in measurement.sensors]),
    ):
        gains = values[kind]
        size, phase = (
            max(allowed, _GAIN_STDS * space.std[space.groups[each]].max())
            for each, allowed in (
                (kind, _GAIN_ALLOWED),
                (kind.replace("gain", "phase"), _PHASE_ALLOWED),
            )
        )
        wrong += [
            f"{names[n]} {abs(gains[n]):.2f} at {np.degrees(np.angle(gains[n])):.0f}°"
            for n in np.flatnonzero(are_impossible(gains, size, phase))
        ]
    if wrong:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got gains of "
            f"{'; '.join(wrong)}; check unit, sign and plug of each sensor and drive"
        )


def relevant(space: Space) -> dict[str, FloatArray]:
    """Return combinations (m, p) of parameters that answers depend on, by name."""
    mass = _rows(space, "thickness")
    by_rigidity = mass + _rows(space, "modulus") / 2
    gain, phase = _rows(space, "gain"), _rows(space, "phase")
    damping = _rows(space, "damping_each") + _rows(space, "damping") - mass
    factor = space.groups["force_factor"]
    if factor.stop > factor.start:
        # An exciter's coil both damps and drives; the contribution of its suspension hardly shows
        # alone.
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
    """Return one row per parameter of a kind, (m, p)."""
    return np.eye(space.size)[space.groups[kind]]


def std_of(combinations: FloatArray, space: Space, covariance: FloatArray) -> FloatArray:
    """Return standard deviations (m,) of linear combinations (m, p) of parameters in their
    units."""
    scaled = combinations * space.std
    return np.asarray(np.sqrt(np.einsum("mp,pq,mq->m", scaled, covariance, scaled)))


def hold_out(found: Fit, *, progress: Progress = unseen) -> HeldOutPaths | None:
    """Predict paths from fits to the others; None if the fits determine too few paths."""
    measurement, model = found.measurement, found.model
    folds = (model.observed[:, None] + np.arange(len(model.rig.eras))) % HELD_OUT_FOLDS
    squares, variance = np.full((2, *measurement.values.shape), np.nan)
    own = np.flatnonzero(found.searched)
    fits, noise = [], min(found.chi2, 1.0)  # readings can be better than stated
    for fold in range(HELD_OUT_FOLDS):
        progress(1 + fold, 1 + HELD_OUT_FOLDS)
        hidden = measurement.known & (folds == fold)
        if not hidden.any():
            continue
        if (hidden == measurement.known).all():
            return None
        shown = measurement.part(~hidden)
        other = fit(model, shown, searched=found.searched, start=found.x, evaluations=_REFITTED)
        J = jacobian(other.plate, found.searched)[..., own][hidden]
        covariance = other.stated_covariance[np.ix_(own, own)]
        variance[hidden] = ((J @ covariance) * J.conj()).sum(axis=1).real
        errors = np.abs(other.plate.responses - measurement.values)[hidden] ** 2
        squares[hidden] = errors - 2 * noise * measurement.std[hidden] ** 2
        fits.append(other.x)
    mean_square = np.broadcast_to(measurement.tone_rms**2, variance.shape)
    predicted = variance < _MAX_PREDICTION_STD**2 * mean_square
    if predicted.sum() < _MIN_PREDICTED:
        return None
    total, unexplained = (
        # The subtracted noise can exceed the errors.
        math.sqrt(max((parts[predicted] / mean_square[predicted]).mean(), 0.0))
        for parts in (squares, squares - variance)
    )
    share = (unexplained / total) ** 2 if unexplained else 0.0
    off = np.array(fits) - np.mean(fits, axis=0)
    jackknife = (1 - 1 / len(fits)) * off.T @ off
    return HeldOutPaths(total, unexplained, share * _IN_COMMON**2 * jackknife)


def unknowns(found: Identification) -> list[str]:
    """Describe quantities that answers depend on but the measurement leaves unknown, with advice.

    States their standard deviations before and after the measurement.
    """
    space, model, rows = found.fitted.space, found.fitted.model, []
    prior = np.diag(space.uncertain.astype(float))
    for kind, combinations in relevant(space).items():
        before, after = (std_of(combinations, space, each) for each in (prior, found.covariance))
        built = std_of(combinations, space.as_built, prior)
        unknown = np.flatnonzero((before > 0) & (after > _UNKNOWN * built))
        if kind == "stiffness" and model.frequencies[0] > _SUSPENSION_FELT:
            excites = ["force_factor" in era.fields for era in model.rig.eras]
            unknown = unknown[~np.array(excites)[unknown]]
        # Losses and frequencies of single modes count only if no tone has shown them.
        of_modes = kind in ("frequency", "loss")
        if not len(unknown) or (of_modes and len(unknown) < len(combinations)):
            continue
        worst = unknown[best_of(after[unknown])]
        name = kind if of_modes else space.names[best_of(np.abs(combinations[worst]))]
        rows.append(
            f"{name}: known to {100 * after[worst]:.2g} %, before {100 * before[worst]:.2g} %; "
            f"{_advice(found, combinations[worst])}"
        )
    return rows


def _advice(found: Identification, combination: FloatArray) -> str:
    """Describe the ERA, tone and position whose response would narrow a combination (p,) most."""
    fitted = found.fitted
    model, rig = fitted.model, fitted.model.rig
    limits, sides = rig.limits, (rig.plate.length, rig.plate.width)
    measured = {sensor.era for sensor in model.sensors}
    more = [Sensor(f"ERA {era.name}", era.name) for era in rig.eras if era.name not in measured]
    more += [
        Sensor(f"{x:g} {y:g}", x=x * sides[0], y=y * sides[1])
        for x in _ADVISED_PLACES
        for y in _ADVISED_PLACES
    ]
    tones = np.arange(limits.frequency_min, limits.frequency_max + 1e-9, _ADVISED_STEP)
    wider = model_of(rig, model.free, fitted.measurement, masses=model.mass_count, more=more)
    wider = replace(wider, frequencies=tones)
    x, covariance = found.within(wider.space)
    own = [wider.space.index(name) for name in fitted.space.names]
    direction, unknown = np.zeros(wider.space.size), wider.space.std > 0
    direction[own], unknown[own] = combination, False
    covariance += np.diag(unknown.astype(float))
    at = wider.at(x)
    noise = _ADVISED_NOISE * np.sqrt((np.abs(at.responses) ** 2).mean(axis=(0, 2), keepdims=True))
    narrowed = np.zeros(at.responses.shape)
    direction = covariance @ (direction * wider.space.std)
    slopes = jacobian(at) / noise[..., None]
    for part in (slopes.real, slopes.imag):  # each response alone
        variance = ((part @ covariance) * part).sum(axis=-1)
        narrowed += (part @ direction) ** 2 / (1 + variance)
    f, s, e = map(int, np.unravel_index(best_of(narrowed.ravel()), narrowed.shape))
    sensor = wider.sensors[s]
    place = f"ERA {sensor.era}" if sensor.era else f"({sensor.x:.3g}, {sensor.y:.3g}) m"
    return f"play ERA {rig.eras[e].name} at {tones[f]:.0f} Hz and measure at {place}"


def identification_errors(found: Identification) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    rig, groups = found.rig, found.fitted.space.groups
    plate, eras, feet = (
        [found.std[groups[kind]] for kind in kinds]
        for kinds in (("thickness", "loss"), ("stiffness", "damping_each"), ("supports",))
    )
    relative = np.concatenate([*plate, np.transpose(eras).ravel(), *feet])
    own = parameters_of(rig, ("thickness", "loss_factor"), ("stiffness", "damping"), rig.foot_names)
    stated = zip(own, relative, strict=False)  # feet without a spring have no error
    return errors_by_key(rig, ((each, each.before * error) for each, error in stated))
