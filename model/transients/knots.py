"""Optimal knots: minima of quadratic forms of the vibration at fingers and over the plate.

Forms are over knots and ERAs, knots * eras rows, ERAs running fastest; amplitudes are in strokes.
Gains and phases of the ERAs are known to a few percent and degrees only (the rig's `uncertainty`):
with a complex factor 1 + d_e for ERA e the expected form grows by var(d) times each ERA's own part.
Every form includes that, so that the minimum does not rely on exact cancellation.

The basis of piecewise linear envelopes are hat functions, with responses in closed form. A hat is a
drive at a carrier exp(s t) that rises from zero to an ERA's full stroke in one step and falls to
zero in the next. An envelope linear between knots is a sum of hats, one for each knot, and the
responses to hats differ only by a shift in time: one response for each ERA serves all knots.
Responses are demodulated: without the factor exp(s t), as the envelopes are.

The response to a linear ramp t / step from time 0 on is z(t) = a0 + a1 t - a0 exp((lambda - s) t)
in the coordinates of `PlateInTime`; that to a hat is its second difference.

Minima have bounded magnitudes of their complex unknowns: no knot exceeds the stroke.
"""

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from model.arrays import Complex64Array, ComplexArray, FloatArray, IntArray
from model.transients import base_motion
from model.transients.base_motion import KNOT_STEP
from model.transients.time_response import PlateInTime

ONSET_KNOTS = 21
"""Knots of an onset; the last, after 105 ms, is the pattern's amplitude."""

ENDING_KNOTS = 8
"""Knots of an ending; the last, after 40 ms, is silence."""

# Weight of the target's deviation from its ramp against the quiet finger's motion, relative to the
# expected ratio of the two in the steady state: where a pattern leaves the quiet finger 20 dB below
# the target, the ramp is not traded for more. Between half and twice this contrast changes by
# 0.5 dB.
_TARGET_WEIGHT = 2.0

# Weight of a quiet finger's motion during an ending, relative to the target, against the plate's
# residual vibration, relative to the steady one. Three times as much changes both by about 1 dB;
# zero makes the ending as loud for the quiet finger as a plain ramp.
_QUIET_WEIGHT = 0.03

_SAMPLES = 5  # for each step; a demodulated response changes little within a millisecond
_STEPS = ONSET_KNOTS + 9  # of an onset, until the plate has settled

# Relative to the mean of a form's diagonal: keeps it definite, costs no contrast.
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class Carrier:
    """Responses at one frequency that do not depend on the contacts, each ERA at full stroke.

    Accelerations of the reduced coordinates. hats (samples, r, knots, eras): during the last step,
    of a hat at each knot; they are those of one knot during all steps. steady (eras, r);
    residual_form: form of the plate's mean square after an ending, its first block for the tone
    that ends; gain_variance: var(d).
    """

    frequency: float
    hats: ComplexArray
    steady: ComplexArray
    residual_form: ComplexArray
    gain_variance: float


def solve_carrier(
    plate: PlateInTime, frequency: float, *, residual_form: ComplexArray, gain_variance: float
) -> Carrier:
    """Solve one frequency [Hz]; residual_form: `hats.mean_square` for the time after an ending."""
    omega = 2 * math.pi * frequency
    steady = -(omega**2) * steady_states(plate, omega) @ plate.displacement.T
    hats = hat_accelerations(plate, omega, step=KNOT_STEP, steps=_STEPS, samples=_SAMPLES)
    hats = hats.reshape(_STEPS, _SAMPLES, *hats.shape[1:])[::-1].transpose(1, 3, 0, 2)
    states = ending_states(plate, omega, step=KNOT_STEP, steps=ENDING_KNOTS)
    flat = states.reshape(len(states), -1)
    form = flat.conj().T @ residual_form @ flat
    return Carrier(frequency, np.ascontiguousarray(hats), steady, form, gain_variance)


def onset_knots(
    carrier: Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    *,
    target_rows: FloatArray,
    quiet_rows: FloatArray,
    rise: float,
) -> ComplexArray:
    """Find the knots (ONSET_KNOTS, active) in strokes; the last are the amplitudes (eras,).

    target_rows, quiet_rows (d, r): shapes under targets and quiet fingers, whose sum of squares is
    the mean square there; rise [s].
    """
    eras, variance = len(active), carrier.gain_variance
    steady = amplitudes[active, None] * carrier.steady[active]
    quiet_power, target_power = (
        _expected_power(rows @ steady.T, variance) for rows in (quiet_rows, target_rows)
    )
    weight = _TARGET_WEIGHT**2 * quiet_power / target_power
    at_targets = math.sqrt(weight) * _at(target_rows, carrier.hats)[..., active]
    at_quiet = _at(quiet_rows, carrier.hats)[..., active]
    form = _form(np.concatenate([at_targets, at_quiet], axis=1))
    _add_errors(form, _own_form(at_quiet), variance)
    wanted = math.sqrt(weight) * target_rows @ (amplitudes @ carrier.steady)
    along = np.tensordot(wanted, at_targets.conj(), axes=(0, 1)).reshape(-1, eras)
    aim = _rises(rise) @ along

    free = (ONSET_KNOTS - 1) * eras
    settled = np.tile(amplitudes[active], _STEPS - ONSET_KNOTS + 1)
    knots = _minimum(form[:free, :free], aim.ravel()[:free] - form[:free, free:] @ settled)
    return np.vstack([knots.reshape(-1, eras), amplitudes[active]])


@cache
def _rises(rise: float) -> FloatArray:
    """The raised cosine that takes a time [s], as the hat of each knot meets it.

    By knot, and by sample and knot of `Carrier.hats`.
    """
    times = KNOT_STEP * (np.arange(_STEPS * _SAMPLES) + 0.5) / _SAMPLES
    wanted = np.zeros((2 * _STEPS, _SAMPLES))
    wanted[:_STEPS] = base_motion.rise(times, rise).reshape(_STEPS, _SAMPLES)
    since = np.arange(_STEPS)[::-1]  # steps since a hat began
    met = wanted[np.arange(_STEPS)[:, None] + since]
    return np.asarray(met.transpose(0, 2, 1).reshape(_STEPS, -1))


def ending_knots(
    carrier: Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    *,
    target_rows: FloatArray | None = None,
    quiet_rows: FloatArray | None = None,
) -> ComplexArray:
    """Find start and knots (1 + ENDING_KNOTS, active) in strokes; the last are zero.

    The whole plate comes to rest. With target_rows and quiet_rows (as in `onset_knots`) quiet
    fingers stay quiet meanwhile.
    """
    eras = len(active)
    start = amplitudes[active]
    total = len(amplitudes)
    rows = (np.arange(ENDING_KNOTS)[:, None] * total + active).ravel()
    form = carrier.residual_form[np.ix_(rows, rows)]
    if target_rows is not None and quiet_rows is not None:
        vibration = amplitudes @ carrier.steady
        target = np.linalg.norm(target_rows @ vibration) ** 2
        meanwhile = while_ending(carrier.hats[..., active], carrier.steady[active], quiet_rows)
        form = form + _QUIET_WEIGHT * np.linalg.norm(vibration) ** 2 / target * meanwhile
    blocks = form.reshape(ENDING_KNOTS, eras, ENDING_KNOTS, eras)
    _add_errors(form, np.einsum("kele->kle", blocks), carrier.gain_variance)
    knots = _minimum(form[eras:, eras:], -form[eras:, :eras] @ start)
    return np.vstack([start, knots.reshape(-1, eras), np.zeros(eras)])


def while_ending(hats: ComplexArray, steady: ComplexArray, quiet_rows: FloatArray) -> ComplexArray:
    """Form of the mean square at quiet fingers during an ending: the tone that ends, then knots.

    hats (samples, r, knots, eras) and steady (eras, r) as in `Carrier`, quiet_rows (d, r) as in
    `onset_knots`. An ending is the steady tone minus hats of the tone's height at every knot plus
    the knots' hats.
    """
    steps, eras = ENDING_KNOTS, len(steady)
    at_quiet = _at(quiet_rows, hats[:, :, -steps:])
    tone = quiet_rows @ steady.T
    cross = np.tensordot(tone.conj(), at_quiet.sum(axis=0), axes=(0, 0))
    cross = cross[:, ::-1].cumsum(axis=1)[:, ::-1]
    blocks = np.empty((1 + steps, eras, 1 + steps, eras), dtype=complex)
    blocks[0, :, 0] = steps * _SAMPLES * tone.conj().T @ tone
    blocks[0, :, 1:] = cross
    blocks[1:, :, 0] = cross.conj().transpose(1, 2, 0)
    blocks[1:, :, 1:] = _form(at_quiet).reshape(steps, eras, steps, eras)
    # The tone takes its height off every hat; the last knot is zero.
    blocks[0] -= blocks[1:].sum(axis=0)
    blocks[:, :, 0] -= blocks[:, :, 1:].sum(axis=2)
    return np.asarray(blocks[:-1, :, :-1].reshape((steps * eras,) * 2) / (steps * _SAMPLES))


def _minimum(form: ComplexArray, right: ComplexArray) -> ComplexArray:
    ridge = _RIDGE * float(np.trace(form).real) / len(form)
    return bounded_solution(form + ridge * np.eye(len(form)), right, np.ones(len(form)))


def _add_errors(form: ComplexArray, own: ComplexArray, gain_variance: float) -> None:
    """Add to a form what the errors of the ERAs do, by their own forms (knots, knots, eras)."""
    knots, _, eras = own.shape
    blocks = form.reshape(knots, eras, knots, eras)
    np.einsum("kele->kle", blocks)[...] += gain_variance * own


def _expected_power(responses: ComplexArray, gain_variance: float) -> float:
    """Expected sum of squares over rows of all ERAs together (d, eras) under their errors."""
    together = np.linalg.norm(responses.sum(axis=1)) ** 2
    return float(together + gain_variance * np.linalg.norm(responses) ** 2)


def _at(rows: FloatArray, hats: ComplexArray) -> ComplexArray:
    """Hats (samples, r, knots, eras) at rows (d, r): (samples, d, knots, eras)."""
    samples, _, *knots_and_eras = hats.shape
    flat = hats.reshape(*hats.shape[:2], -1)
    responses = (rows @ flat.view(float)).view(complex)
    return np.asarray(responses.reshape(samples, len(rows), *knots_and_eras))


def _form(responses: ComplexArray) -> ComplexArray:
    """Form over knots and ERAs, summed over time, of the sum of squares over samples and rows.

    responses (samples, d, knots, eras) as in `Carrier.hats`. In the step before the last, each hat
    is as that of the next knot in the last step, and so on.
    """
    knots, eras = responses.shape[2:]
    flat = responses.reshape(-1, knots * eras)
    form = flat.conj().T @ flat
    by_knot = form.reshape(knots, eras, -1)
    for later, knot in pairwise(by_knot[::-1]):
        knot[:, :-eras] += later[:, eras:]
    return form


def _own_form(responses: ComplexArray) -> ComplexArray:
    """The form's parts of one ERA each, (knots, knots, eras)."""
    knots, eras = responses.shape[2:]
    of_era = responses.reshape(-1, knots, eras).transpose(2, 1, 0)
    own = (of_era.conj() @ of_era.transpose(0, 2, 1)).transpose(1, 2, 0).copy()
    for later, knot in pairwise(own[::-1]):
        knot[:-1] += later[1:]
    return own


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


# With this penalty (relative to the mean of the diagonal) and over-relaxation the forms that
# shaping makes are within 0.1 dB of their minimum after 30 steps; found by trying 1e-4 to 0.3.
_PENALTY = 0.03
_RELAXATION = 1.6
_ITERATIONS = 30


def bounded_solution(A: ComplexArray, b: ComplexArray, bound: FloatArray) -> ComplexArray:
    """Minimise x^H A x - 2 Re b^H x with |x_i| <= bound_i, A Hermitian positive definite.

    The unbounded solution where it satisfies the bounds; otherwise by alternating directions (ADMM:
    Boyd and others, 2011, section 5), whose result satisfies them exactly.
    """
    _, free, _ = lapack.zposv(A, b)
    if (np.abs(free) <= bound).all():
        return np.asarray(free)
    penalty = _PENALTY * float(np.trace(A).real) / len(A)
    single, limit = A.astype(np.complex64), bound.astype(np.float32)
    single[np.diag_indices(len(A))] += penalty
    inverse = _inverse(single)
    offset = inverse @ b.astype(np.complex64)
    inverse *= penalty
    feasible = _within(free.astype(np.complex64), limit)
    dual = np.zeros_like(feasible)
    for _ in range(_ITERATIONS):
        x = offset + inverse @ (feasible - dual)
        relaxed = _RELAXATION * x + (1 - _RELAXATION) * feasible + dual
        feasible = _within(relaxed, limit)
        dual = relaxed - feasible
    return _within(feasible.astype(complex), bound)


def _inverse(A: Complex64Array) -> Complex64Array:
    """Of a Hermitian positive definite matrix."""
    factor, _ = lapack.cpotrf(A)
    upper, _ = lapack.cpotri(factor)
    return np.asarray(np.triu(upper) + np.triu(upper, 1).conj().T)


def _within(x: NDArray[Any], bound: NDArray[Any]) -> NDArray[Any]:
    """Reduced to magnitudes within bounds by 1e-12 more, so that rounding never exceeds them."""
    size = np.maximum(np.abs(x), 1e-30)
    return np.asarray(x * np.minimum((1 - 1e-12) * bound / size, 1.0, dtype=size.dtype))
