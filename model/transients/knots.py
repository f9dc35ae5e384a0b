"""Optimal knots of onsets and endings, which minimize the vibration at fingers and over the plate.

Forms are over knots and ERAs, knots * eras rows, ERAs running fastest; amplitudes are in strokes.
Gains and phases of the ERAs are known to a few percent and degrees only (the rig's `uncertainty`):
with a complex factor 1 + d_e for ERA e the expected form grows by var(d) times each ERA's own part.
Every form includes that, so that the minimum does not rely on exact cancellation, neither of ERAs
nor within a combination of ERAs.

The basis of piecewise linear envelopes is hat functions, with responses in closed form. A hat is a
drive at a carrier exp(s t) that rises from zero to an ERA's full stroke in one step and falls to
zero in the next. An envelope that is linear between knots is a sum of hats, one for each knot, and
the responses to hats differ only by a shift in time: one response for each ERA serves all knots.
Responses are demodulated: without the factor exp(s t), as the envelopes are. The response to a
linear ramp t / step from time 0 on is z(t) = a0 + a1 t - a0 exp((lambda - s) t) in the coordinates
of `PlateInTime`; that to a hat is its second difference.

With many ERAs an onset uses a few combinations: the pattern's, and the combinations that move the
fingers most; others would hardly contribute. Magnitudes of the complex knots are bounded: none
exceeds the stroke. Single precision changes contrasts by some hundredths of a decibel. Knots are
found by one call of a kernel in C, or in numpy without a compiler.
"""

import math
from ctypes import c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray
from model.compiled.kernels import ShapedTone, Shaping, kernels, run_kernel
from model.transients import base_motion
from model.transients.base_motion import KNOT_STEP
from model.transients.plate_in_time import PlateInTime

_ComplexArray: TypeAlias = NDArray[np.complexfloating[Any, Any]]
"""Complex arrays of either precision."""

ONSET_KNOTS = 21
"""Knots of an onset; the last, after 105 ms, is the pattern's amplitude."""

ENDING_KNOTS = 8
"""Knots of an ending; the last, after 40 ms, is silence."""

# Weight of the target's deviation from its ramp against the quiet finger's motion, relative to the
# expected ratio of the two in the steady state: if a pattern leaves the quiet finger 20 dB below
# the target, the ramp is not sacrificed for more. Between half and twice this contrast changes by
# 0.5 dB.
TARGET_WEIGHT = 2.0

RISE = 0.040
"""Time [s] in which a target rises to full vibration, along a raised cosine."""

SAMPLES = 5  # for each step; a demodulated response changes little within a millisecond
STEPS = ONSET_KNOTS + 9  # of an onset, until the plate has settled

# Relative to the mean of a form's diagonal: keeps it definite, costs no contrast.
_RIDGE = 1e-6

# Weight of a quiet finger's motion during an ending, relative to the target, against the plate's
# residual vibration, relative to the steady one. Three times as much changes both by about 1 dB;
# zero makes the ending as loud for the quiet finger as a plain ramp.
_QUIET_WEIGHT = 0.03

# With this penalty (relative to the mean of the diagonal) and over-relaxation the forms that
# shaping makes are within 0.1 dB of their minimum after 30 steps; found by trying 1e-4 to 0.3.
PENALTY = 0.03
RELAXATION = 1.6
ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Carrier:
    """Responses at one frequency that do not depend on the contacts, each ERA at full stroke.

    Responses are accelerations of the reduced coordinates.
    """

    hats: Complex64Array
    """Response (samples, r, knots, eras) to a hat at each knot, during the last step.

    Equally, the response to one hat during all steps.
    """
    steady: ComplexArray
    """Steady response (eras, r)."""
    residual_form: Complex64Array
    """Form of the plate's mean square after an ending; the first block is of the tone that ends."""
    gain_variance: float
    """var(d)."""


@dataclass(frozen=True, eq=False)
class FingerResponses:
    """Responses to some ERAs (see `Carrier`) at t targets and at d rows of quiet fingers."""

    targets: int
    """t."""
    hats: Complex64Array
    """Responses to hats (samples, t + d, knots, eras)."""
    steady: ComplexArray
    """Steady responses (t + d, eras)."""
    combinations: int
    """Number of combinations of ERAs in an onset."""


def solve_carrier(
    plate: PlateInTime, frequency: float, *, residual_form: ComplexArray, gain_variance: float
) -> Carrier:
    """Solve one frequency [Hz]; residual_form: `mean_square` for the time after an ending."""
    omega = 2 * math.pi * frequency
    steady = -(omega**2) * steady_states(plate, omega) @ plate.displacement.T
    hats = hat_accelerations(plate, omega, step=KNOT_STEP, steps=STEPS, samples=SAMPLES)
    hats = hats.reshape(STEPS, SAMPLES, *hats.shape[1:])[::-1].transpose(1, 3, 0, 2)
    states = ending_states(plate, omega, step=KNOT_STEP, steps=ENDING_KNOTS)
    flat = states.reshape(len(states), -1)
    certain_form = flat.conj().T @ residual_form @ flat
    form = _with_errors(certain_form, len(plate.eras), gain_variance)
    return Carrier(
        np.ascontiguousarray(hats, dtype=np.complex64),
        steady,
        np.asarray(form, dtype=np.complex64),
        gain_variance,
    )


def onset_by_numpy(
    amplitudes: ComplexArray, responses: FingerResponses, gain_variance: float
) -> ComplexArray:
    """Find the knots (free, eras) of an onset in strokes, all but the last.

    The last are the amplitudes (eras,). responses: of the fingers to these ERAs.
    """
    t = responses.targets
    free = ONSET_KNOTS - 1
    steady = amplitudes * responses.steady
    quiet_power = _expected_power(steady[t:], gain_variance)
    target_power = _expected_power(steady[:t], gain_variance)
    weights = np.ones((len(steady), 1, 1), dtype=np.float32)
    weights[:t] = TARGET_WEIGHT * math.sqrt(quiet_power / target_power)
    hats = responses.hats * weights
    combinations = _combinations(hats, amplitudes, responses.combinations)
    combined: _ComplexArray = hats @ combinations
    count = combinations.shape[1]
    form = _expected_form(hats, combined, combinations, gain_variance)
    wanted = (weights[:t, 0, 0] * steady[:t].sum(axis=1)).astype(np.complex64)
    along = np.tensordot(wanted, combined[:, :t].conj(), axes=(0, 1)).reshape(-1, count)
    settled = np.tile((amplitudes @ combinations.conj()).astype(np.complex64), STEPS - free)
    held = form[: free * count, free * count :] @ settled
    right = _rises()[:free] @ along - held.reshape(free, count)
    return bounded_minimum(form[: free * count, : free * count], right, combinations)


def _combinations(hats: Complex64Array, amplitudes: ComplexArray, count: int) -> Complex64Array:
    """Return orthonormal combinations (eras, c) of ERAs whose span includes the amplitudes."""
    eras = len(amplitudes)
    if eras <= count:
        return np.eye(eras, dtype=np.complex64)
    flat = hats.reshape(-1, eras)
    _, vectors = np.linalg.eigh(flat.conj().T @ flat)
    spanning = np.column_stack([amplitudes, vectors[:, 1 - count :]])
    orthonormal, _ = np.linalg.qr(spanning)
    return np.asarray(orthonormal, dtype=np.complex64)


def risen() -> FloatArray:
    """Return the targets' raised cosine at each sample of each step, (steps, samples)."""
    times = KNOT_STEP * (np.arange(STEPS * SAMPLES) + 0.5) / SAMPLES
    return base_motion.rise(times, RISE).reshape(STEPS, SAMPLES)


@cache
def _rises() -> Float32Array:
    """Return the raised cosine at the times of each knot's hat.

    By knot, and by sample and knot of `Carrier.hats`.
    """
    wanted = np.vstack([risen(), np.zeros((STEPS, SAMPLES))])
    since = np.arange(STEPS)[::-1]  # steps since a hat began
    met = wanted[np.arange(STEPS)[:, None] + since]
    return np.asarray(met.transpose(0, 2, 1).reshape(STEPS, -1), dtype=np.float32)


def ending_by_numpy(
    carrier: Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    responses: FingerResponses | None,
    weight: float,
) -> ComplexArray:
    """Find the knots (free, active) in strokes of an ending that brings the whole plate to rest.

    All but the last knots, which are zero. amplitudes (eras,); responses: to the active ERAs
    at quiet fingers that are kept quiet meanwhile.
    """
    eras, total = len(active), len(amplitudes)
    start = amplitudes[active]
    form = carrier.residual_form
    if eras < total:
        rows = (np.arange(ENDING_KNOTS)[:, None] * total + active).ravel()
        form = form[np.ix_(rows, rows)]
    right = -(form[eras:, :eras] @ start)
    form = form[eras:, eras:]
    if responses is not None:
        quiet_form, quiet_right = while_ending(responses, start, carrier.gain_variance)
        form = form + np.float32(weight) * quiet_form
        right += np.float32(weight) * quiet_right
    return bounded_minimum(form, right.reshape(-1, eras), np.eye(eras, dtype=np.complex64))


def while_ending(
    responses: FingerResponses, start: ComplexArray, gain_variance: float
) -> tuple[_ComplexArray, _ComplexArray]:
    """Return form and right-hand side of the mean square at quiet fingers during an ending.

    An ending from a start (eras,) is the steady tone, plus a hat at each knot of the knot's
    difference to the start.
    """
    count = ENDING_KNOTS * SAMPLES
    hats = responses.hats[:, responses.targets :, -ENDING_KNOTS:]
    certain_form = _summed(hats / np.float32(math.sqrt(count)))
    form = _with_errors(certain_form, len(start), gain_variance)
    tones = start * responses.steady[responses.targets :]
    tones = tones.sum(axis=1, keepdims=True) + gain_variance * tones  # with errors, as the form
    by_knot = (hats.sum(axis=0).conj() * tones[:, None]).sum(axis=0)
    along = by_knot[::-1].cumsum(axis=0)[::-1].ravel() / count
    free = len(form) - len(start)
    lowered = form @ np.tile(start, ENDING_KNOTS)
    return form[:free, :free], lowered[:free] - along[:free]


def _expected_power(responses: ComplexArray, gain_variance: float) -> float:
    """Return the expected sum of squares over rows (d, eras) of all ERAs with their errors."""
    together = np.linalg.norm(responses.sum(axis=1)) ** 2
    return float(together + gain_variance * np.linalg.norm(responses) ** 2)


def _expected_form(
    hats: Complex64Array,
    combined: _ComplexArray,
    combinations: Complex64Array,
    gain_variance: float,
) -> _ComplexArray:
    """Return the expected form over knots and combinations (eras, c) of ERAs, as `_summed`.

    hats (samples, d, knots, eras): responses to the ERAs; combined: to the combinations. Errors are
    those of each ERA: in a combination the parts of all ERAs may cancel, their errors do not.
    """
    eras, count = combinations.shape
    certain_form = _summed(combined)
    if count == eras:  # every combination is an ERA
        return _with_errors(certain_form, eras, gain_variance)
    form_by_era = np.stack([_summed(hats[..., era, None]) for era in range(eras)])
    errors = np.einsum("ea,ekl,eb->kalb", combinations.conj(), form_by_era, combinations)
    by_errors = np.float32(gain_variance) * errors.reshape(certain_form.shape)
    return np.asarray(certain_form + by_errors)


def _summed(responses: _ComplexArray) -> _ComplexArray:
    """Return the form over knots and ERAs of squares, summed over samples, rows and steps.

    responses (samples, d, knots, eras): see `FingerResponses.hats`. In the step before the last,
    each hat responds like the next knot's hat in the last step, and so on.
    """
    knots, eras = responses.shape[2:]
    flat = responses.reshape(-1, knots * eras)
    form = flat.conj().T @ flat
    shift = eras
    while shift < len(form):  # sums of 2, 4, 8 ... steps
        form[:-shift, :-shift] += form[shift:, shift:]
        shift *= 2
    return form


def _with_errors(form: _ComplexArray, eras: int, gain_variance: float) -> _ComplexArray:
    """Return the expected form with the ERAs' errors: more of the parts of a single ERA."""
    era = np.arange(len(form)) % eras
    is_single = era[:, None] == era
    factor = np.where(is_single, np.float32(1 + gain_variance), np.float32(1))
    return np.asarray(form * factor)


def steady_states(plate: PlateInTime, omega: float) -> ComplexArray:
    """Return the steady state z (eras, 2 r) at omega [rad/s], by each ERA at full stroke."""
    return np.asarray(plate.following(np.array([1j * omega]))[0][0])


def hat_accelerations(
    plate: PlateInTime, omega: float, *, step: float, steps: int, samples: int
) -> ComplexArray:
    """Return the acceleration (n, eras, r) of the reduced coordinates after the start of a hat.

    omega [rad/s]; step [s]: from the start of a hat to its top. n = steps * samples times, in the
    middle of each interval, since the force jumps at knots.
    """
    s = 1j * omega
    times = step * (np.arange(steps * samples) + 0.5) / samples
    _, a0, a1 = _ramp(plate, s, step)
    b0 = a0 @ plate.displacement.T
    b1 = a1 @ plate.displacement.T
    forced = s**2 * (b0 + times[:, None, None] * b1) + 2 * s * b1
    exponentials = np.exp(np.outer(times, plate.eigenvalues - s))
    free = np.stack([exponentials @ (plate.acceleration * row).T for row in a0], axis=1)
    linear_ramps = forced - free
    hats = linear_ramps.copy()
    hats[samples:] -= 2 * linear_ramps[:-samples]
    hats[2 * samples :] += linear_ramps[: -2 * samples]
    return np.asarray(hats)


def _ramp(
    plate: PlateInTime, s: complex, step: float
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the steady state, a0 and a1 (eras, 2 r) of a linear ramp by each ERA."""
    responses, by_s = plate.following(np.array([s]))
    steady = responses[0]
    return steady, by_s[0] / step, steady / step


def ending_states(plate: PlateInTime, omega: float, *, step: float, steps: int) -> ComplexArray:
    """Return the state z (2 r, steps, eras) at the end of an ending, at full stroke.

    First for a steady tone that falls to zero within one step, then for hats whose tops are after
    step 1, 2, ...
    """
    s = 1j * omega
    steady, a0, a1 = _ramp(plate, s, step)
    times = step * np.arange(steps + 1)
    decay = np.exp(np.outer(times, plate.eigenvalues - s))
    linear_ramps = a0 + times[:, None, None] * a1 - decay[:, None] * a0
    columns = [steady - linear_ramps[steps] + linear_ramps[steps - 1]]
    for knot in range(1, steps):
        since = steps - knot
        columns.append(linear_ramps[since + 1] - 2 * linear_ramps[since] + linear_ramps[since - 1])
    return np.stack(columns).transpose(2, 0, 1)


def mean_square(plate: PlateInTime, duration: float) -> ComplexArray:
    """Return the Hermitian form W (2 r, 2 r) of a free vibration's mean square over T [s].

    z0^H W z0 = 2 <(1/T) int |q''|^2 dt>, mean over the phase of the state z0 at the start. With
    mass-normalized coordinates |q''|^2 is the plate's mass times its mean square acceleration.
    """
    rates = plate.eigenvalues.conj()[:, None] + plate.eigenvalues
    shapes = plate.own_acceleration.conj().T @ plate.own_acceleration
    return shapes * np.expm1(rates * duration) / (rates * duration)


def bounded_minimum(
    form: _ComplexArray, right: _ComplexArray, combinations: Complex64Array
) -> ComplexArray:
    """Minimize x^H form x - 2 Re right^H x such that no ERA exceeds its stroke; return the knots.

    form: positive semidefinite, over knots and combinations; right (k, c); combinations (eras, c):
    orthonormal. Returns knots (k, eras): the unbounded solution if it is within the bounds, else
    a solution within them by alternating directions (ADMM: Boyd and others, 2011, section 5).
    """
    unit = np.eye(len(form))
    size = float(form.diagonal().real.mean())
    to_combinations = combinations.conj()

    def knots_by(inverse: _ComplexArray, right: _ComplexArray) -> _ComplexArray:
        return (inverse @ right.ravel()).reshape(right.shape) @ combinations.T

    unbounded = knots_by(np.linalg.inv(form + _RIDGE * size * unit), right)
    feasible = _within(unbounded)
    exceeds_stroke = np.abs(unbounded).max() > 1
    if exceeds_stroke:
        penalty = PENALTY * size
        inverse = np.linalg.inv(form + (_RIDGE * size + penalty) * unit)
        offset = knots_by(inverse, right)
        dual = np.zeros_like(feasible)
        for _ in range(ITERATIONS):
            knots = offset + penalty * knots_by(inverse, (feasible - dual) @ to_combinations)
            relaxed = RELAXATION * knots + (1 - RELAXATION) * feasible + dual
            feasible = _within(relaxed)
            dual = relaxed - feasible
    return np.asarray(feasible * (1 - 1e-12), dtype=complex)  # within bounds despite rounding


def _within(knots: _ComplexArray) -> _ComplexArray:
    """Limit magnitudes to 1."""
    return np.asarray(knots / np.maximum(np.abs(knots), 1))


def onset_knots(
    amplitudes: ComplexArray, responses: FingerResponses, gain_variance: float
) -> ComplexArray:
    """Find start and knots (1 + ONSET_KNOTS, eras) in strokes, from rest to amplitudes (eras,).

    responses: to these ERAs.
    """
    knots = np.zeros((1 + ONSET_KNOTS, len(amplitudes)), dtype=complex)
    knots[-1] = amplitudes
    tone = ShapedTone(gain_variance=gain_variance, weight=TARGET_WEIGHT)
    if not _solved_by_kernel(knots, tone, amplitudes, responses, is_ending=False):
        knots[1:-1] = onset_by_numpy(amplitudes, responses, gain_variance)
    return knots


def ending_knots(
    carrier: Carrier,
    amplitudes: ComplexArray,
    active: IntArray,
    responses: FingerResponses | None,
) -> ComplexArray:
    """Find start and knots (1 + ENDING_KNOTS, active) in strokes, from amplitudes (eras,) to rest.

    responses: to the active ERAs at quiet fingers that are kept quiet meanwhile.
    """
    knots = np.zeros((1 + ENDING_KNOTS, len(active)), dtype=complex)
    knots[0] = amplitudes[active]
    weight = 0.0
    if responses is not None:
        weight = quiet_weight(carrier, amplitudes, active, responses)
    tone = ShapedTone(gain_variance=carrier.gain_variance, weight=weight, total=len(amplitudes))
    active_numbers = active.astype(np.int32)
    tone.active = active_numbers.ctypes.data
    tone.residual = carrier.residual_form.ctypes.data
    if not _solved_by_kernel(knots, tone, knots[0], responses, is_ending=True):
        knots[1:-1] = ending_by_numpy(carrier, amplitudes, active, responses, weight)
    return knots


def quiet_weight(
    carrier: Carrier, amplitudes: ComplexArray, active: IntArray, responses: FingerResponses
) -> float:
    """Return the weight of the mean square at quiet fingers in an ending (`ending_by_numpy`)."""
    vibration = np.linalg.norm(amplitudes @ carrier.steady)
    target = np.linalg.norm(responses.steady[: responses.targets] @ amplitudes[active])
    return float(_QUIET_WEIGHT * (vibration / target) ** 2)


def _solved_by_kernel(
    knots: ComplexArray,
    tone: ShapedTone,
    amplitudes: ComplexArray,
    responses: FingerResponses | None,
    *,
    is_ending: bool,
) -> bool:
    """Fill in all knots but the first and the last by a kernel; return False without a compiler."""
    compiled = kernels()
    if compiled is None:
        return False
    tone.eras = len(amplitudes)
    tone.amplitudes = amplitudes.ctypes.data
    if responses is not None:
        tone.targets = responses.targets
        tone.rows = len(responses.steady)
        tone.combinations = responses.combinations
        tone.hats = responses.hats.ctypes.data
        tone.steady = responses.steady.ctypes.data
    solve = compiled.library.shaped_knots
    run_kernel(solve, c_void_p(knots[1:].ctypes.data), tone, _rules(), int(is_ending))
    return True


@cache
def _rules() -> Shaping:
    """Pack the constants of shaping for kernels."""
    rules = Shaping(
        samples=SAMPLES,
        steps=STEPS,
        knots=ONSET_KNOTS,
        ending_knots=ENDING_KNOTS,
        iterations=ITERATIONS,
        ridge=_RIDGE,
        penalty=PENALTY,
        relaxation=RELAXATION,
    )
    rules.point(rise=risen())
    return rules
