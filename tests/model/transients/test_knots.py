"""Knots of onsets against a least-squares solution on plates with drawn errors."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import hadamard, null_space

from model.arrays import ComplexArray
from model.transients.knots import (
    ONSET_KNOTS,
    STEPS,
    TARGET_WEIGHT,
    FingerResponses,
    onset_by_numpy,
    onset_knots,
    risen,
)

ERAS = 12
GAIN_VARIANCE = 0.01
SIGNS = hadamard(16)[:, 1 : 1 + ERAS]
"""Errors (16, eras) in standard deviations: no mean, equal variances, no correlation."""


def onset_of_kernel(
    amplitudes: ComplexArray, responses: FingerResponses, gain_variance: float
) -> ComplexArray:
    """The free knots of an onset by the kernel, or by numpy without a compiler."""
    return onset_knots(amplitudes, responses, gain_variance)[1:-1]


def complex_normal(rng: np.random.Generator, *shape: int) -> ComplexArray:
    """Random complex numbers."""
    return rng.standard_normal((*shape, 2)) @ [1, 1j]


@pytest.mark.parametrize("solve", [onset_by_numpy, onset_of_kernel])
def test_onset_of_combinations_is_the_best_with_an_error_of_each_era(
    solve: Callable[[ComplexArray, FingerResponses, float], ComplexArray],
) -> None:
    """A target follows its ramp and a quiet finger stays still, on average over ERAs with errors.

    Twelve ERAs play eight combinations of a pattern that cancels at the quiet finger. No other
    knots in their span have a lower cost, by least squares over all drawn errors together.
    """
    rng = np.random.default_rng(4)
    steady = complex_normal(rng, 2, ERAS)
    hats = 0.1 * complex_normal(rng, 5, 2, STEPS, ERAS).astype(np.complex64)
    responses = FingerResponses(targets=1, hats=hats, steady=steady, combinations=8)
    amplitudes = 0.1 * null_space(steady[1:]) @ complex_normal(rng, ERAS - 1)

    knots = solve(amplitudes, responses, GAIN_VARIANCE)

    gains = 1 + math.sqrt(GAIN_VARIANCE) * SIGNS
    steady_by_draw = gains @ (steady * amplitudes).T
    target_power, quiet_power = (np.abs(steady_by_draw) ** 2).mean(axis=0)
    weights = np.array([TARGET_WEIGHT * math.sqrt(quiet_power / target_power), 1.0])
    # In step m a hat at knot k responds like the hat at knot k + STEPS - 1 - m in the last step.
    by_step = np.zeros((STEPS, *hats.shape), dtype=complex)
    for step in range(STEPS):
        by_step[step, :, :, : step + 1] = hats[:, :, STEPS - 1 - step :]
    weighted = by_step * weights[:, None, None]
    by_draw = weighted * gains[:, None, None, None, None]
    wanted = np.zeros((STEPS, 5, 2), dtype=complex)
    wanted[:, :, 0] = risen() * (weights[0] * steady[0] @ amplitudes)
    settled = by_draw[..., ONSET_KNOTS - 1 :, :].sum(axis=-2) @ amplitudes
    right = (wanted - settled).ravel()
    _, sizes, span = np.linalg.svd(knots)
    combined = by_draw[..., : ONSET_KNOTS - 1, :] @ span[:8].T
    matrix = combined.reshape(len(right), -1)
    best = np.linalg.lstsq(matrix, right)[0]
    found = (knots @ span[:8].conj().T).ravel()
    best_cost = np.linalg.norm(matrix @ best - right) ** 2
    cost = np.linalg.norm(matrix @ found - right) ** 2
    assert sizes[8] < 1e-4 * sizes[7]
    assert np.abs(knots).max() < 1
    assert cost == pytest.approx(best_cost, rel=1e-4)
