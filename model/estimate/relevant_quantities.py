"""Quantities that answers depend on, and measurements that would determine unknown ones.

A response to a moving base does not change if mass, springs and dampers are scaled together, and
neither does a contrast if all drives are. Answers depend on each natural frequency, on each spring
and damper relative to the plate's mass, and on each gain relative to the others. Levels depend on
the mean of the gains, but responses determine only its product with the mean sensor gain.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, best_of
from model.estimate.forward import ForwardModel, PlateAt, Sensor
from model.estimate.parameter_space import Space
from model.estimate.parameters import PARAMETER_KINDS, jacobian
from model.estimate.staged_fit import RigFit, model_of

_THEORY = {
    "frequency": PARAMETER_KINDS["mode_shifts"].theory / 2,
    "stiffness": PARAMETER_KINDS["stiffness"].theory,
    "damping": PARAMETER_KINDS["damping_each"].theory,
    "place": PARAMETER_KINDS["place"].theory,
}
"""Errors of quantities from plate theory, by name."""

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


def relevant(space: Space) -> dict[str, FloatArray]:
    """Return combinations (m, p) of parameters that answers depend on, by name."""
    mass = unit_rows(space, "thickness")
    rigidity = mass + unit_rows(space, "modulus") / 2
    gain = unit_rows(space, "gain")
    phase = unit_rows(space, "phase")
    damping = unit_rows(space, "damping_each") + unit_rows(space, "damping") - mass
    factor = space.groups["force_factor"]
    if factor.stop > factor.start:
        # An exciter's coil both damps and drives; the contribution of its suspension hardly shows
        # alone.
        damping = damping[space.std[factor] == 0]
        gain = gain + unit_rows(space, "force_factor")
    return {
        "frequency": rigidity + unit_rows(space, "mode_shifts") / 2,
        "stiffness": unit_rows(space, "stiffness") - mass,
        "damping": damping,
        "loss": unit_rows(space, "loss") + unit_rows(space, "mode_losses"),
        "gain": gain - gain.mean(axis=0),
        "phase": phase - phase.mean(axis=0),
    }


def unit_rows(space: Space, kind: str) -> FloatArray:
    """Return the rows of the unit matrix of a kind's m parameters, (m, p)."""
    return np.eye(space.size)[space.groups[kind]]


def std_of(combinations: FloatArray, space: Space, covariance: FloatArray) -> FloatArray:
    """Return standard errors (m,) of linear combinations (m, p) of parameters in their units."""
    scaled = combinations * space.std
    return np.asarray(np.sqrt(np.einsum("mp,pq,mq->m", scaled, covariance, scaled)))


def parameter_stds(space: Space, covariance: FloatArray) -> FloatArray:
    """Return the standard error of each parameter in its unit (p,)."""
    return space.std * np.sqrt(np.diagonal(covariance))


def relevant_stds(space: Space, covariance: FloatArray) -> dict[str, FloatArray]:
    """Return standard errors of the quantities that answers depend on, with model errors, by
    kind."""
    stds = {kind: std_of(rows, space, covariance) for kind, rows in relevant(space).items()}
    stds["place"] = parameter_stds(space, covariance)[space.groups["place"]]
    for kind, std in stds.items():
        stds[kind] = np.where(std > 0, np.hypot(std, _THEORY.get(kind, 0.0)), 0.0)
    return stds


def unknowns(fitted: RigFit) -> list[str]:
    """Describe quantities that answers depend on but the measurement leaves unknown, with advice.

    States their standard errors before and after the measurement.
    """
    space = fitted.space
    prior = np.diag(space.uncertain.astype(float))
    rows = []
    for kind, combinations in relevant(space).items():
        prior_std = std_of(combinations, space, prior)
        std = std_of(combinations, space, fitted.stated_covariance)
        built_std = std_of(combinations, space.as_built, prior)
        is_unknown = (prior_std > 0) & (std > _UNKNOWN * built_std)
        unknown = np.flatnonzero(is_unknown & _are_needed(fitted.model, kind))
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
            f"{_advice(fitted, combinations[worst])}"
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


def _advice(fitted: RigFit, combination: FloatArray) -> str:
    """Describe the ERA, tone and position whose response would narrow a combination (p,) most."""
    model = _advised_model(fitted)
    space = model.space
    # Parameters of additional sensors have their prior.
    numbers = [space.index(name) for name in fitted.space.names]
    is_new = space.std > 0
    is_new[numbers] = False
    covariance = np.diag(is_new.astype(float))
    covariance[np.ix_(numbers, numbers)] = fitted.stated_covariance
    x = np.zeros(space.size)
    x[numbers] = fitted.x
    direction = np.zeros(space.size)
    direction[numbers] = combination
    narrowed = _narrowing(model.at(x), covariance, covariance @ (direction * space.std))
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
