"""Fit plate parameters to a measurement: the most likely values and their covariance.

    d_fsn = g_fn a_fsn(x) + noise

d are the values at frequency f, sensor s and drive n; a are responses of a forward model whose
parameters x have a normal prior (of its `Space`, or given). Gains g are 1, or free at every
frequency and drive (`model.estimate.gains`). Outliers are weighted down by a soft loss, or left out
by `model.estimate.noise`. Among several hypotheses, each with its own model, the one with the
lowest cost is the most likely.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.arrays import ComplexArray, FloatArray, best_by, best_first
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.forward import ForwardModel, PlateAt
from model.estimate.gains import best_gains, gain_residuals
from model.estimate.measurement import Measurement
from model.estimate.parameter_space import Space
from model.estimate.parameters import jacobian

HELD_OUT_FOLDS = 5
"""One in this many paths or sensors is held out."""

_CONVERGED = 1e-7  # relative, for the cost and for x
_MIN_VARIANCE = 1e-14  # of a prior, relative to its largest variance
_INSIDE = 1e-9  # minimum distance of a start from its bounds, where a search takes small steps

ModelT = TypeVar("ModelT", bound=ForwardModel)


class JointPrior(NamedTuple):
    """Normal prior distribution of all parameters together."""

    mean: FloatArray
    """(p,)."""
    covariance: FloatArray
    """(p, p)."""


@dataclass(frozen=True, eq=False)
class Fit(Generic[ModelT]):
    """Most likely parameters of a model for a measurement, and the linearized fit at that point.

    Residuals and slopes are relative to standard errors, after applying the soft loss, if any.
    """

    model: ModelT
    measurement: Measurement
    x: FloatArray
    """All parameters (p,)."""
    cost: float
    """Half the sum of squares of all residuals, including the prior's."""
    searched: NDArray[np.bool_]
    """Mask (p,) of the q parameters that were searched."""
    residuals: FloatArray
    """Real parts of all m values, imaginary parts, then the q rows of the prior and the k of held
    gains (2 m + q + k,)."""
    slopes: FloatArray
    """Derivatives of the residuals by the searched parameters (2 m + q + k, q)."""
    predicted: ComplexArray
    """Values predicted by model and gains (f, s, n)."""
    gains: ComplexArray
    """Gains (f, n): 1 if fixed, NaN if free but not measured."""
    gain_slopes: ComplexArray
    """Derivatives of the gains by the searched parameters (f, n, q)."""

    @property
    def space(self) -> Space:
        """The parameters."""
        return self.model.space

    @cached_property
    def fitted_plate(self) -> PlateAt:
        """The plate of x."""
        return self.model.at(self.x)

    @cached_property
    def of_values(self) -> tuple[FloatArray, FloatArray]:
        """Residuals (2 m,) and slopes (2 m, q) without the rows of the prior."""
        count = 2 * self.measurement.count
        return self.residuals[:count], self.slopes[:count]

    @cached_property
    def information(self) -> FloatArray:
        """J^T J of the searched parameters, including the prior (q, q)."""
        return self.slopes.T @ self.slopes

    @cached_property
    def chi2(self) -> float:
        """Squared residuals of the values per degree of freedom."""
        r, J = self.of_values
        used = np.trace(linalg.solve(self.information, J.T @ J, assume_a="pos"))
        if self.measurement.gain_std:
            used += 2 * self.measurement.known.any(axis=1).sum()
        return float(r @ r / max(len(r) - used, 1.0))

    @cached_property
    def stated_covariance(self) -> FloatArray:
        """Covariance of x from the stated measurement errors (p, p), 0 for fixed parameters."""
        covariance = np.zeros((len(self.x), len(self.x)))
        numbers = np.flatnonzero(self.searched)
        covariance[np.ix_(numbers, numbers)] = linalg.inv(self.information)
        return covariance

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of x (p, p), widened if the residuals exceed the stated errors."""
        return max(self.chi2, 1.0) * self.stated_covariance

    @cached_property
    def errors(self) -> FloatArray:
        """Standard errors of x (p,), 0 for fixed parameters."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def leverage(self) -> FloatArray:
        """Fraction of each value's noise absorbed by the searched parameters (m,)."""
        root = linalg.cholesky(self.information, lower=True)
        _, slopes = self.of_values
        absorbed = (linalg.solve_triangular(root, slopes.T, lower=True) ** 2).sum(axis=0)
        return np.asarray(absorbed.reshape(2, -1).mean(axis=0))

    def loads(
        self,
        points: FloatArray,
        *,
        factor: FloatArray | ComplexArray | None = None,
        std: float = 1.0,
    ) -> list[tuple[int, float]]:
        """Find the points (m, 2) [m] where a single load explains most: index and size, best first.

        A load of size s changes the residuals r by b s. Together with the searched parameters,
        whose derivatives are J, it minimizes |r + J dx + b s|² and the priors. factor (f,): effect
        of a load of size 1 relative to 1 kg, default 1; std: prior standard error of the size,
        which must be positive to count.
        """
        load_slopes = ResponseDerivatives(self.fitted_plate).mass_at(points)
        if factor is not None:
            load_slopes = load_slopes * factor[:, None, None, None]
        driven = self.measurement.driven
        responses = driven(self.fitted_plate.responses)
        columns = best_gains(responses, driven(load_slopes), self.measurement).slopes
        by_size = std * np.vstack([columns.real, columns.imag])
        r, J = self.of_values
        J = np.asfortranarray(J)  # all products below are of columns
        slopes = np.asfortranarray(self.slopes)
        information = linalg.cho_factor(slopes.T @ slopes)
        # Parts of r and b that the searched parameters cannot explain.
        unexplained = r - J @ linalg.cho_solve(information, slopes.T @ self.residuals)
        effect = by_size - J @ linalg.cho_solve(information, J.T @ by_size)
        gradient = -(unexplained @ by_size)
        sizes = gradient / ((by_size * effect).sum(axis=0) + 1)
        reduction = np.where(sizes > 0, sizes * gradient, 0.0)
        return [(int(n), std * float(sizes[n])) for n in best_first(reduction) if reduction[n] > 0]


def likeliest_fit(fits: Sequence[Fit[ModelT]]) -> Fit[ModelT]:
    """Return the fit with the lowest cost; if several are nearly equal, the first."""
    return best_by(fits, lambda fit: -fit.cost)


def fit(
    model: ModelT,
    measurement: Measurement,
    *,
    searched: NDArray[np.bool_] | None = None,
    start: FloatArray | None = None,
    prior: JointPrior | None = None,
    soft: float | None = None,
    evaluations: int = 40,
) -> Fit[ModelT]:
    """Find the most likely parameters of a model for a measurement.

    - searched (p,): mask of the parameters to find; default: all uncertain ones.
    - start (p,): start values, and values of all fixed parameters; default: zero.
    - prior: used instead of the prior of the space.
    - soft: number of standard errors above which the magnitude of a residual counts, not the
      square.
    - evaluations: maximum number of model evaluations.
    """
    from scipy.optimize import least_squares  # a daemon reads fits without fitting

    space = model.space
    if searched is None:
        searched = space.uncertain
    if start is None:
        start = np.zeros(space.size)
    mean, root = _whitened(prior, searched)
    problem = _Problem(model, measurement, searched, start, mean, root, soft)
    if not searched.any():
        result = problem.at(start[searched])
        return replace(result, cost=float(result.residuals @ result.residuals / 2))
    lower = space.lower[searched]
    upper = space.upper[searched]
    margin = np.minimum(_INSIDE, (upper - lower) / 4)
    solution = least_squares(
        problem.residuals,
        np.clip(start[searched], lower + margin, upper - margin),
        problem.slopes,
        bounds=(lower, upper),
        x_scale="jac",
        max_nfev=evaluations,
        ftol=_CONVERGED,
        xtol=_CONVERGED,
    )
    return replace(problem.at(solution.x), cost=float(solution.cost))


def _whitened(
    prior: JointPrior | None, searched: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (q,) and R (q, q), R^T R = C^-1, of the searched parameters' prior."""
    if prior is None:
        count = int(searched.sum())
        return np.zeros(count), np.eye(count)
    variances, axes = linalg.eigh(prior.covariance[np.ix_(searched, searched)])
    # Some eigenvalues are tiny, and can be below zero.
    scaled = axes / np.sqrt(np.maximum(variances, _MIN_VARIANCE * variances[-1]))
    return prior.mean[searched], scaled.T


@dataclass(eq=False)
class _Problem(Generic[ModelT]):
    """A fit as a least-squares problem of the searched parameters y (q,)."""

    model: ModelT
    measurement: Measurement
    searched: NDArray[np.bool_]
    start: FloatArray
    prior_mean: FloatArray
    prior_root: FloatArray
    """R (q, q), R^T R = C^-1, for a covariance C."""
    soft: float | None
    latest: Fit[ModelT] | None = None
    """Result of `at`, cached."""

    def residuals(self, y: FloatArray) -> FloatArray:
        """Residuals at y; see `Fit.residuals`."""
        return self.at(y).residuals

    def slopes(self, y: FloatArray) -> FloatArray:
        """Derivatives of the residuals by y; see `Fit.slopes`."""
        return self.at(y).slopes

    def at(self, y: FloatArray) -> Fit[ModelT]:
        """Return the linearized fit at y, without its cost; the latest one is cached."""
        x = self.start.copy()
        x[self.searched] = y
        if self.latest is None or not np.array_equal(self.latest.x, x):
            self.latest = self._linearized(x)
        return self.latest

    def _linearized(self, x: FloatArray) -> Fit[ModelT]:
        plate = self.model.at(x)
        responses = self.measurement.driven(plate.responses)
        slopes = self.measurement.driven(jacobian(plate, self.searched)[..., self.searched])
        gain_fit = best_gains(responses, slopes, self.measurement)
        r, J = gain_fit.residuals, gain_fit.slopes
        gain_r, gain_J = gain_residuals(gain_fit, self.measurement.gain_std)
        if self.soft is not None:
            r, J = _softened(r, J, self.soft)
            gain_r, gain_J = _softened(gain_r, gain_J, self.soft)
        prior_r = self.prior_root @ (x[self.searched] - self.prior_mean)
        return Fit(
            model=self.model,
            measurement=self.measurement,
            x=x,
            cost=np.nan,
            searched=self.searched,
            residuals=np.concatenate([r.real, r.imag, prior_r, gain_r.real]),
            slopes=np.vstack([J.real, J.imag, self.prior_root, gain_J.real]),
            predicted=np.nan_to_num(gain_fit.gains)[:, None] * responses,
            gains=gain_fit.gains,
            gain_slopes=gain_fit.gain_slopes,
        )


def _softened(
    residuals: ComplexArray, slopes: ComplexArray, scale: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return residuals (m,) whose squares are a soft L1 loss, and their derivatives (m, q)."""
    root = np.sqrt(1 + (np.abs(residuals) / scale) ** 2)
    weight = np.sqrt(2 / (1 + root))
    growth = (residuals.conj()[:, None] * slopes).real
    growth = growth / (2 * scale**2 * root * (1 + root))[:, None]
    return weight * residuals, weight[:, None] * (slopes - residuals[:, None] * growth)
