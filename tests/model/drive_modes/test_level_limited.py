"""Weights that reach the level within full stroke, against a general constrained optimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from model.drive_modes import find_drives
from model.drive_modes.forms import Forms


def _forms(seed: int, short: float) -> Forms:
    """Random forms at one frequency, whose best weights miss the level by a factor."""
    rng = np.random.default_rng(seed)
    target = rng.normal(size=4) + 1j * rng.normal(size=4)
    near = target + 0.2 * (rng.normal(size=4) + 1j * rng.normal(size=4))
    form = np.outer(near.conj(), near) + 0.01 * np.diag(np.abs(near) ** 2)
    best = np.linalg.solve(form, target.conj())
    level = abs(target @ best) / np.abs(best).max()
    assert short * level < np.abs(target).sum()
    power = np.outer(target.conj(), target)
    return Forms(
        targets=target[None, None].astype(np.complex64),
        target_power=power[None, None].astype(np.complex64),
        quiet=form[None, None].astype(np.complex64),
        threshold=np.ones(1, dtype=np.float32),
        wanted=short * level,
        level_margin=0.0,
    )


def _optimum(forms: Forms) -> float:
    """The best score within full stroke, by sequential quadratic programming."""
    target, form = forms.targets[0, 0].astype(complex), forms.quiet[0, 0].astype(complex)
    n = len(target)

    def weights(x):
        return x[:n] + 1j * x[n:]

    def power(x):
        return float((weights(x).conj() @ form @ weights(x)).real)

    limits = [
        {"type": "ineq", "fun": lambda x: 1 - np.abs(weights(x)) ** 2},
        {"type": "ineq", "fun": lambda x: (target @ weights(x)).real - forms.wanted},
        {"type": "eq", "fun": lambda x: (target @ weights(x)).imag},
    ]
    loud = target.conj() / np.abs(target)
    start = np.concatenate([loud.real, loud.imag]) * 0.99
    found = minimize(power, start, constraints=limits, method="SLSQP", options={"maxiter": 500})
    assert found.success
    return float(abs(target @ weights(found.x)) / np.sqrt(power(found.x)))


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("short", [1.1, 1.4])
def test_level_beyond_the_best_weights_costs_no_more_than_it_must(seed: int, short: float) -> None:
    """The drive reaches the level within full stroke, half a decibel from the best at most."""
    forms = _forms(seed, short)
    (score, drive), *_ = find_drives(forms, "phased")
    assert np.abs(drive.values).max() <= 1 + 1e-6
    assert abs(forms.targets[0, 0] @ drive.values) >= 0.999 * forms.wanted
    assert 20 * np.log10(_optimum(forms) / score) < 0.5
