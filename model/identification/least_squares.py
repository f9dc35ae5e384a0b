"""Nonlinear least squares with exact derivatives, for every fit of a plate."""

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from model.arrays import FloatArray

Loss: TypeAlias = Literal["linear", "soft_l1"]


def search(
    linearised: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    start: FloatArray,
    bounds: FloatArray,
    *,
    loss: Loss = "linear",
    evaluations: int = 60,
    tolerance: float = 1e-8,
) -> OptimizeResult:
    """Minimize residuals (m,) with derivatives (m, n), from a start (n,) within bounds (2, n).

    evaluations: at most; a plate that fits takes ten. tolerance: of the sum of squares, relative.
    The derivatives of the result are those of the residuals, whatever the loss.
    """
    last: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = y.tobytes()
        if key not in last:
            last.clear()
            last[key] = linearised(y)
        return last[key]

    def residuals(y: FloatArray) -> FloatArray:
        return both(y)[0]

    def jacobian(y: FloatArray) -> FloatArray:
        return both(y)[1]

    found = least_squares(
        residuals,
        np.clip(start, bounds[0] + 1e-9, bounds[1] - 1e-9),
        jacobian,
        bounds=(bounds[0], bounds[1]),
        loss=loss,
        x_scale="jac",
        max_nfev=evaluations,
        xtol=1e-7,
        ftol=tolerance,
    )
    if loss != "linear":
        found.jac = jacobian(found.x)  # which it has scaled
    return found
