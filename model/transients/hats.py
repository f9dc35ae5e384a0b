"""Responses of the plate to hat functions, the basis of piecewise linear envelopes, in closed form.

A hat is a drive at a carrier exp(s t) that rises from zero to an ERA's full stroke in one step and
falls to zero in the next. An envelope linear between knots is a sum of hats, one for each knot, and
the responses to hats differ only by a shift in time: one response for each ERA serves all knots.
Responses are demodulated: without the factor exp(s t), as the envelopes are.

The response to a linear ramp t / step from time 0 on is z(t) = a0 + a1 t - a0 exp((lambda - s) t)
in the coordinates of `PlateInTime`; that to a hat is its second difference.
"""

import numpy as np

from model.arrays import ComplexArray
from model.transients.time_response import PlateInTime


def steady_states(plate: PlateInTime, omega: float) -> ComplexArray:
    """Steady state z of the plate at omega [rad/s], each ERA alone at full stroke, (eras, 2 r)."""
    count = len(plate.eras)
    strokes = np.array([era.stroke for era in plate.eras], dtype=complex)
    carrier = np.full(count, 1j * omega)
    return plate.particular(range(count), carrier, strokes, 0 * strokes)[0]


def hat_accelerations(
    plate: PlateInTime, omega: float, *, step: float, steps: int, samples: int
) -> ComplexArray:
    """Acceleration of the reduced coordinates after a hat on each ERA began, (n, eras, r).

    omega [rad/s]; step [s]: from the start of a hat to its top. n = steps * samples times, at the
    middle of each interval, since the force jumps at knots.
    """
    s = 1j * omega
    times = step * (np.arange(steps * samples) + 0.5) / samples
    a0, a1 = _linear_ramps(plate, s, step)
    b0, b1 = a0 @ plate.displacement.T, a1 @ plate.displacement.T
    forced = s**2 * (b0 + times[:, None, None] * b1) + 2 * s * b1
    exponentials = np.exp(np.outer(times, plate.eigenvalues - s))
    free = np.stack([exponentials @ (plate.acceleration * row).T for row in a0], axis=1)
    linear_ramps = forced - free
    hats = linear_ramps.copy()
    hats[samples:] -= 2 * linear_ramps[:-samples]
    hats[2 * samples :] += linear_ramps[: -2 * samples]
    return np.asarray(hats)


def ending_states(plate: PlateInTime, omega: float, *, step: float, steps: int) -> ComplexArray:
    """State z at the end of an ending of the given steps, (2 r, steps, eras), at full stroke.

    First for the tone that was steady before and falls to zero within one step; then for a hat
    whose top is after step 1, 2, ...
    """
    s = 1j * omega
    a0, a1 = _linear_ramps(plate, s, step)
    times = step * np.arange(steps + 1)
    decay = np.exp(np.outer(times, plate.eigenvalues - s))
    linear_ramps = a0 + times[:, None, None] * a1 - decay[:, None] * a0
    steady = steady_states(plate, omega)
    columns = [steady - linear_ramps[steps] + linear_ramps[steps - 1]]
    for knot in range(1, steps):
        since = steps - knot
        columns.append(linear_ramps[since + 1] - 2 * linear_ramps[since] + linear_ramps[since - 1])
    return np.stack(columns).transpose(2, 0, 1)


def mean_square(plate: PlateInTime, duration: float) -> ComplexArray:
    """Hermitian form W (2 r, 2 r) of a free vibration's mean square over duration T [s].

    z0^H W z0 = 2 <(1/T) int |q''|^2 dt>, mean over the phase of the state z0 at the start. With
    mass-normalised coordinates |q''|^2 is the plate's mass times its mean square acceleration.
    """
    rates = plate.eigenvalues.conj()[:, None] + plate.eigenvalues
    shapes = plate.acceleration.conj().T @ plate.acceleration
    return np.asarray(shapes * np.expm1(rates * duration) / (rates * duration))


def _linear_ramps(plate: PlateInTime, s: complex, step: float) -> tuple[ComplexArray, ComplexArray]:
    """Particular solutions (eras, 2 r) for the base of each ERA rising by its stroke in a step."""
    count = len(plate.eras)
    slopes: ComplexArray = np.array([era.stroke / step + 0j for era in plate.eras])
    return plate.particular(range(count), np.full(count, s), 0 * slopes, slopes)
