"""Fit plate parameters to a measurement: the most likely values and their covariance.

    d_fsn = g_fn a_fsn(x) + noise

d are the values at frequency f, sensor s and drive n; a are values of a forward model whose
parameters x have a normal prior (of its `Space`, or given). Gains g are 1, or free at every
frequency and drive. Free gains follow from a by linear least squares, so that only x is searched,
with the derivatives of gains and residuals with respect to x (variable projection: Golub and
Pereyra, SIAM J. Numer. Anal. 10, 1973). Outliers are weighted down by a soft loss, or left out by
`fit_to_noise`, which also estimates the noise from the residuals. Among several hypotheses, each
with its own model, the one with the lowest cost is the most likely.

A `SensedPlate` is a rig's plate with the sensors of a measurement, and with the data-sheet values
that calibration and rig check fit.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.arrays import ComplexArray, FloatArray, IntArray, best_by, best_first
from model.config.document import KeyPath
from model.estimate.forward import (
    MASS_CELLS,
    ForwardModel,
    PlateAt,
    PlateValues,
    Sensor,
    Space,
    by_mass_at,
    jacobian,
)
from model.estimate.measurement import Measurement
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.space import MAX_GUESSED, VALUE_UNITS, rig_with, space_from_datasheets
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduced_modes
from model.rig.actuator_keys import ACTUATOR_KINDS as ACTUATOR_KEYS
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.modal_elasticity import check_is_plate

HELD_OUT_FOLDS = 5
"""One in this many paths or sensors is held out."""

_CONVERGED = 1e-7  # relative, for the cost and for x
_MIN_VARIANCE = 1e-14  # of a prior, relative to its largest variance
_ROUNDS = 8  # fits and noise estimates
_SETTLED = 0.1  # of the noise, between two rounds
_MIN_NOISE_LEFT = 0.1  # of a value's noise; residuals with less do not show the noise
_SMALLEST_NOISE = 1e-4  # of the response, the error of meshes and reduction
_MAX_DEVIATION = 5.0  # standard deviations; exceeded by 0.04 of 10 000 good complex values
_MAX_GROUPS = 12  # of rows by amplitude, each with its own noise


@dataclass(frozen=True, eq=False)
class Fit:
    """Most likely parameters of a model for a measurement, and the linearized fit at that point.

    Residuals and slopes are in standard deviations, after applying the soft loss, if any.
    """

    model: ForwardModel
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
    def plate(self) -> PlateAt:
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
        return np.asarray(self.slopes.T @ self.slopes)

    @cached_property
    def chi2(self) -> float:
        """Squared residuals of the values per degree of freedom."""
        r, J = self.of_values
        taken = np.trace(linalg.solve(self.information, J.T @ J, assume_a="pos"))
        if self.measurement.gain_std:
            taken += 2 * self.measurement.known.any(axis=1).sum()
        return float(r @ r / max(len(r) - taken, 1.0))

    @cached_property
    def stated_covariance(self) -> FloatArray:
        """Covariance of x from the stated measurement errors (p, p), 0 for fixed parameters."""
        found, own = np.zeros((len(self.x), len(self.x))), np.flatnonzero(self.searched)
        found[np.ix_(own, own)] = linalg.inv(self.information)
        return found

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of x (p, p), widened if the residuals exceed the stated errors."""
        return max(self.chi2, 1.0) * self.stated_covariance

    @cached_property
    def errors(self) -> FloatArray:
        """Standard errors of x (p,), 0 for fixed parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @cached_property
    def leverage(self) -> FloatArray:
        """Fraction of each value's noise absorbed by the searched parameters (m,)."""
        root = linalg.cholesky(self.information, lower=True)
        taken = (linalg.solve_triangular(root, self.of_values[1].T, lower=True) ** 2).sum(axis=0)
        return np.asarray(taken.reshape(2, -1).mean(axis=0))

    def loads(
        self,
        points: FloatArray,
        *,
        factor: FloatArray | ComplexArray | None = None,
        std: float = 1.0,
        beside: NDArray[np.bool_] | None = None,
    ) -> list[tuple[int, float]]:
        """Find the points (m, 2) [m] where a single load explains most: index and size, best first.

        factor (f,): effect of a load of size 1 relative to 1 kg, default 1; std: prior standard
        deviation of the size, which must be positive to count; beside: mask (p,) of parameters
        fitted together with the load, default all searched ones.
        """
        by_load = by_mass_at(self.plate, points)
        if factor is not None:
            by_load = by_load * factor[:, None, None, None]
        driven = self.measurement.driven
        responses, by_load = driven(self.plate.responses), driven(by_load)
        _, _, _, columns = best_gains(responses, by_load, self.measurement)
        by_size = std * np.vstack([columns.real, columns.imag])
        r, J = self.of_values
        kept = np.ones(J.shape[1], bool) if beside is None else beside[self.searched]
        J, rows = J[:, kept], np.ones(len(self.slopes), bool)
        rows[len(r) : len(r) + len(kept)] = kept
        whole = self.slopes[rows][:, kept]
        H = linalg.cho_factor(whole.T @ whole)
        left = r - J @ linalg.cho_solve(H, whole.T @ self.residuals[rows])
        following = by_size - J @ linalg.cho_solve(H, J.T @ by_size)
        downhill = -(left @ by_size)
        sizes = downhill / ((by_size * following).sum(axis=0) + 1)
        explained = np.where(sizes > 0, sizes * downhill, 0.0)
        return [(int(n), std * float(sizes[n])) for n in best_first(explained) if explained[n] > 0]


def fit(
    model: ForwardModel,
    measurement: Measurement,
    *,
    searched: NDArray[np.bool_] | None = None,
    start: FloatArray | None = None,
    prior: tuple[FloatArray, FloatArray] | None = None,
    soft: float | None = None,
    evaluations: int = 40,
    inside: float = 1e-9,
) -> Fit:
    """Find the most likely parameters of a model for a measurement.

    - searched (p,): mask of the parameters to find; default: all uncertain ones.
    - start (p,): start values, and values of all fixed parameters; default: zero.
    - prior: mean (p,) and covariance (p, p) instead of the deviations of the space.
    - soft: standard deviations above which a residual counts by its magnitude, not its square.
    - evaluations: maximum number of model evaluations.
    - inside: minimum distance of the start from its bounds; near a bound, a search takes small
      steps.
    """
    from scipy.optimize import least_squares  # a daemon reads fits without fitting

    space = model.space
    own = space.uncertain if searched is None else searched
    base = np.zeros(space.size) if start is None else start
    low, high = space.lower[own], space.upper[own]
    mean, root = np.zeros(int(own.sum())), np.eye(int(own.sum()))
    if prior is not None:
        variances, axes = linalg.eigh(prior[1][np.ix_(own, own)])
        scaled = axes / np.sqrt(np.maximum(variances, _MIN_VARIANCE * variances[-1]))
        mean, root = (
            prior[0][own],
            np.asarray(scaled.T),
        )  # R^T R = C^-1, though some eigenvalues are tiny
    last: dict[bytes, Fit] = {}

    def at(y: FloatArray) -> Fit:
        if y.tobytes() not in last:
            x = base.copy()
            x[own] = y
            last.clear()
            last[y.tobytes()] = _linearised(model, measurement, x, own, (mean, root), soft)
        return last[y.tobytes()]

    margin = np.minimum(inside, (high - low) / 4)
    if not own.any():
        found = at(mean)
        return replace(found, cost=float(found.residuals @ found.residuals / 2))

    def residuals(y: FloatArray) -> FloatArray:
        return at(y).residuals

    def slopes_at(y: FloatArray) -> FloatArray:
        return at(y).slopes

    best = least_squares(
        residuals,
        np.clip(base[own], low + margin, high - margin),
        slopes_at,
        bounds=(low, high),
        x_scale="jac",
        max_nfev=evaluations,
        ftol=_CONVERGED,
        xtol=_CONVERGED,
    )
    return replace(at(best.x), cost=float(best.cost))


def _linearised(
    model: ForwardModel,
    measurement: Measurement,
    x: FloatArray,
    own: NDArray[np.bool_],
    prior: tuple[FloatArray, FloatArray],
    soft: float | None,
) -> Fit:
    """Linearize a fit at x (p,), without its cost; own (p,): mask of the searched parameters.

    prior: mean (q,) and root of the inverse covariance (q, q) of the searched parameters.
    """
    plate, (mean, root) = model.at(x), prior
    responses = measurement.driven(plate.responses)
    slopes = measurement.driven(jacobian(plate, own)[..., own])
    gains, by_gain, r, J = best_gains(responses, slopes, measurement)
    held, by_held = _gain_residuals(gains, by_gain, measurement.gain_std)
    if soft is not None:
        r, J = _softened(r, J, soft)
        held, by_held = _softened(held, by_held, soft)
    return Fit(
        model,
        measurement,
        x,
        np.nan,
        own,
        np.concatenate([r.real, r.imag, root @ (x[own] - mean), held.real]),
        np.vstack([J.real, J.imag, root, by_held.real]),
        np.nan_to_num(gains)[:, None] * responses,
        gains,
        by_gain,
    )


def best_gains(
    responses: ComplexArray, slopes: ComplexArray, measurement: Measurement
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Eliminate the best gains from a model's responses (f, s, n) and their slopes (f, s, n, q).

    Gains with a stated deviation are drawn toward magnitude 1.

    Returns gains (f, n), their slopes (f, n, q), and for the m values the residuals in standard
    deviations (m,) with their slopes (m, q).
    """
    known, w, d = measurement.known, measurement.weight, measurement.filled
    gains = np.ones((len(responses), responses.shape[2]), dtype=complex)
    by_gain = np.zeros((*gains.shape, slopes.shape[-1]), dtype=complex)
    if measurement.gain_std:
        heard = known.any(axis=1)
        power = ((w * np.abs(responses)) ** 2).sum(axis=1) + measurement.gain_std**-2
        power = np.where(power > 0, power, 1.0)
        inner = (w**2 * responses.conj() * d).sum(axis=1)
        length = np.where(inner == 0, 1.0, np.abs(inner))
        turned = np.where(inner == 0, 1.0, inner / length)
        size = (np.abs(inner) + measurement.gain_std**-2) / power
        gains = size * turned
        of_inner = np.einsum("fsnq,fsn->fnq", slopes.conj(), w**2 * d) * turned.conj()[..., None]
        of_power = 2 * np.einsum("fsnq,fsn->fnq", slopes, w**2 * responses.conj()).real
        by_size = (of_inner.real - size[..., None] * of_power) / power[..., None]
        by_gain = turned[..., None] * (by_size + 1j * (size / length)[..., None] * of_inner.imag)
        slopes = by_gain[:, None] * responses[..., None] + gains[:, None, :, None] * slopes
        responses = gains[:, None] * responses
        gains = np.where(heard, gains, np.nan)
    weight = w[known]
    return gains, by_gain, weight * (responses - d)[known], weight[:, None] * slopes[known]


def _gain_residuals(
    gains: ComplexArray, by_gain: ComplexArray, std: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return residuals (k,) of gains (f, n) from magnitude 1, and their derivatives (k, q)."""
    kept = np.isfinite(gains) & np.isfinite(std) & np.bool_(std > 0)
    size = np.abs(gains[kept])
    by_size = (gains[kept].conj()[:, None] * by_gain[kept]).real / size[:, None]
    return (size - 1) / std + 0j, by_size / std + 0j


def _softened(
    r: ComplexArray, slopes: ComplexArray, scale: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return residuals (m,) whose squares are a soft L1 loss, and their derivatives (m, q)."""
    root = np.sqrt(1 + (np.abs(r) / scale) ** 2)
    weight = np.sqrt(2 / (1 + root))
    grown = (r.conj()[:, None] * slopes).real / (2 * scale**2 * root * (1 + root))[:, None]
    return weight * r, weight[:, None] * (slopes - r[:, None] * grown)


def fit_to_noise(
    model: ForwardModel,
    measurement: Measurement,
    *,
    searched: NDArray[np.bool_] | None = None,
    start: FloatArray | None = None,
    prior: tuple[FloatArray, FloatArray] | None = None,
) -> Fit:
    """Fit with errors estimated from the residuals, and without outliers.

    The measurement in the result has these errors, infinite for outliers.
    """
    found = fit(model, measurement, searched=searched, start=start, prior=prior)
    for _ in range(_ROUNDS):
        before = found.measurement
        raw = np.abs(measurement.values - found.predicted)
        of_gain = np.abs(before.weight * found.predicted) ** 2 * bool(before.gain_std)
        total = of_gain.sum(axis=1, keepdims=True)
        left = 1 - of_gain / np.where(total > 0, total, 1)
        left[before.known] -= found.leverage
        std = noise_of(before.part(before.known).values, raw, left)
        kept = raw < _MAX_DEVIATION * np.sqrt(2) * std
        now = replace(measurement, errors=np.where(kept, std, np.inf))
        found = fit(model, now, searched=searched, start=found.x, prior=prior)
        if (before.known == now.known).all() and np.allclose(
            before.std[now.known], now.std[now.known], rtol=_SETTLED
        ):
            break
    return found


def without_outliers(values: ComplexArray, model: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Find the outliers of values (f, s, n) relative to a plate's responses, up to a gain per row.

    Removes the worst value of a row first, since each biases the row's gain. Returns the errors of
    each part as estimated from the remaining values, infinite for outliers (f, s, n), and the
    scales of the sensors (s,).
    """
    used, scales = np.isfinite(values), np.ones(values.shape[1])
    for _ in range(_ROUNDS):
        part, heard = np.where(used, values, np.nan), used.any(axis=(0, 2))
        predicted = np.nan_to_num(gains_of(scales[:, None] * model, part))[:, None] * model
        share = np.divide(part, predicted, out=np.full_like(part, np.nan), where=used)
        scales[heard] = np.nanmedian(share.real[:, heard], axis=(0, 2))
        scales = scales / np.median(scales)
        raw = np.abs(values - scales[:, None] * predicted)
        count = used.sum(axis=1, keepdims=True)
        # The gain uses up one of the row's values.
        left = np.broadcast_to(1 - 1 / np.maximum(count, 2), values.shape)
        std = np.where(used, noise_of(part, raw, left), np.inf)
        deviation = np.where(used, raw / std / np.sqrt(2), 0.0)
        worst = deviation.max(axis=1, keepdims=True)
        kept = used & ~((deviation == worst) & (worst > _MAX_DEVIATION) & (count > 2))
        if (kept == used).all():
            break
        used = kept
    return np.where(used, std, np.inf), scales


def gains_of(
    model: ComplexArray, values: ComplexArray, weight: FloatArray | float = 1.0
) -> ComplexArray:
    """Return the gains (f, n) of a model (f, s, n) that fit values best, NaN if undetermined."""
    squares = np.where(np.isfinite(values), weight, 0.0) ** 2
    inner = (squares * model.conj() * np.where(squares > 0, values, 0)).sum(axis=1)
    power = (squares * np.abs(model) ** 2).sum(axis=1)
    return np.asarray(np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan))


def row_rms(values: ComplexArray) -> FloatArray:
    """Return the RMS of values (f, s, n) over the sensors (f, 1, n), 1 without any."""
    known = np.isfinite(values)
    power = np.where(known, np.abs(values) ** 2, 0).sum(axis=1, keepdims=True)
    rms = np.sqrt(power / np.maximum(known.sum(axis=1, keepdims=True), 1))
    return np.where(rms > 0, rms, 1.0)


def noise_of(values: ComplexArray, residuals: FloatArray, left: FloatArray) -> FloatArray:
    """Return the error of each part of values (f, s, n): sqrt(a² + b² size²) with the size of its
    row.

    Estimated from medians of residuals (f, s, n), over rows from weak to strong. left (f, s, n):
    fraction of noise power that a fit leaves in each. Returns (f, 1, n).
    """
    from scipy.optimize import nnls

    known, size = np.isfinite(values), row_rms(values)
    rows = np.flatnonzero((known.sum(axis=1) >= 2).ravel())
    floor = _SMALLEST_NOISE * size
    if len(rows) < 4:
        return floor
    telling = known & (left > _MIN_NOISE_LEFT)
    power = np.where(telling, residuals**2 / np.where(telling, left, 1) / 2, np.nan)
    power = power.swapaxes(1, 2).reshape(-1, values.shape[1])[rows]
    sizes = size.ravel()[rows]
    found, at = [], []
    for group in np.array_split(np.argsort(sizes, kind="stable"), min(_MAX_GROUPS, len(rows) // 2)):
        # The median of |z|² of complex noise with variance 2 is 2 log 2.
        found.append(np.nanmedian(power[group]) / np.log(2))
        at.append(np.median(sizes[group] ** 2))
    scale = np.maximum(found, 1e-12 * np.array(at))
    matrix = np.column_stack([1 / scale, np.array(at) / scale])
    weight = np.linalg.norm(matrix, axis=0)
    a2, b2 = nnls(matrix / weight, np.ones(len(scale)))[0] / weight
    return np.asarray(np.sqrt(a2 + b2 * size**2 + floor**2))


def likeliest_fit(found: Sequence[Fit]) -> Fit:
    """Return the fit with the lowest cost; if several are nearly equal, the first."""
    return best_by(found, lambda each: -each.cost)


_LOWEST, _HIGHEST = (
    0.1,
    1.2,
)  # limits for shifting modes: of the lowest frequency, of the highest tone

_ADDED_KINDS = {"loss_factor": "loss_added", "damping": "damping_added"}


@dataclass(frozen=True)
class Parameter:
    """A fitted rig value with its uncertainty."""

    kind: str
    """Kind of value: a key of `VALUE_UNITS`, or of `KINDS` if differences are reported."""
    name: str
    """Name in reports."""
    unit: str
    """Unit of its values in printed reports."""
    era: str = ""
    """Name of its ERA, "" if it belongs to none."""
    foot: str = ""
    """Name of its foot, "" if it belongs to none."""
    before: float = 0.0
    """Value in the original rig, 0 if the difference from it is reported."""
    value: float = math.nan
    """Fitted value, NaN before a fit."""
    standard_error: float | None = None
    """Standard error of the value, None if it is not identified and keeps the rig's value."""
    prior: float = math.inf
    """Standard deviation before the measurement, infinite without a prior."""
    at_bound: bool = False
    """Whether it is at a bound of the search."""

    @property
    def is_identified(self) -> bool:
        """Whether the data determine the value."""
        return self.standard_error is not None

    @property
    def is_factor(self) -> bool:
        """Whether x is the logarithm of a factor on the rig's value, not an addition to it."""
        return self.kind in ("modulus", "stiffness", "magnet_mass", "supports")

    def path(self, rig: Rig) -> KeyPath | None:
        """Return the path of its key in a rig file, None for a value that several layers share."""
        if self.foot:
            return "supports", self.foot, "stiffness"
        if self.era:
            era = rig.era(self.era)
            return "eras", self.era, ACTUATOR_KEYS[type(era)].keys[era.fields[self.kind]]
        if rig.laminate is not None and self.kind != "loss_factor":
            return None
        if self.kind == "modulus":
            return "plate", "material", next(iter(rig.plate.material.moduli))
        return "plate", self.kind

    def of(self, rig: Rig) -> float:
        """Return the value in a rig."""
        if self.era:
            era = rig.era(self.era)
            return float(getattr(era, era.fields[self.kind]))
        if self.foot:
            return rig.masses[rig.feet[rig.foot_names.index(self.foot)]].stiffness
        return (
            rig.plate.material.E if self.kind == "modulus" else float(getattr(rig.plate, self.kind))
        )


def parameters_of(
    rig: Rig, of_plate: Sequence[str], of_eras: Sequence[str], feet: Sequence[str]
) -> tuple[Parameter, ...]:
    """Return a rig's values before a fit: the given kinds for its plate and every ERA, and feet."""
    plate = [(kind, f"plate {kind}", "", "") for kind in of_plate]
    eras = [
        (kind, f"{era.name} {era.fields[kind]}", era.name, "")
        for era in rig.eras
        for kind in of_eras
        if kind in era.fields
    ]
    supports = [("supports", f"foot {name} stiffness", "", name) for name in feet]
    rows = [
        Parameter(kind, name, VALUE_UNITS[kind], era, foot)
        for kind, name, era, foot in (*plate, *eras, *supports)
    ]
    return tuple(replace(row, before=row.of(rig)) for row in rows)


def errors_by_key(
    rig: Rig, found: Iterable[tuple[Parameter, float | None]]
) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    by_path = ((parameter.path(rig), error) for parameter, error in found)
    return {path: float(error) for path, error in by_path if path and error}


def are_impossible(
    gains: ComplexArray, size: FloatArray | float, phase: float = math.inf
) -> NDArray[np.bool_]:
    """Return a mask of gains that no drive and no sensor can have, relative to their nominal
    values.

    size: largest logarithm of the magnitude, up or down; phase: largest phase [rad].
    """
    return np.asarray((np.abs(np.log(np.abs(gains))) > size) | (np.abs(np.angle(gains)) > phase))


@dataclass(frozen=True, eq=False)
class SensedPlate:
    """A rig's plate with sensors at points, without the rig's gains, and its fitted values.

    Parameters z (p,) belong to the model's space, in standard deviations from the rig's values.
    """

    rig: Rig
    model: ForwardModel
    """Its space has the n fitted values and, if enabled, form errors; all else is fixed."""

    @cached_property
    def rows(self) -> tuple[Parameter, ...]:
        """Fitted values (n,): modulus and loss factor, then the values of every ERA and every
        foot."""
        of_eras = ("stiffness", "damping", "bolt_mass", "magnet_mass")
        feet = self.rig.foot_names if self.rig.uncertainty.supports else ()
        return parameters_of(self.rig, ("modulus", "loss_factor"), of_eras, feet)

    @cached_property
    def largest_errors(self) -> FloatArray:
        """Standard errors (n,), in deviations, beyond which a fitted value is not identified.

        Infinite for an exciter's coil and magnet, given by its data sheet; a prior constrains feet,
        too.
        """
        by_sheet = [each for each in self.of_exciters if each.kind in ("bolt_mass", "magnet_mass")]
        rows = self.rows
        return np.array(
            [math.inf if row in by_sheet else MAX_GUESSED if row.foot else 1.0 for row in rows]
        )

    @cached_property
    def of_exciters(self) -> tuple[Parameter, ...]:
        """The fitted values of exciters."""
        exciters = {era.name for era in self.rig.eras if "force_factor" in era.fields}
        return tuple(row for row in self.rows if row.era in exciters)

    @cached_property
    def numbers(self) -> IntArray:
        """Number of each fitted value in the space (n,)."""
        names, groups = ["", *(era.name for era in self.rig.eras)], self.model.space.groups
        feet = ["", *self.rig.foot_names]
        return np.array(
            [
                groups[_ADDED_KINDS.get(row.kind, row.kind)].start
                + max(names.index(row.era) + feet.index(row.foot) - 1, 0)
                for row in self.rows
            ]
        )

    def of(self, rig: Rig) -> "SensedPlate":
        """Return the plate of a rig with another modulus, thickness, loss factor, ERAs and masses.

        Reuses the solution of the free plate.
        """
        shifting = None
        if self.model.form is not None:
            natural = np.sqrt(np.maximum(self.model.modes.eigenvalues, 0)) / (2 * np.pi)
            highest = _HIGHEST * self.model.frequencies.max()
            lowest = _LOWEST * rig.plate.lowest_bending_frequency
            shifting = int(((natural > lowest) & (natural < highest)).sum())
        names = [sensor.name for sensor in self.model.sensors]
        space = space_from_datasheets(rig, names, shifting)
        eras = tuple(replace(era, gains=()) for era in rig.eras)
        return SensedPlate(rig, replace(self.model, rig=replace(rig, eras=eras), space=space))

    def responses(self, z: FloatArray | None = None) -> ComplexArray:
        """Acceleration per base displacement of each ERA at z (p,), default the rig's values.

        Shape (f, s, eras) [1/s²].
        """
        return self.model.at(np.zeros(self.model.space.size) if z is None else z).responses

    def rig_at(self, z: FloatArray, *beside: str) -> Rig:
        """Return the rig with the fitted values of z, and with the values of the given other
        kinds."""
        # A force factor is fitted together with the damping.
        own = self.model.space.of("force_factor", *beside)
        own[self.numbers] = True
        values = PlateValues(self.rig, self.model.space, np.where(own, z, 0.0))
        return rig_with(self.rig, values, self.rig.uncertainty)

    def values(self, z: FloatArray) -> FloatArray:
        """The fitted values at z in their units (n,)."""
        rig = self.rig_at(z)
        return np.array([row.of(rig) for row in self.rows])

    def deviations(self, z: FloatArray) -> FloatArray:
        """Deviations of the fitted values at z (n,), in standard deviations of the original rig.

        The standard deviation is the larger of the data sheets' and the rig's. Losses vary by
        factors: above the rig's loss, the logarithm counts.
        """
        stated, std = self.rig.uncertainty, self.model.space.std[self.numbers]
        factor = math.log(stated.damping)
        of_kind = {
            "modulus": math.hypot(2 * stated.thickness, stated.modulus),
            "loss_factor": factor,
            "stiffness": math.hypot(stated.stiffness, stated.thickness),
            "magnet_mass": math.hypot(stated.stiffness, stated.thickness),
            "damping": math.hypot(factor, PARAMETER_KINDS["damping_each"].std),
            "supports": stated.supports,
        }
        own = np.array([row.before for row in self.rows])
        of_rig = (own > 0) * [of_kind.get(row.kind, 0.0) for row in self.rows]
        is_lossy = (own > 0) & [row.kind in _ADDED_KINDS for row in self.rows]
        unit = std / np.where(is_lossy, own, 1.0)
        size = unit * z[self.numbers]
        is_more = is_lossy & (size > 0)
        size, unit = (np.where(is_more, np.log1p(np.abs(each)), each) for each in (size, unit))
        return np.asarray(size / np.maximum(unit, of_rig))

    def errors(self, z: FloatArray, error: FloatArray) -> FloatArray:
        """Convert standard errors of z (p,) to standard errors of the fitted values at z in their
        units (n,)."""
        is_factor = np.array([row.is_factor for row in self.rows])
        slopes = self.model.space.std[self.numbers] * np.where(is_factor, self.values(z), 1.0)
        return np.asarray(slopes * error[self.numbers])

    def moved(self, modulus: float, stiffness: float) -> FloatArray:
        """Return parameters z (p,) for logarithms of factors on the rig's modulus and
        stiffnesses."""
        space = self.model.space
        found = np.zeros(space.size)
        for kind, logarithm in (("modulus", modulus), ("stiffness", stiffness)):
            found[space.groups[kind]] = logarithm / space.std[space.groups[kind]]
        return found


def sensed_plate(
    rig: Rig, sensors: Sequence[Sensor], frequencies: FloatArray, *, has_form: bool = False
) -> SensedPlate:
    """Solve a rig's free plate once, for sensors at points on it and frequencies (f,) [Hz].

    has_form: whether to include form errors. Raises InputError for frequencies too high for its
    mesh.
    """
    check_is_plate(rig.plate, "a fit or check with measurements")
    rig.mesh.check_frequencies(rig.plate, frequencies)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(max(frequencies.max(), 200.0)))
    form = None
    if has_form:
        supports = footprints_of(rig.eras, rig.masses)
        form = reduced_modes(free, supports, MASS_CELLS.centres(rig.plate))
    space = space_from_datasheets(rig, (), None)
    return SensedPlate(rig, ForwardModel(rig, sensors, frequencies, space, free, form=form)).of(rig)


def plate_of(rig: Rig, observation: Measurement, *, has_form: bool = False) -> SensedPlate:
    """Return the plate of a rig at the sensors and frequencies of a measurement; see
    `sensed_plate`."""
    return sensed_plate(rig, observation.sensors, observation.frequencies, has_form=has_form)
