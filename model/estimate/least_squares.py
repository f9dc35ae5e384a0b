"""Nonlinear least squares with exact derivatives and priors, and the measurements that are fitted.

`search` serves every fit of a plate. `solve` finds the most likely parameters of a forward model
for a `Measurement`: responses of sensors to ERAs on the rig in place, with errors and repetitions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.arrays import ComplexArray, FloatArray, best_first
from model.estimate.forward import ForwardModel, jacobian
from model.estimate.measurement import Measurement

_CONVERGED = 1e-7  # of the cost, whose changes by one standard deviation are 1


@dataclass(frozen=True, eq=False)
class Minimum:
    """End of a search."""

    x: FloatArray
    """All parameters (p,)."""
    cost: float
    """Half the sum of squares that was minimised."""
    residuals: FloatArray
    """Real parts of all m values, imaginary parts, then the k rows of the prior (2 m + k,), without
    robust weights."""
    jacobian: FloatArray
    """Derivatives of the residuals by the n searched parameters (2 m + k, n)."""


def search(
    linearised: Callable[[FloatArray], tuple[ComplexArray, ComplexArray]],
    start: FloatArray,
    bounds: FloatArray,
    searched: NDArray[np.bool_],
    *,
    prior: tuple[FloatArray, FloatArray] | None = None,
    robust: float | None = None,
    evaluations: int = 60,
    tolerance: float = 1e-8,
    inside: float = 1e-9,
) -> Minimum:
    """Minimize complex residuals (m,) over the n of x (p,) that are searched (p,).

    All in standard deviations. linearised: residuals of x, and their derivatives (m, n) by what is
    searched; start (p,): of all, which the others keep; bounds (2, p). prior: rows (k, n) and what
    they are to give (k,), by default each argument by itself and zero; robust: standard deviations
    from which a residual counts as its magnitude, not its square. evaluations: at most; a plate
    that fits takes ten. tolerance: of the sum of squares, relative; inside: how far from its bounds
    a start is at least, without which a start that is zero begins with small steps.
    """
    count = int(searched.sum())
    rows, targets = (np.eye(count), np.zeros(count)) if prior is None else prior
    bounds = bounds[:, searched]
    last: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def whole(y: FloatArray) -> FloatArray:
        x = start.copy()
        x[searched] = y
        return x

    def real(y: FloatArray, scale: float | None) -> tuple[FloatArray, FloatArray]:
        left, slopes = linearised(whole(y))
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
        np.clip(start[searched], bounds[0] + least, bounds[1] - least),
        jacobian,
        bounds=(bounds[0], bounds[1]),
        x_scale="jac",
        max_nfev=evaluations,
        xtol=1e-7,
        ftol=tolerance,
    )
    plain = both(found.x) if robust is None else real(found.x, None)
    return Minimum(whole(found.x), float(found.cost), *plain)


def single_changes(
    slopes: FloatArray, curvatures: FloatArray, std: float
) -> list[tuple[int, float]]:
    """Sizes of the changes that explain most, each alone: number and size above 0, best first.

    slopes, curvatures (m,): downward slope and curvature of half the sum of squares by each change,
    where all else follows it; std: prior standard deviation of the sizes.
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


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals in standard deviations (2 n,) and their derivatives by x (2 n, p) at x (p,)."""

    x: FloatArray
    residuals: FloatArray
    jacobian: FloatArray

    @cached_property
    def cost(self) -> float:
        """Sum of squares of residuals and parameters: minus twice the log likelihood."""
        return float(self.residuals @ self.residuals + self.x @ self.x)

    @cached_property
    def information(self) -> FloatArray:
        """J^T J + 1, (p, p)."""
        found = self.jacobian.T @ self.jacobian
        found[np.diag_indices_from(found)] += 1
        return np.asarray(found)

    @cached_property
    def gradient(self) -> FloatArray:
        """Half the derivative of the cost, (p,)."""
        return np.asarray(self.jacobian.T @ self.residuals + self.x)

    def further(self, columns: FloatArray) -> list[tuple[int, float]]:
        """Find `single_changes` of prior standard deviation 1, which all x follow.

        columns (2 n, m): derivatives of the residuals by each.
        """
        H, J = linalg.cho_factor(self.information), self.jacobian
        left = self.residuals - J @ linalg.cho_solve(H, self.gradient)
        beside = columns - J @ linalg.cho_solve(H, J.T @ columns)
        return single_changes(-(left @ columns), (columns * beside).sum(axis=0), 1.0)


@dataclass(frozen=True, eq=False)
class IdentificationProblem:
    """A forward model and the measurement that it is fitted to."""

    model: ForwardModel
    measurement: Measurement
    extra_noise: FloatArray | None = None
    """Noise of each part (f, 1, 1) beside the error of the measurement."""

    @cached_property
    def std(self) -> FloatArray:
        """Error of each part of the values that were measured (n,)."""
        std = np.hypot(self.measurement.std, 0.0 if self.extra_noise is None else self.extra_noise)
        return std[self.measurement.known]

    def residuals(self, x: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Residuals in standard deviations (n,) and their derivatives (n, p)."""
        measurement, plate = self.measurement, self.model.at(x)
        J = jacobian(plate)[measurement.known] / self.std[:, None]
        return (plate.responses - measurement.values)[measurement.known] / self.std, J

    def linearised(self, x: FloatArray) -> Linearization:
        """Linearise at x (p,), in real and imaginary parts."""
        found, J = self.residuals(x)
        residuals = np.concatenate([found.real, found.imag])
        return Linearization(x, residuals, np.concatenate([J.real, J.imag]))


def solve(
    problem: IdentificationProblem,
    start: FloatArray,
    free: NDArray[np.bool_],
    *,
    evaluations: int = 40,
) -> Linearization:
    """Minimise the cost over the free parameters (p,) within their bounds, from a start (p,).

    evaluations: of the model, at most.
    """
    space = problem.model.space

    def linearised(x: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        residuals, J = problem.residuals(x)
        return residuals, J[:, free]

    found = search(
        linearised,
        np.clip(start, space.lower, space.upper),
        np.array([space.lower, space.upper]),
        free,
        evaluations=evaluations,
        tolerance=_CONVERGED,
    )
    return problem.linearised(found.x)
