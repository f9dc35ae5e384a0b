"""The most likely parameters of measured responses: Levenberg and Marquardt's method."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.arrays import FloatArray
from model.identification.derivatives import jacobian
from model.identification.forward import ForwardModel
from model.identification.measurement import Measurement

_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-7, 1e8
_CONVERGED = 1e-3  # of the cost, whose changes by one standard deviation are 1


@dataclass(frozen=True, eq=False)
class Linearised:
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


@dataclass(frozen=True, eq=False)
class Problem:
    """A model of the tones of a measurement; extra_noise (n,): of each part beside its error."""

    model: ForwardModel
    measurement: Measurement
    extra_noise: FloatArray | None = None

    @cached_property
    def std(self) -> FloatArray:
        """Error of each part (n,)."""
        own = self.measurement.std
        return own if self.extra_noise is None else np.hypot(own, self.extra_noise)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Model less measurement in standard deviations, real parts first, (2 n,)."""
        m = self.measurement
        found = self.model.at(x).responses[m.rows, m.at, m.eras]
        return _parts((found - m.values) / self.std)

    def cost(self, x: FloatArray) -> float:
        """Sum of squares of residuals and parameters."""
        residuals = self.residuals(x)
        return float(residuals @ residuals + x @ x)

    def linearised(self, x: FloatArray) -> Linearised:
        """Residuals and their derivatives."""
        m = self.measurement
        plate = self.model.at(x)
        J = jacobian(plate)[m.rows, m.at, m.eras] / self.std[:, None]
        found = (plate.responses[m.rows, m.at, m.eras] - m.values) / self.std
        return Linearised(x, _parts(found), np.concatenate([J.real, J.imag]))


def solve(
    problem: Problem, start: FloatArray, free: NDArray[np.bool_], *, iterations: int = 40
) -> Linearised:
    """Minimise the cost over the free parameters (p,) within their bounds, from a start (p,)."""
    space = problem.model.space
    x = np.clip(start, space.lower, space.upper)
    now = problem.linearised(x)
    damping = _FIRST_DAMPING
    for _ in range(iterations):
        # Parameters at a bound that they would pass stay there for this step.
        gradient = now.gradient
        held = (x <= space.lower) & (gradient > 0) | (x >= space.upper) & (gradient < 0)
        moving = np.flatnonzero(free & ~held)
        H = now.information[np.ix_(moving, moving)]
        accepted = None
        while damping < _MAX_DAMPING:
            damped = H + damping * np.diag(np.diag(H))
            step = linalg.solve(damped, -gradient[moving], assume_a="pos")
            tried = x.copy()
            tried[moving] += step
            tried = np.clip(tried, space.lower, space.upper)
            cost = problem.cost(tried)
            if cost < now.cost:
                accepted = tried
                break
            if np.abs(step).max() < 1e-6:
                return now
            damping *= 8
        if accepted is None:
            return now
        gained = now.cost - cost
        damping = max(damping / 10, _MIN_DAMPING)
        x, now = accepted, problem.linearised(accepted)
        if gained < _CONVERGED:
            return now
    return now


def _parts(values: NDArray[np.complex128]) -> FloatArray:
    return np.concatenate([values.real, values.imag])
