"""Maximum a posteriori fit of a rig's plate to responses of its channels.

    d_fes ~ m_fe exp(i phi_fe) a_fes(x) + noise,   m_fe near G_e

d measured, a of the model, G_e the gain of a channel. Magnitudes m vary about G_e with frequency as
those of real actuators do; phases phi are free, since they need not have been measured. Both follow
from x and G, so only these are searched (variable projection). Gaussian priors hold x, the
parameters of the rig, near its values: a large deviation is evidence against the rig.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.sensed_plate import Parameters, SensedPlate
from model.calibration.variable_projection import project_gains, projection_slopes, row_rms
from model.choice import best_by
from model.identification.least_squares import search
from model.rig.rig import Rig

_GAIN_STD = 1.0  # of the logarithm of a channel's gain
_GAIN_TOLERANCE = 0.08  # standard deviation over frequency, of itself
MAX_FIT_ERROR = 0.2  # largest relative rms error of an acceptable plate
MODEL_ERROR = 0.05  # of a row's rms: scales and positions of sensors, and what is not modelled
_ROBUST = 2.0  # standard deviations


@dataclass(frozen=True, eq=False)
class Match:
    """The best fit of a plate.

    z (n,): deviation of each parameter from the rig's value in standard deviations of its prior;
    gains (e,): magnitude of each channel, NaN if not used; cost: half the sum of squares of robust
    residuals and of z; error, median_error: rms and median of residuals relative to the rms of
    their row; responses (f, e, s) of the ERAs; predicted (f, e, s): of those that the channels
    drive, with gains.
    """

    rig: Rig
    parameters: Parameters
    z: FloatArray
    gains: FloatArray
    cost: float
    error: float
    median_error: float
    responses: ComplexArray
    predicted: ComplexArray

    @property
    def worst(self) -> float:
        """The largest of |z|."""
        return float(np.abs(self.z).max())


def match_plate(
    plate: SensedPlate,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float = MODEL_ERROR,
    starts: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> Match:
    """Fit a rig's plate at sensors to values (f, e, s) of channels.

    drives (e,): index of the ERA that each
    channel drives; model_error: relative to a row's rms; starts: logarithms of factors on the
    modulus and on all stiffnesses from which to search.
    """
    parameters = plate.parameters
    rows: NDArray[np.bool_] = np.asarray(np.isfinite(values).any(axis=2))
    used = np.flatnonzero(rows.any(axis=0))
    size = row_rms(values)
    weight = np.isfinite(values) / (model_error * size[:, :, None])
    count = len(parameters.rows)
    inside, driven = weight > 0, list(drives)

    def linearised(z: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        model, by_x = plate.slopes(z[:count])
        model = model[:, driven]
        slopes = np.zeros((len(z), *model.shape), dtype=complex)
        slopes[:count] = by_x[:, :, driven]
        gains, by_gains = np.ones(values.shape[1]), np.zeros((len(z), values.shape[1]))
        gains[used] = np.exp(_GAIN_STD * z[count:])
        by_gains[count:, used] = np.diag(_GAIN_STD * gains[used])
        projected, left = project_gains(
            model, values, weight, expected=gains, tolerance=_GAIN_TOLERANCE
        )
        by_gain, by_left = projection_slopes(
            model,
            slopes,
            values,
            weight,
            expected=gains,
            expected_slopes=by_gains,
            tolerance=_GAIN_TOLERANCE,
        )
        size = np.abs(projected)
        by_size = (projected.conj() * by_gain).real / size
        wander = ((size / gains - 1) / _GAIN_TOLERANCE)[rows]
        by_wander = (by_size - size * by_gains[:, None] / gains) / gains / _GAIN_TOLERANCE
        return (
            np.concatenate([left[inside], wander]),
            np.hstack([by_left[:, inside], by_wander[:, rows]]).T,
        )

    bounds = np.hstack([parameters.bounds, np.tile([[-8.0], [8.0]], len(used))])
    found = []
    for start in starts:
        moved = parameters.moved(*start)
        model = plate.responses(moved)[:, driven]
        ratio = np.log(np.maximum(size / row_rms(np.where(rows[:, :, None], model, np.nan)), 1e-6))
        levels = [np.median(ratio[rows[:, e], e]) for e in used]
        found.append(search(linearised, np.concatenate([moved, levels]), bounds, robust=_ROBUST))
    best = best_by(found, lambda each: -each.cost)
    z = best.y[:count]
    gains = np.full(values.shape[1], np.nan)
    gains[used] = np.exp(_GAIN_STD * best.y[count:])
    responses = plate.responses(z)
    model = responses[:, driven]
    _, residual = project_gains(
        model, values, weight, expected=np.nan_to_num(gains, nan=1.0), tolerance=_GAIN_TOLERANCE
    )
    share = (model_error * np.abs(residual))[inside]
    return Match(
        parameters.rig_at(z),
        parameters,
        z,
        gains,
        best.cost,
        math.sqrt(float((share**2).mean())) if len(share) else math.inf,
        float(np.median(share)) if len(share) else math.inf,
        responses,
        np.asarray(model * gains[:, None]),
    )
