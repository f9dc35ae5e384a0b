"""The most likely parameters of measured responses."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.identification.derivatives import jacobian
from model.identification.forward import ForwardModel
from model.identification.least_squares import search
from model.identification.measurement import Measurement

_CONVERGED = 1e-7  # of the cost, whose changes by one standard deviation are 1


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
    """A model of a measurement; extra_noise (f, 1, 1): of each part beside its error."""

    model: ForwardModel
    measurement: Measurement
    extra_noise: FloatArray | None = None

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

    def linearised(self, x: FloatArray) -> Linearised:
        """The same in real and imaginary parts."""
        found, J = self.residuals(x)
        residuals = np.concatenate([found.real, found.imag])
        return Linearised(x, residuals, np.concatenate([J.real, J.imag]))


def solve(
    problem: Problem, start: FloatArray, free: NDArray[np.bool_], *, evaluations: int = 40
) -> Linearised:
    """Minimise the cost over the free parameters (p,) within their bounds, from a start (p,).

    evaluations: of the model, at most.
    """
    space = problem.model.space
    searched = np.flatnonzero(free)

    def full(y: FloatArray) -> FloatArray:
        x = np.clip(start, space.lower, space.upper)
        x[searched] = y
        return x

    def linearised(y: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        residuals, J = problem.residuals(full(y))
        return residuals, J[:, searched]

    bounds = np.array([space.lower, space.upper])[:, searched]
    found = search(
        linearised, start[searched], bounds, evaluations=evaluations, tolerance=_CONVERGED
    )
    return problem.linearised(full(found.y))
