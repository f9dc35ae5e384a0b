"""Nonlinear least squares with exact derivatives and priors, for every fit of a plate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.choice import best_first


@dataclass(frozen=True, eq=False)
class Found:
    """Where a search ended: y (n,), and half the sum of squares that it minimised.

    residuals (2 m + k,), jacobian (2 m + k, n): real parts of all m values, imaginary parts, then
    the k rows of the prior; without robust weights.
    """

    y: FloatArray
    cost: float
    residuals: FloatArray
    jacobian: FloatArray


def search(
    linearised: Callable[[FloatArray], tuple[ComplexArray, ComplexArray]],
    start: FloatArray,
    bounds: FloatArray,
    *,
    prior: tuple[FloatArray, FloatArray] | None = None,
    robust: float | None = None,
    evaluations: int = 60,
    tolerance: float = 1e-8,
    inside: float = 1e-9,
) -> Found:
    """Minimize complex residuals (m,) with derivatives (m, n), from a start within bounds (2, n).

    All in standard deviations. prior: rows (k, n) and what they are to give (k,), by default each
    argument by itself and zero; robust: standard deviations from which a residual counts as its
    magnitude, not its square. evaluations: at most; a plate that fits takes ten. tolerance: of the
    sum of squares, relative; inside: how far from its bounds a start is at least, without which a
    start that is zero begins with small steps.
    """
    rows, targets = (np.eye(len(start)), np.zeros(len(start))) if prior is None else prior
    last: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def real(y: FloatArray, scale: float | None) -> tuple[FloatArray, FloatArray]:
        left, slopes = linearised(y)
        if scale is not None:
            left, slopes = _softened(left, slopes, scale)
        return (
            np.concatenate([left.real, left.imag, rows @ y - targets]),
            np.vstack([slopes.real, slopes.imag, rows]),
        )

    def both(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = y.tobytes()
        if key not in last:
            last.clear()
            last[key] = real(y, robust)
        return last[key]

    def residuals(y: FloatArray) -> FloatArray:
        return both(y)[0]

    def jacobian(y: FloatArray) -> FloatArray:
        return both(y)[1]

    from scipy.optimize import least_squares  # a daemon reads what was fitted, but fits nothing

    least = np.minimum(inside, np.ptp(bounds, axis=0) / 4)
    found = least_squares(
        residuals,
        np.clip(start, bounds[0] + least, bounds[1] - least),
        jacobian,
        bounds=(bounds[0], bounds[1]),
        x_scale="jac",
        max_nfev=evaluations,
        xtol=1e-7,
        ftol=tolerance,
    )
    plain = both(found.x) if robust is None else real(found.x, None)
    return Found(found.x, float(found.cost), *plain)


def single_changes(
    slopes: FloatArray, curvatures: FloatArray, std: float
) -> list[tuple[int, float]]:
    """Which of m changes explain most, each alone, the most telling first, with its size above 0.

    slopes, curvatures (m,): of half the sum of squares by each where all else has followed, the
    slopes downwards; std: of the sizes beforehand.
    """
    curvatures = curvatures + std**-2
    sizes = slopes / curvatures
    gains = np.where(sizes > 0, sizes * slopes, 0.0)
    return [(int(n), float(sizes[n])) for n in best_first(gains) if gains[n] > 0]


def _softened(
    left: ComplexArray, slopes: ComplexArray, scale: float
) -> tuple[ComplexArray, ComplexArray]:
    """Residuals (m,) whose squares are a soft L1 loss, and their derivatives (m, n)."""
    root = np.sqrt(1 + (np.abs(left) / scale) ** 2)
    weight = np.sqrt(2 / (1 + root))
    grown = (left.conj()[:, None] * slopes).real / (2 * scale**2 * root * (1 + root))[:, None]
    return weight * left, weight[:, None] * (slopes - left[:, None] * grown)
