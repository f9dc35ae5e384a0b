"""Identify a rig from responses measured in place: its values, their covariance and uncertainty.

`model.estimate.staged_fit` finds the most likely parameters. A response to a moving base does not
change if mass, springs and dampers are scaled together, and neither does a contrast if all drives
are. Answers depend on each natural frequency, on each spring and damper relative to the plate's
mass, and on each gain relative to the others. Levels depend on the mean of the gains, but responses
determine only its product with the mean sensor gain (`relevant`).

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
from numpy.typing import NDArray

from model.arrays import FloatArray, best_of, rms
from model.config.document import KeyPath
from model.errors import InputError
from model.estimate.fit import HELD_OUT_FOLDS, fit
from model.estimate.forward import ForwardModel, PlateAt, Sensor
from model.estimate.gains import are_impossible
from model.estimate.measurement import Measurement
from model.estimate.parameter_space import PlateValues, Space
from model.estimate.parameters import PARAMETER_KINDS, jacobian
from model.estimate.rig_parameters import rig_with
from model.estimate.sensed_plate import errors_by_key, parameters_of
from model.estimate.staged_fit import RigFit, fit_board, mode_shift, model_of
from model.processes import Progress, unseen
from model.rig.rig import Rig, Uncertainty
from model.structure.modal_elasticity import check_measurable

MAX_CHI2 = 2.0
"""Largest chi² of a model that explains a measurement, so that answers can be promised from it."""

MAX_MODE_SHIFT = 2.0
"""Largest RMS shift of the lowest modes, relative to their prior, for a well-known plate. Beyond
it, fields between the sensors are wrong even if the sensors agree."""

# Day-to-day repeatability of a drive, which a single measurement cannot show.
_DRIVE_GAIN, _DRIVE_PHASE_DEG = 0.01, 1.0

_MIN_VALUES = 16
_GAIN_STDS = 5.0  # standard errors beyond which a gain is wrong
# Limits that apply even if the rig states a larger uncertainty.
_GAIN_ALLOWED, _PHASE_ALLOWED = 0.3, math.radians(20)
# Of the common factor of all responses; g is 9.8 m/s², an inch 25.4 mm.
_LEVEL_ALLOWED = math.log(2.5)

_THEORY = {
    "frequency": PARAMETER_KINDS["mode_shifts"].theory / 2,
    "stiffness": PARAMETER_KINDS["stiffness"].theory,
    "damping": PARAMETER_KINDS["damping_each"].theory,
    "place": PARAMETER_KINDS["place"].theory,
}

_MAX_PREDICTION_STD = 0.1  # of the RMS at a tone; less certain predictions prove nothing
_MIN_PREDICTED = 16  # values
_REFITTED = 8  # evaluations of a fit to the remaining paths
_IN_COMMON = 2.0  # factor on standard errors, for errors that all fits share and no path shows

_UNKNOWN = 0.5
"""Fraction of the prior above which a quantity counts as not identified.

If the rig states less, the prior is the one for an unmeasured plate: answers need no more.
"""

# Hz; above it, a 20 % error of a suspension changes fields by less than 5 %.
_SUSPENSION_FELT = 120.0

_ADVISED_STEP = 20.0  # Hz between candidate tones for advice
_ADVISED_NOISE = 0.01  # of the RMS of the responses at a tone
# Of the sides, candidate positions of additional sensors for advice.
_ADVISED_PLACES = (0.13, 0.5, 0.87)


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
    fitted: RigFit
    """The most likely parameters."""
    covariance: FloatArray
    """Covariance (p, p) of the parameters, widened by the disagreement of held-out paths, for
    their standard errors."""
    held_out: HeldOutPaths | None
    """Prediction of held-out paths, None if there are too few."""

    @property
    def chi2(self) -> float:
        """Squared residuals per degree of freedom."""
        return self.fitted.chi2

    @property
    def values(self) -> PlateValues:
        """Values of the parameters, including sensor gains."""
        return self.fitted.fitted_plate.values

    @property
    def mode_shift(self) -> float:
        """RMS shift of the lowest modes, relative to their prior, 0 without any."""
        return mode_shift(self.fitted)

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
        """Standard error of each parameter in its unit (p,)."""
        return _parameter_stds(self.fitted.space, self.covariance)

    def stds(self) -> dict[str, FloatArray]:
        """Standard errors of the quantities that answers depend on, with model errors, by
        kind."""
        return _relevant_stds(self.fitted.space, self.covariance)

    def within(self, space: Space) -> tuple[FloatArray, FloatArray]:
        """Return parameters (p,) and covariance (p, p) in a larger space; additional ones are 0 and
        exactly known."""
        numbers = [space.index(name) for name in self.fitted.space.names]
        x = np.zeros(space.size)
        x[numbers] = self.fitted.x
        covariance = np.zeros((space.size, space.size))
        covariance[np.ix_(numbers, numbers)] = self.covariance
        return x, covariance

    def uncertainty(self, unexplained: float) -> Uncertainty:
        """Return the `uncertainty` of the identified rig.

        unexplained: fraction of the fields that the model does not explain. The disagreement of
        held-out paths is left out, because `unexplained` states the same error. Fingers and
        harmonics keep their uncertainty. common_gain, which no fit narrows, is added to the error
        of the mean gain.
        """
        space = self.fitted.space
        covariance = self.fitted.stated_covariance
        original = self.fitted.model.rig.uncertainty
        mean_gain = _rows(space, "gain").mean(axis=0, keepdims=True)
        mean_gain_std = std_of(mean_gain, space, covariance)[0]
        stds = _relevant_stds(space, covariance)
        errors = {kind: rms(std) for kind, std in stds.items()}
        return Uncertainty.clipped(
            gain=math.hypot(errors["gain"], _DRIVE_GAIN),
            phase_deg=math.hypot(math.degrees(errors["phase"]), _DRIVE_PHASE_DEG),
            **Uncertainty.of_frequency(errors["frequency"]),
            stiffness=errors["stiffness"],
            damping=math.exp(max(errors["damping"], errors["loss"])),
            fingertip=original.fingertip,
            common_gain=math.hypot(original.common_gain, mean_gain_std),
            field=unexplained,
            place=errors["place"],
            harmonic=original.harmonic,
            supports=rms(_parameter_stds(space, covariance)[space.groups["supports"]]),
            weather=original.weather,
            foreign_mass=original.foreign_mass,
        )


def _parameter_stds(space: Space, covariance: FloatArray) -> FloatArray:
    """Return the standard error of each parameter in its unit (p,)."""
    return space.std * np.sqrt(np.diagonal(covariance))


def _relevant_stds(space: Space, covariance: FloatArray) -> dict[str, FloatArray]:
    """Return standard errors of the quantities that answers depend on, with model errors, by
    kind."""
    stds = {kind: std_of(rows, space, covariance) for kind, rows in relevant(space).items()}
    stds["place"] = _parameter_stds(space, covariance)[space.groups["place"]]
    for kind, std in stds.items():
        stds[kind] = np.where(std > 0, np.hypot(std, _THEORY.get(kind, 0.0)), 0.0)
    return stds


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
    identification = Identification(
        before=rig,
        rig=board,
        fitted=fitted,
        covariance=fitted.stated_covariance,
        held_out=None,
    )
    values = identification.values
    _check_level(values)
    if identification.is_explained:
        _check_gains(board, measurement, values, fitted.space)
    unknown = unknowns(identification)
    if unknown:
        raise InputError("measurement must show more: " + "; ".join(unknown))
    held_out = hold_out(fitted, progress=progress)
    uncertainty = board.uncertainty
    if identification.is_explained:
        uncertainty = identification.uncertainty(held_out.unexplained if held_out else 0.0)
    covariance = fitted.stated_covariance
    if held_out:
        covariance = covariance + held_out.disagreement
    progress(1 + HELD_OUT_FOLDS, 1 + HELD_OUT_FOLDS)
    return replace(
        identification,
        rig=rig_with(board, values, uncertainty),
        covariance=covariance,
        held_out=held_out,
    )


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
    limits = rig.limits
    lowest, highest = measurement.frequencies[[0, -1]].tolist()
    if lowest < limits.frequency_min or highest > limits.frequency_max:
        raise InputError(
            "tones must be within the rig's limits.frequency of "
            f"{limits.frequency_min:g} to {limits.frequency_max:g} Hz, got {lowest:g} to "
            f"{highest:g} Hz"
        )
    measurement.check()


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
    drives = [f"drive {era.name}" for era in rig.eras]
    sensors = [f"sensor {sensor.name}" for sensor in measurement.sensors]
    wrong = _wrong_gains(drives, "gain", "phase", values, space)
    wrong += _wrong_gains(sensors, "sensor_gain", "sensor_phase", values, space)
    if wrong:
        raise InputError(
            "measurement must be acceleration in m/s² along the drives' motion, got gains of "
            f"{'; '.join(wrong)}; check unit, sign and plug of each sensor and drive"
        )


def _wrong_gains(
    names: Sequence[str], gain_kind: str, phase_kind: str, values: PlateValues, space: Space
) -> list[str]:
    """List impossible gains of the given kinds, by name."""
    gains = values[gain_kind]
    max_size = max(_GAIN_ALLOWED, _GAIN_STDS * space.std[space.groups[gain_kind]].max())
    max_phase = max(_PHASE_ALLOWED, _GAIN_STDS * space.std[space.groups[phase_kind]].max())
    wrong = []
    for n in np.flatnonzero(are_impossible(gains, max_size, max_phase)).tolist():
        phase = np.degrees(np.angle(gains[n]))
        wrong.append(f"{names[n]} {abs(gains[n]):.2f} at {phase:.0f}°")
    return wrong


def relevant(space: Space) -> dict[str, FloatArray]:
    """Return combinations (m, p) of parameters that answers depend on, by name."""
    mass = _rows(space, "thickness")
    rigidity = mass + _rows(space, "modulus") / 2
    gain = _rows(space, "gain")
    phase = _rows(space, "phase")
    damping = _rows(space, "damping_each") + _rows(space, "damping") - mass
    factor = space.groups["force_factor"]
    if factor.stop > factor.start:
        # An exciter's coil both damps and drives; the contribution of its suspension hardly shows
        # alone.
        damping = damping[space.std[factor] == 0]
        gain = gain + _rows(space, "force_factor")
    return {
        "frequency": rigidity + _rows(space, "mode_shifts") / 2,
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
    """Return standard errors (m,) of linear combinations (m, p) of parameters in their units."""
    scaled = combinations * space.std
    return np.asarray(np.sqrt(np.einsum("mp,pq,mq->m", scaled, covariance, scaled)))


def hold_out(result: RigFit, *, progress: Progress = unseen) -> HeldOutPaths | None:
    """Predict paths from fits to the others; None if the fits determine too few paths."""
    measurement = result.measurement
    model = result.model
    folds = (model.observed[:, None] + np.arange(len(model.rig.eras))) % HELD_OUT_FOLDS
    squares = np.full(measurement.values.shape, np.nan)
    variance = squares.copy()
    noise = min(result.chi2, 1.0)  # readings can be better than stated
    fitted_x = []
    for fold in range(HELD_OUT_FOLDS):
        progress(1 + fold, 1 + HELD_OUT_FOLDS)
        hidden = measurement.known & (folds == fold)
        if not hidden.any():
            continue
        if (hidden == measurement.known).all():
            return None
        partial = fit(
            model,
            measurement.part(~hidden),
            searched=result.searched,
            start=result.x,
            evaluations=_REFITTED,
        )
        variance[hidden] = _prediction_variance(partial, hidden)
        errors = np.abs(partial.fitted_plate.responses - measurement.values)[hidden]
        squares[hidden] = errors**2 - 2 * noise * measurement.std[hidden] ** 2
        fitted_x.append(partial.x)
    mean_square = np.broadcast_to(measurement.tone_rms**2, variance.shape)
    is_determined = variance < _MAX_PREDICTION_STD**2 * mean_square
    if is_determined.sum() < _MIN_PREDICTED:
        return None
    mean_square = mean_square[is_determined]
    total = _positive_root(squares[is_determined] / mean_square)
    unexplained = _positive_root((squares - variance)[is_determined] / mean_square)
    share = (unexplained / total) ** 2 if unexplained else 0.0
    disagreement = share * _IN_COMMON**2 * _jackknife_covariance(np.array(fitted_x))
    return HeldOutPaths(total, unexplained, disagreement)


def _jackknife_covariance(estimates: FloatArray) -> FloatArray:
    """Return the covariance (p, p) of an estimate, from estimates (g, p) without one of g groups.

    (g - 1) / g times the sum over groups of the outer product of differences from the mean.
    """
    difference = estimates - np.mean(estimates, axis=0)
    return np.asarray((1 - 1 / len(estimates)) * difference.T @ difference)


def _prediction_variance(partial: RigFit, hidden: NDArray[np.bool_]) -> FloatArray:
    """Return the variance of predicted responses at a mask, due to uncertain parameters."""
    numbers = np.flatnonzero(partial.searched)
    J = jacobian(partial.fitted_plate, partial.searched)[..., numbers][hidden]
    covariance = partial.stated_covariance[np.ix_(numbers, numbers)]
    return np.asarray(((J @ covariance) * J.conj()).sum(axis=1).real)


def _positive_root(squares: FloatArray) -> float:
    """Return the root of a mean square, 0 if noise that was subtracted exceeds the errors."""
    return math.sqrt(max(squares.mean(), 0.0))


def unknowns(identification: Identification) -> list[str]:
    """Describe quantities that answers depend on but the measurement leaves unknown, with advice.

    States their standard errors before and after the measurement.
    """
    space = identification.fitted.space
    prior = np.diag(space.uncertain.astype(float))
    rows = []
    for kind, combinations in relevant(space).items():
        prior_std = std_of(combinations, space, prior)
        std = std_of(combinations, space, identification.covariance)
        built_std = std_of(combinations, space.as_built, prior)
        is_unknown = (prior_std > 0) & (std > _UNKNOWN * built_std)
        unknown = np.flatnonzero(is_unknown & _are_needed(identification.fitted.model, kind))
        # Losses and frequencies of single modes count only if no tone has shown them.
        is_of_modes = kind in ("frequency", "loss")
        if not len(unknown) or (is_of_modes and len(unknown) < len(combinations)):
            continue
        worst = unknown[best_of(std[unknown])]
        name = kind
        if not is_of_modes:
            name = space.names[best_of(np.abs(combinations[worst]))]
        rows.append(
            f"{name}: known to {_error_text(kind, std[worst])}, "
            f"before {_error_text(kind, prior_std[worst])}; "
            f"{_advice(identification, combinations[worst])}"
        )
    return rows


def _are_needed(model: ForwardModel, kind: str) -> NDArray[np.bool_]:
    """Return whether tones depend on the quantities of a kind, (m,) or () for all.

    Tones far above the resonance of an exciter do not depend on the stiffness of its suspension.
    """
    if kind != "stiffness" or model.frequencies[0] <= _SUSPENSION_FELT:
        return np.array(True)
    return np.array(["force_factor" not in era.fields for era in model.rig.eras])


def _error_text(kind: str, std: float) -> str:
    """Format a standard error of a kind in `relevant`: phases in degrees, others in per cent."""
    if kind == "phase":
        return f"{math.degrees(std):.2g}°"
    return f"{100 * std:.2g} %"


def _advice(identification: Identification, combination: FloatArray) -> str:
    """Describe the ERA, tone and position whose response would narrow a combination (p,) most."""
    space = identification.fitted.space
    model = _advised_model(identification.fitted)
    x, covariance = identification.within(model.space)
    numbers = [model.space.index(name) for name in space.names]
    is_new = model.space.std > 0
    is_new[numbers] = False
    covariance += np.diag(is_new.astype(float))
    direction = np.zeros(model.space.size)
    direction[numbers] = combination
    narrowed = _narrowing(model.at(x), covariance, covariance @ (direction * model.space.std))
    f, s, e = map(int, np.unravel_index(best_of(narrowed.ravel()), narrowed.shape))
    era = model.rig.eras[e].name
    sensor = model.sensors[s]
    place = f"ERA {sensor.era}" if sensor.era else f"({sensor.x:.3g}, {sensor.y:.3g}) m"
    return f"play ERA {era} at {model.frequencies[f]:.0f} Hz and measure at {place}"


def _advised_model(fitted: RigFit) -> ForwardModel:
    """Return the model with all tones and sensors that advice can name."""
    model = fitted.model
    measured = {sensor.era for sensor in model.sensors}
    more = []
    for era in model.rig.eras:
        if era.name not in measured:
            more.append(Sensor(f"ERA {era.name}", era.name))
    length, width = model.sides.tolist()
    for x in _ADVISED_PLACES:
        for y in _ADVISED_PLACES:
            more.append(Sensor(f"{x:g} {y:g}", x=x * length, y=y * width))
    limits = model.rig.limits
    tones = np.arange(limits.frequency_min, limits.frequency_max + 1e-9, _ADVISED_STEP)
    wider = model_of(model.rig, model.free, fitted.measurement, masses=model.mass_count, more=more)
    return replace(wider, frequencies=tones)


def _narrowing(plate: PlateAt, covariance: FloatArray, direction: FloatArray) -> FloatArray:
    """Return how much each response alone reduces the variance of a combination (f, s, n).

    direction (p,): covariance of the combination with all parameters.
    """
    mean_square = (np.abs(plate.responses) ** 2).mean(axis=(0, 2), keepdims=True)
    noise = _ADVISED_NOISE * np.sqrt(mean_square)
    slopes = jacobian(plate) / noise[..., None]
    narrowed = np.zeros(plate.responses.shape)
    for part in (slopes.real, slopes.imag):
        variance = ((part @ covariance) * part).sum(axis=-1)
        narrowed += (part @ direction) ** 2 / (1 + variance)
    return narrowed


def identification_errors(identification: Identification) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    rig = identification.rig
    groups = identification.fitted.space.groups
    std = {kind: identification.std[part] for kind, part in groups.items()}
    of_eras = np.transpose([std["stiffness"], std["damping_each"]]).ravel()
    relative = np.concatenate([std["thickness"], std["loss"], of_eras, std["supports"]])
    parameters = parameters_of(
        rig, ("thickness", "loss_factor"), ("stiffness", "damping"), rig.foot_names
    )
    values = np.array([parameter.before for parameter in parameters])
    return errors_by_key(rig, zip(parameters, values * relative, strict=True))
