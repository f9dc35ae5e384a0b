"""Knots of onsets and endings by one call of a kernel in C, or in numpy without a compiler."""

from ctypes import c_void_p
from functools import cache

import numpy as np

from model.arrays import ComplexArray, IntArray
from model.compiled.kernels import ShapedTone, Shaping, kernels, run
from model.transients.knots import (
    ENDING_KNOTS,
    ITERATIONS,
    ONSET_KNOTS,
    PENALTY,
    RELAXATION,
    RIDGE,
    SAMPLES,
    STEPS,
    TARGET_WEIGHT,
    Carrier,
    FingerResponses,
    ending_by_numpy,
    onset_by_numpy,
    risen,
)

# Weight of a quiet finger's motion during an ending, relative to the target, against the plate's
# residual vibration, relative to the steady one. Three times as much changes both by about 1 dB;
# zero makes the ending as loud for the quiet finger as a plain ramp.
_QUIET_WEIGHT = 0.03


def onset_knots(
    amplitudes: ComplexArray, found: FingerResponses, gain_variance: float
) -> ComplexArray:
    """Find start and knots (1 + ONSET_KNOTS, eras) in strokes, from rest to amplitudes (eras,).

    found: of these ERAs.
    """
    knots = np.zeros((1 + ONSET_KNOTS, len(amplitudes)), dtype=complex)
    knots[-1] = amplitudes
    given = ShapedTone(gain_variance=gain_variance, weight=TARGET_WEIGHT)
    if not _found_by_kernel(knots, given, amplitudes, found, is_ending=False):
        knots[1:-1] = onset_by_numpy(amplitudes, found, gain_variance)
    return knots


def ending_knots(
    carrier: Carrier, amplitudes: ComplexArray, active: IntArray, found: FingerResponses | None
) -> ComplexArray:
    """Find start and knots (1 + ENDING_KNOTS, active) in strokes, from amplitudes (eras,) to rest.

    found: of the active ERAs, with quiet fingers that stay quiet meanwhile.
    """
    knots = np.zeros((1 + ENDING_KNOTS, len(active)), dtype=complex)
    knots[0] = amplitudes[active]
    weight = 0.0 if found is None else quiet_weight(carrier, amplitudes, active, found)
    given = ShapedTone(gain_variance=carrier.gain_variance, weight=weight, total=len(amplitudes))
    played = active.astype(np.int32)
    given.active, given.residual = played.ctypes.data, carrier.residual_form.ctypes.data
    if not _found_by_kernel(knots, given, knots[0], found, is_ending=True):
        knots[1:-1] = ending_by_numpy(carrier, amplitudes, active, found, weight)
    return knots


def quiet_weight(
    carrier: Carrier, amplitudes: ComplexArray, active: IntArray, found: FingerResponses
) -> float:
    """Weight of the mean square at quiet fingers in an ending, as `ending_by_numpy` has it."""
    vibration = np.linalg.norm(amplitudes @ carrier.steady)
    target = np.linalg.norm(found.steady[: found.targets] @ amplitudes[active])
    return float(_QUIET_WEIGHT * (vibration / target) ** 2)


def _found_by_kernel(
    knots: ComplexArray,
    given: ShapedTone,
    amplitudes: ComplexArray,
    found: FingerResponses | None,
    *,
    is_ending: bool,
) -> bool:
    """Fill in all knots but the first and the last; False without a compiler."""
    by = kernels()
    if by is None:
        return False
    given.eras, given.amplitudes = len(amplitudes), amplitudes.ctypes.data
    if found is not None:
        given.targets, given.rows = found.targets, len(found.steady)
        given.combinations = found.combinations
        given.hats, given.steady = found.hats.ctypes.data, found.steady.ctypes.data
    run(by.library.shaped_knots, c_void_p(knots[1:].ctypes.data), given, _rules(), int(is_ending))
    return True


@cache
def _rules() -> Shaping:
    rules = Shaping(
        *(SAMPLES, STEPS, ONSET_KNOTS, ENDING_KNOTS, ITERATIONS, RIDGE, PENALTY, RELAXATION)
    )
    rules.point(rise=risen())
    return rules
