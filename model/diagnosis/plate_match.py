"""The most likely plate behind what was measured, if the rig is right within what builders achieve.

    d_fes ~ m_fe exp(i phi_fe) a_fes(x) + noise,   m_fe near G_e

d measured, a the model's, G_e the gain of a channel. Magnitudes m wander about G_e with frequency
as those of real actuators do; phases phi are free, for they need not have been measured. Both are
known at once for any x and G, so only these are searched (variable projection). x, the numbers of
the rig, is held near the rig's own by how well they can be known beforehand (Gaussian priors): what
it takes to move one far from there is evidence against the rig.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from model.arrays import ComplexArray, FloatArray
from model.calibration.fast_plate import FastPlate
from model.calibration.parameters import Parameter, parameters_of, rig_with
from model.rig.rig import Rig

# One standard deviation of what a rig's author knows: an alloy's modulus and a sheet's thickness, a
# maker's spring, and hardly anything about losses.
_MODULUS_KNOWN = 0.07
_STIFFNESS_KNOWN = 0.10
_LOSS_KNOWN = 0.7  # of itself
_DAMPING_KNOWN = 0.7  # of itself
_BOLT_KNOWN = 1.0  # twentieths of what an ERA carries
_GAIN_KNOWN = 1.0  # of a logarithm: a factor of 2.7
_GAIN_WANDERS = 0.08  # over frequency, of itself
FITS = 0.2  # rms error, relative to the response, of a plate to believe
MODEL_ERROR = 0.05  # of a row's rms: sensors' scales and places, what is not modelled
_ROBUST = 2.0  # standard deviations
_STEPS = 40

_Number = TypeVar("_Number", np.float64, np.complex128)


@dataclass(frozen=True, eq=False)
class Match:
    """A plate that explains a measurement as well as it can.

    rig; parameters with z (n,), how many standard deviations each is from the rig's own value, and
    known (n,), how much that is of its x;
    gains (e,): magnitude of each channel, NaN where it was not used; cost: half the sum of squares
    of residuals, robustly, and of the priors; error: rms of what is left, relative to each row's,
    usual_error: its median; responses (f, e, s): of its ERAs;
    predicted (f, e, s): of those that the channels drive, with gains.
    """

    rig: Rig
    parameters: tuple[Parameter, ...]
    z: FloatArray
    known: FloatArray
    gains: FloatArray
    cost: float
    error: float
    usual_error: float
    responses: ComplexArray
    predicted: ComplexArray

    @property
    def worst(self) -> float:
        """The largest of |z|."""
        return float(np.abs(self.z).max())


def match_plate(
    rig: Rig,
    plate: FastPlate,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    floor: FloatArray | None = None,
    model_error: float = MODEL_ERROR,
    starts: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> Match:
    """The most likely plate for values (f, e, s) of channels.

    drives (e,): the number of the ERA that each drives; plate: of the rig at those points and
    frequencies; model_error: of a row's rms, what no plate of the kind explains; floor (s,): noise
    of the values, in their unit; starts: logarithms of factors on the modulus and on all
    stiffnesses to begin from, the best of which is taken.
    """
    parameters = parameters_of(rig)
    center = np.array([parameter.start for parameter in parameters])
    spread = np.array([_known(parameter) for parameter in parameters])
    rows: NDArray[np.bool_] = np.asarray(np.isfinite(values).any(axis=2))
    used = np.flatnonzero(rows.any(axis=0))
    size = _size(values)
    noise = model_error * size[:, :, None] * np.ones(values.shape[2])
    if floor is not None:
        noise = np.hypot(noise, floor)
    weight = np.where(np.isfinite(values), 1 / noise, 0)
    measured = np.where(np.isfinite(values), values, 0)
    count = len(parameters)
    driven = list(drives)

    def responses(rig: Rig) -> ComplexArray:
        return np.asarray(plate.responses(rig)[:, driven])

    def residuals(z: FloatArray) -> FloatArray:
        x = center + spread * z[:count]
        model = responses(rig_with(rig, parameters, x))
        gains = np.ones(values.shape[1])
        gains[used] = np.exp(_GAIN_KNOWN * z[count:])
        best, magnitude = _project(model, measured, weight, gains)
        left = weight * (measured - best)
        wander = ((magnitude - gains) / (_GAIN_WANDERS * gains))[rows]
        left = _robust(left[weight > 0])
        return np.concatenate([left.real, left.imag, _robust(wander), z])

    bounds = np.array([[p.lower, p.upper] for p in parameters])
    bounds = (bounds - center[:, None]) / spread[:, None]
    lower, upper = np.vstack([bounds, np.tile([-8.0, 8.0], (len(used), 1))]).T
    begins = []
    for modulus, stiffness in starts:
        moves = {"modulus": modulus, "stiffness": stiffness}
        shift = np.array([moves.get(parameter.kind, 0.0) for parameter in parameters])
        model = responses(rig_with(rig, parameters, center + shift))
        ratio = np.log(np.maximum(size / _size(np.where(rows[:, :, None], model, np.nan)), 1e-6))
        first = np.concatenate([shift / spread, [np.median(ratio[rows[:, e], e]) for e in used]])
        begins.append(np.clip(first, lower + 1e-6, upper - 1e-6))
    found = [
        least_squares(
            residuals,
            begin,
            bounds=(lower, upper),
            x_scale="jac",
            max_nfev=_STEPS,
            xtol=1e-5,
            ftol=1e-5,
        )
        for begin in begins
    ]
    best = min(found, key=lambda each: float(each.cost))
    x = center + spread * best.x[:count]
    gains = np.full(values.shape[1], np.nan)
    gains[used] = np.exp(_GAIN_KNOWN * best.x[count:])
    fitted = rig_with(rig, parameters, x)
    model = responses(fitted)
    shown, _ = _project(model, measured, weight, np.nan_to_num(gains, nan=1.0))
    share = (np.abs(shown - measured) / size[:, :, None])[weight > 0]
    return Match(
        fitted,
        parameters,
        best.x[:count],
        spread,
        gains,
        float(best.cost),
        math.sqrt(float((share**2).mean())) if len(share) else math.inf,
        float(np.median(share)) if len(share) else math.inf,
        plate.responses(fitted),
        np.asarray(model * gains[:, None]),
    )


def _robust(left: NDArray[_Number]) -> NDArray[_Number]:
    """Residuals in standard deviations whose squares grow like their size beyond a few (soft L1).

    Priors are not treated so: what a rig's author knows, he knows.
    """
    share = np.abs(left) / _ROBUST
    half = 2 * (np.sqrt(1 + share**2) - 1)
    return np.asarray(left * np.sqrt(half) / np.maximum(share, 1e-12))


def _project(
    model: ComplexArray, measured: ComplexArray, weight: FloatArray, gains: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """The model (f, e, s) with the best magnitude and phase of every row, and these magnitudes."""
    inner = (weight**2 * model.conj() * measured).sum(axis=2)
    power = (np.abs(weight * model) ** 2).sum(axis=2)
    prior = 1 / (_GAIN_WANDERS * gains) ** 2
    magnitude = (np.abs(inner) + prior * gains) / (power + prior)
    turn = np.exp(1j * np.angle(inner))
    return np.asarray((magnitude * turn)[:, :, None] * model), magnitude


def _size(values: ComplexArray) -> FloatArray:
    """Root mean square of each row (f, e); 1 where there is none."""
    there = np.isfinite(values)
    power = np.where(there, np.abs(np.where(there, values, 0)) ** 2, 0).sum(axis=2)
    size = np.sqrt(power / np.maximum(there.sum(axis=2), 1))
    return np.where(size > 0, size, 1.0)


def _known(parameter: Parameter) -> float:
    """One standard deviation of x beforehand."""
    match parameter.kind:
        case "modulus":
            return _MODULUS_KNOWN
        case "stiffness":
            return _STIFFNESS_KNOWN
        case "loss_factor":
            return max(_LOSS_KNOWN * parameter.start, 0.3)
        case "damping":
            return max(_DAMPING_KNOWN * parameter.start, 0.3)
        case _:
            return _BOLT_KNOWN
