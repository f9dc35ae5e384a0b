"""The knots of least cost: quadratic forms of what knots do to fingers and plate, minimised.

Forms are over knots and ERAs, knots * eras rows, ERAs running fastest; amplitudes are in strokes.
Gains and phases of the ERAs are known to a few percent and degrees only: if those of ERA e are off
by a complex factor 1 + d_e, a form grows by var(d) times what each ERA does alone, so that stands
in every form, and what is found does not rest on a cancellation that no amplifier can keep.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.transients.bounded_solution import bounded_solution
from model.transients.envelope import KNOT_STEP
from model.transients.hats import ending_states, hat_accelerations, raised_cosine, steady_states
from model.transients.time_response import PlateInTime
from model.vibration.excitation import GAIN_ERROR, PHASE_ERROR

ONSET_KNOTS = 21
"""Knots of an onset; the last, after 105 ms, is the pattern itself."""

ENDING_KNOTS = 8
"""Knots of an ending; the last, after 40 ms, is silence."""

_ERROR_VARIANCE = GAIN_ERROR**2 + PHASE_ERROR**2

# What a target's straying from its ramp costs against a quiet finger's moving, relative to the
# robust ratio of the two in the steady state: a pattern that leaves the quiet finger 20 dB below
# the target must not trade the target's ramp for more than that. From half of it to twice it
# contrast changes by half a dB.
_TARGET_WEIGHT = 2.0

# What a quiet finger's moving during an ending, relative to the target, costs against what is left
# of the plate's vibration, relative to the steady one. Three times as much makes both differ by
# about 1 dB; none at all makes the end as loud for the quiet finger as a plain ramp is.
_QUIET_WEIGHT = 0.03

_SAMPLES = 5  # to a step; a demodulated answer changes little within a millisecond
_SETTLING_STEPS = 9  # watched after the last knot of an onset

# Relative to the mean of a form's diagonal: keeps it definite, costs no contrast.
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class Carrier:
    """What one frequency does whoever touches the plate, each ERA at full stroke.

    hats (n, eras, r) and steady (eras, r): accelerations of the reduced coordinates; left: form of
    what is left of the plate's mean square after an ending, its first block the tone that ends.
    """

    frequency: float
    hats: ComplexArray
    steady: ComplexArray
    left: ComplexArray


def solve_carrier(plate: PlateInTime, frequency: float, *, after: ComplexArray) -> Carrier:
    """Work out what belongs to a frequency [Hz]; after: as `mean_square` of `hats` gives it."""
    omega = 2 * math.pi * frequency
    steady = -(omega**2) * steady_states(plate, omega) @ plate.displacement.T
    steps = ONSET_KNOTS + _SETTLING_STEPS
    hats = hat_accelerations(plate, omega, step=KNOT_STEP, steps=steps, samples=_SAMPLES)
    states = ending_states(plate, omega, step=KNOT_STEP, steps=ENDING_KNOTS)
    flat = states.reshape(len(states), -1)
    return Carrier(frequency, hats, steady, flat.conj().T @ after @ flat)


def onset_knots(
    carrier: Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    *,
    felt: FloatArray,
    still: FloatArray,
    rise: float,
) -> ComplexArray:
    """Knots (ONSET_KNOTS, active) in strokes; the last are the amplitudes (eras,).

    felt, still (d, r): rows that targets and quiet fingers come down to; rise [s].
    """
    steps = ONSET_KNOTS + _SETTLING_STEPS
    eras = len(active)
    at_felt = _by_step(carrier.hats[:, active], felt)
    at_still = _by_step(carrier.hats[:, active], still)
    loud = _over_time(at_felt.conj().T @ at_felt, steps)
    noise = _over_time(at_still.conj().T @ at_still, steps)
    times = KNOT_STEP * (np.arange(steps * _SAMPLES) + 0.5) / _SAMPLES
    wanted = raised_cosine(times, rise)[:, None] * (felt @ (amplitudes @ carrier.steady))
    wanted = wanted.reshape(steps, -1).T
    match = (at_felt.conj().T @ wanted).reshape(steps, eras, steps)
    aim = np.stack([np.trace(match[:, :, knot:], axis1=0, axis2=2) for knot in range(steps)])

    steady = amplitudes[active, None] * carrier.steady[active]
    weight = _TARGET_WEIGHT**2 * _robust_power(still @ steady.T) / _robust_power(felt @ steady.T)
    form = _robust(noise, eras) + weight * loud
    free = (ONSET_KNOTS - 1) * eras
    settled = np.tile(amplitudes[active], steps - ONSET_KNOTS + 1)
    knots = _least(form[:free, :free], weight * aim.ravel()[:free] - form[:free, free:] @ settled)
    return np.vstack([knots.reshape(-1, eras), amplitudes[active]])


def ending_knots(
    carrier: Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    *,
    felt: FloatArray | None = None,
    still: FloatArray | None = None,
) -> ComplexArray:
    """Start and knots (1 + ENDING_KNOTS, active) in strokes; the last are zero.

    The whole plate comes to rest; where felt and still are given (as in `onset_knots`), quiet
    fingers stay quiet meanwhile.
    """
    eras = len(active)
    start = amplitudes[active]
    total = len(amplitudes)
    rows = (np.arange(ENDING_KNOTS)[:, None] * total + active).ravel()
    form = carrier.left[np.ix_(rows, rows)]
    if felt is not None and still is not None:
        vibration = amplitudes @ carrier.steady
        target = np.linalg.norm(felt @ vibration) ** 2
        meanwhile = while_ending(carrier.hats[:, active], carrier.steady[active], still)
        form = form + _QUIET_WEIGHT * np.linalg.norm(vibration) ** 2 / target * meanwhile
    form = _robust(form, eras)
    knots = _least(form[eras:, eras:], -form[eras:, :eras] @ start)
    return np.vstack([start, knots.reshape(-1, eras), np.zeros(eras)])


def while_ending(hats: ComplexArray, steady: ComplexArray, still: FloatArray) -> ComplexArray:
    """Form of the mean square at quiet fingers during an ending: the tone that ends, then knots.

    hats (n, eras, r) and steady (eras, r) as in `Carrier`, still (d, r) as in `onset_knots`.
    An ending is the steady tone less hats: one of the tone's own height at every knot, and the
    knots in their place.
    """
    steps, eras = ENDING_KNOTS, len(steady)
    at_still = _by_step(hats[: steps * _SAMPLES], still)
    tone = np.tile(still @ steady.T, (_SAMPLES, 1))
    cross = (tone.conj().T @ at_still).reshape(eras, steps, eras).cumsum(axis=1)[:, ::-1]
    form = np.empty(((1 + steps) * eras,) * 2, dtype=complex)
    form[:eras, :eras] = steps * tone.conj().T @ tone
    form[:eras, eras:] = cross.reshape(eras, -1)
    form[eras:, :eras] = form[:eras, eras:].conj().T
    form[eras:, eras:] = _over_time(at_still.conj().T @ at_still, steps)
    # From heights of hats to the tone and the knots before the last, which is zero.
    heights = np.zeros((1 + steps, steps))
    heights[:steps] = np.eye(steps)
    heights[1:, 0] = -1
    turn = np.kron(heights, np.eye(eras))
    return np.asarray(turn.T @ form @ turn / (steps * _SAMPLES))


def _least(form: ComplexArray, right: ComplexArray) -> ComplexArray:
    ridge = _RIDGE * float(np.trace(form).real) / len(form)
    return bounded_solution(form + ridge * np.eye(len(form)), right, np.ones(len(form)))


def _robust(form: ComplexArray, eras: int) -> ComplexArray:
    """The mean of a form when ERAs are off by their errors."""
    own = np.tile(np.eye(eras), (len(form) // eras,) * 2)
    return np.asarray(form * (1 + _ERROR_VARIANCE * own))


def _robust_power(seen: ComplexArray) -> float:
    """Mean sum of squares of what all ERAs do together (d, eras) when they are off so."""
    together = np.linalg.norm(seen.sum(axis=1)) ** 2
    return float(together + _ERROR_VARIANCE * np.linalg.norm(seen) ** 2)


def _by_step(hats: ComplexArray, rows: FloatArray) -> ComplexArray:
    """Hats seen at d rows (d, r): (samples * d, steps * eras), the steps side by side."""
    seen = hats @ rows.T
    count, eras, d = seen.shape
    by_step = seen.reshape(count // _SAMPLES, _SAMPLES, eras, d).transpose(1, 3, 0, 2)
    return by_step.reshape(_SAMPLES * d, -1)


def _over_time(products: ComplexArray, steps: int) -> ComplexArray:
    """From products of steps i and j of two hats, the form over all knots, summed over time.

    Hats of knots k and l meet in step t with their own steps t - k and t - l: sums along the
    diagonals of products, so no product is ever made twice.
    """
    eras = len(products) // steps
    sums = products.reshape(steps, eras, steps, eras).transpose(0, 2, 1, 3).copy()
    for step in range(1, steps):
        sums[step, 1:] += sums[step - 1, :-1]
    return sums[::-1, ::-1].transpose(0, 2, 1, 3).reshape(products.shape)
