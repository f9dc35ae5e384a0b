"""Maximum a posteriori fit of a rig's parameters and of its plate's form errors to responses.

    d_fes = g_fe a_fes(z) + noise

d are measured values at frequency f, ERA e and sensor s, a those of the model as sensors of some
scales read them, g a complex gain of every frequency and ERA. Gains enter linearly: the best ones
follow from any model, so that only z is searched, with the derivatives of gains and residual by it
(variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973). z has the rig's values,
without a prior, and what tolerances hold: scales of sensors, form errors, and what data sheets know
better. The free plate is solved once (`model.estimate.forward`).

Noise has a constant part and a part in proportion to the response, both estimated from residuals.
Outliers are found at the plate of the preceding check, the worst of a row first, since each pulls
the gain of its row. Standard errors contain what tolerances leave undetermined: C = (J^T J)^-1 with
the tolerances as rows of J, times chi² per degree of freedom where that is above 1. With gains
projected out of J this is the Schur complement, so that of a gain

    var g_fe = sigma_fe² + (dg_fe/dz) C (dg_fe/dz)^T

with sigma of the noise, in which scales that all sensors have in common are included.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.forward import ForwardModel, Sensor, jacobian
from model.estimate.least_squares import Minimum, search
from model.estimate.measurement import Responses
from model.estimate.space import (
    KINDS,
    MAX_GUESSED,
    VALUE_UNITS,
    Values,
    reduced_modes,
    rig_with,
    space_by_sheets,
)
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig

_LOWEST, _HIGHEST = 0.1, 1.2  # of modes that shift: of the lowest frequency, of the highest tone
STARTS = [
    (modulus, stiffness)
    for modulus in np.log(np.linspace(0.6, 1.6, 11)).tolist()
    for stiffness in np.log([0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5]).tolist()
]
"""Logarithms of factors on modulus and stiffnesses from which to search."""

_ADDED_KINDS = {"loss_factor": "loss_added", "damping": "damping_added"}

_MAX_DEVIATION = 5.0  # standard deviations; of 10 000 good complex values 0.04 lie beyond
_ROUNDS = 8
_MIN_NOISE_LEFT = 0.1  # of a value's noise: residuals with less do not show it
_SMALLEST_NOISE = 1e-4  # of the response: what meshes and reduction are wrong by


@dataclass(frozen=True)
class Parameter:
    """A fitted value of a rig: of the plate, of an ERA or of a foot."""

    kind: str
    """Kind of value, as a key of `VALUE_UNITS`."""
    era: str
    """Name of the ERA, "" for the plate and for feet."""
    field: str = ""
    """Attribute of the ERA, which exciters name differently; by default the kind."""
    foot: str = ""
    """Name of the foot, "" for other values."""

    @property
    def name(self) -> str:
        """Name in reports."""
        if self.foot:
            return f"foot {self.foot} stiffness"
        return f"{self.era or 'plate'} {self.field or self.kind}"

    @property
    def unit(self) -> str:
        """Unit of its value."""
        return VALUE_UNITS[self.kind]

    @property
    def is_factor(self) -> bool:
        """Whether x is the logarithm of a factor on the rig's value, not what is added to it."""
        return self.kind in ("modulus", "stiffness", "magnet_mass", "supports")

    def of(self, rig: Rig) -> float:
        """The value in a rig."""
        if self.era:
            era = rig.era(self.era)
            return float(getattr(era, era.fields[self.kind]))
        if self.foot:
            return rig.masses[rig.feet[rig.foot_names.index(self.foot)]].stiffness
        return (
            rig.plate.material.E if self.kind == "modulus" else float(getattr(rig.plate, self.kind))
        )


@dataclass(frozen=True, eq=False)
class SensedPlate:
    """A rig's plate with sensors at points, without the rig's gains, and the values fitted of it.

    Parameters z (p,) are those of the model's space, in standard deviations from the rig's values.
    """

    rig: Rig
    model: ForwardModel
    """Its space has the n fitted values, and form errors if there are any; all else is known."""

    @cached_property
    def rows(self) -> tuple[Parameter, ...]:
        """The fitted values (n,): modulus and loss factor, those of every ERA and of every foot."""
        of_eras = (
            Parameter(kind, era.name, era.fields[kind])
            for era in self.rig.eras
            for kind in ("stiffness", "damping", "bolt_mass", "magnet_mass")
            if kind in era.fields
        )
        names = self.rig.foot_names if self.rig.uncertainty.supports else ()
        feet = (Parameter("supports", "", foot=name) for name in names)
        return (Parameter("modulus", ""), Parameter("loss_factor", ""), *of_eras, *feet)

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Mask of the fitted values that a prior holds (n,)."""
        return np.asarray(self.largest_errors != 1)

    @cached_property
    def largest_errors(self) -> FloatArray:
        """Standard errors (n,), in deviations, beyond which a fitted value is not identified.

        Infinite for an exciter's coil and magnet, which its sheet holds; a prior holds feet, too.
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

    @property
    def masses(self) -> FloatArray:
        """Mass of the sensor at each point while it measures there, (s,) [kg]."""
        return np.array([sensor.mass for sensor in self.model.sensors])

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
        """The plate of a rig with another modulus, thickness, loss factor, ERAs and masses.

        Its free plate is not solved again.
        """
        shifting = None
        if self.model.form is not None:
            natural = np.sqrt(np.maximum(self.model.modes.eigenvalues, 0)) / (2 * np.pi)
            highest = _HIGHEST * self.model.frequencies.max()
            lowest = _LOWEST * rig.plate.lowest_bending_frequency
            shifting = int(((natural > lowest) & (natural < highest)).sum())
        names = [sensor.name for sensor in self.model.sensors]
        space = space_by_sheets(rig, names, shifting)
        eras = tuple(replace(era, gains=()) for era in rig.eras)
        return SensedPlate(rig, replace(self.model, rig=replace(rig, eras=eras), space=space))

    def responses(self, z: FloatArray | None = None) -> ComplexArray:
        """Acceleration per base displacement of each ERA at z (p,), by default the rig's values.

        Shape (f, e, s) [1/s²].
        """
        z = np.zeros(self.model.space.size) if z is None else z
        return np.swapaxes(self.model.at(z).responses, 1, 2)

    def at_sensors(self, z: FloatArray | None = None) -> ComplexArray:
        """Responses to a drive without gain at z (p,), by default at the rig's values (f, s, n)."""
        return self.model.at(np.zeros(self.model.space.size) if z is None else z).responses

    def rig_at(self, z: FloatArray) -> Rig:
        """The rig with the fitted values of z."""
        own = np.zeros(len(z))
        own[self.numbers] = z[self.numbers]
        beside = self.model.space.groups["force_factor"]
        own[beside] = z[beside]  # with the damping that was found beside it
        values = Values.of(self.rig, self.model.space, own)
        return rig_with(self.rig, values, self.rig.uncertainty)

    def values(self, z: FloatArray) -> FloatArray:
        """The fitted values at z in their units (n,)."""
        rig = self.rig_at(z)
        return np.array([row.of(rig) for row in self.rows])

    def deviations(self, z: FloatArray) -> FloatArray:
        """Deviations of the fitted values at z (n,), in standard deviations of rigs as written.

        That is the larger of the uncertainty of data sheets and that of the rig. Losses vary by
        factors: where they exceed the rig's, their logarithm counts.
        """
        stated, std = self.rig.uncertainty, self.model.space.std[self.numbers]
        factor = math.log(stated.damping)
        of_kind = {
            "modulus": math.hypot(2 * stated.thickness, stated.modulus),
            "loss_factor": factor,
            "stiffness": math.hypot(stated.stiffness, stated.thickness),
            "magnet_mass": math.hypot(stated.stiffness, stated.thickness),
            "damping": math.hypot(factor, KINDS["damping_each"].std),
            "supports": stated.supports,
        }
        own = np.array([row.of(self.rig) for row in self.rows])
        of_rig = (own > 0) * [of_kind.get(row.kind, 0.0) for row in self.rows]
        is_lossy = (own > 0) & [row.kind in _ADDED_KINDS for row in self.rows]
        unit = std / np.where(is_lossy, own, 1.0)
        size = unit * z[self.numbers]
        is_more = is_lossy & (size > 0)
        size, unit = (np.where(is_more, np.log1p(np.abs(each)), each) for each in (size, unit))
        return np.asarray(size / np.maximum(unit, of_rig))

    def errors(self, z: FloatArray, error: FloatArray) -> FloatArray:
        """Standard errors of the fitted values at z in their units (n,), by those of z (p,)."""
        is_factor = np.array([row.is_factor for row in self.rows])
        slopes = self.model.space.std[self.numbers] * np.where(is_factor, self.values(z), 1.0)
        return np.asarray(slopes * error[self.numbers])

    def moved(self, modulus: float, stiffness: float) -> FloatArray:
        """Parameters z (p,) for logarithms of factors on the rig's modulus and stiffnesses."""
        space = self.model.space
        found = np.zeros(space.size)
        for kind, logarithm in (("modulus", modulus), ("stiffness", stiffness)):
            found[space.groups[kind]] = logarithm / space.std[space.groups[kind]]
        return found


def sensed_plate(
    rig: Rig,
    points: FloatArray,
    frequencies: FloatArray,
    *,
    masses: FloatArray | None = None,
    has_form: bool = False,
) -> SensedPlate:
    """Solve a rig's free plate once, for sensors at points (s, 2) [m] and frequencies (f,) [Hz].

    masses (s,) [kg]: of a sensor that is moved, as `Sensor.mass`, None for none; has_form: whether
    the plate may have form errors. Raises InputError for frequencies too high for its
    mesh.
    """
    rig.mesh.check_frequencies(rig.plate, frequencies)
    loads = np.zeros(len(points)) if masses is None else masses
    sensors = [
        Sensor(f"sensor {n}", x=x, y=y, mass=mass)
        for n, ((x, y), mass) in enumerate(zip(points.tolist(), loads.tolist(), strict=True))
    ]
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(max(frequencies.max(), 200.0)))
    form = reduced_modes(rig, free) if has_form else None
    space = space_by_sheets(rig, (), None)
    return SensedPlate(rig, ForwardModel(rig, sensors, frequencies, space, free, form=form)).of(rig)


def plate_of(rig: Rig, observation: Responses, *, has_form: bool = False) -> SensedPlate:
    """The plate of a rig at the sensors and frequencies of a measurement, as `sensed_plate`."""
    return sensed_plate(
        rig,
        observation.points,
        observation.frequencies,
        masses=observation.masses,
        has_form=has_form,
    )


def without_outliers(
    values: ComplexArray, model: ComplexArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Scales of sensors (s,), noise (f, e) and the mask (f, e, s) of values without outliers.

    values, model (f, e, s): measured, and by a plate, up to a gain of each frequency and ERA.
    """
    used, scales = np.isfinite(values), np.ones(values.shape[2])
    heard = used.any(axis=(0, 1))
    for _ in range(_ROUNDS):
        weight = used / row_rms(values, used)[:, :, None]
        gains, _ = project_gains(scales * model, values, weight)
        predicted = np.nan_to_num(gains)[:, :, None] * model
        share = np.divide(values, predicted, out=np.full_like(values, np.nan), where=used)
        scales[heard] = np.nanmedian(share.real[:, :, heard], axis=(0, 1))
        scales = scales / np.median(scales)
        raw = np.abs(values - scales * predicted)
        noise = _noise_of(values, raw, used)
        kept = _without_worst(raw / noise[:, :, None], used)
        if (kept == used).all():
            break
        used, heard = kept, kept.any(axis=(0, 1))
    return scales, noise, used


def _without_worst(deviation: FloatArray, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop the worst value of each row that has one beyond bounds and more than two values."""
    deviation = np.where(used, deviation / np.sqrt(2), 0)
    worst = deviation.argmax(axis=2)
    f, e = np.nonzero((deviation.max(axis=2) > _MAX_DEVIATION) & (used.sum(axis=2) > 2))
    kept = used.copy()
    kept[f, e, worst[f, e]] = False
    return kept


def _noise_of(
    values: ComplexArray,
    raw: FloatArray,
    used: NDArray[np.bool_],
    left: FloatArray | None = None,
) -> FloatArray:
    """Standard deviation (f, e) of a value's real or imaginary part: sqrt(a² + b² size²).

    From the medians of residuals raw (f, e, s), over rows from weak to strong. left (f, e, s):
    share of noise power that a fit leaves in them; by default all but what a gain takes of its row.
    """
    size = row_rms(values, used)
    sensors = used.sum(axis=2)
    rows = np.flatnonzero((sensors >= 2).ravel())
    floor = _SMALLEST_NOISE * size
    if len(rows) < 4:
        return floor
    if left is None:
        # A gain takes one of the row's values with it.
        left = np.broadcast_to((1 - 1 / np.maximum(sensors, 2))[:, :, None], raw.shape)
    telling = used & (left > _MIN_NOISE_LEFT)
    power = np.full(raw.shape, np.nan)
    power[telling] = raw[telling] ** 2 / left[telling] / 2
    power = power.reshape(-1, used.shape[2])[rows]
    order = np.argsort(size.ravel()[rows], kind="stable")
    found, at = [], []
    for group in np.array_split(order, min(12, len(rows) // 2)):
        # The median of |z|² of complex noise with variance 2 is 2 log 2.
        found.append(np.nanmedian(power[group]) / np.log(2))
        at.append(np.median(size.ravel()[rows][group] ** 2))
    scale = np.maximum(found, 1e-12 * np.array(at))
    matrix = np.column_stack([1 / scale, np.array(at) / scale])
    weight = np.linalg.norm(matrix, axis=0)
    a2, b2 = nnls(matrix / weight, np.ones(len(scale)))[0] / weight
    return np.asarray(np.sqrt(a2 + b2 * size**2 + floor**2))


def fit_with_gains(
    model: ForwardModel,
    values: ComplexArray,
    weight: FloatArray,
    start: FloatArray,
    searched: NDArray[np.bool_],
    *,
    prior: tuple[FloatArray, FloatArray] | None = None,
    robust: float | None = None,
    drives: Sequence[int] | None = None,
    tolerance: float | None = None,
) -> Minimum:
    """Fit some parameters (p,) of a model to values (f, e, s), every gain g beside them.

    weight (f, e, s): zero where nothing was measured; start (p,), of which searched are changed;
    prior, robust: see `search`; drives (e,): number of the ERA that each channel drives, its own by
    default; tolerance: relative standard deviation of |g| from 1, none by default.
    """
    inside = weight > 0
    rows, of_eras = inside.any(axis=2), slice(None) if drives is None else list(drives)

    def linearised(z: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        found, by_z = responses_of(model, z, searched)
        found, by_z = found[:, of_eras], by_z[:, :, of_eras]
        gains, left = project_gains(found, values, weight, tolerance=tolerance)
        by_gain, slopes = projection_slopes(found, by_z, values, weight, tolerance=tolerance)
        if tolerance is None:
            return left[inside], slopes[:, inside].T
        size = np.abs(gains)
        wander = ((size - 1) / tolerance)[rows]
        by_wander = ((gains.conj() * by_gain).real / size / tolerance)[:, rows]
        return (
            np.concatenate([left[inside], wander]),
            np.hstack([slopes[:, inside], by_wander]).T,
        )

    bounds = np.array([model.space.lower, model.space.upper])
    return search(linearised, start, bounds, searched, prior=prior, robust=robust)


def responses_of(
    model: ForwardModel, z: FloatArray, searched: NDArray[np.bool_]
) -> tuple[ComplexArray, ComplexArray]:
    """Responses (f, e, s) as sensors read them, and derivatives (n, f, e, s) by n searched."""
    plate = model.at(z)
    by_z = jacobian(plate, searched)[..., searched].transpose(3, 0, 2, 1)
    return np.swapaxes(plate.responses, 1, 2), by_z


def project_gains(
    model: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    tolerance: float | None = None,
) -> tuple[ComplexArray, ComplexArray]:
    """Return gains (f, e) that minimize sum |weight (values - gain model)|², and that residual.

    model, values, weight (f, e, s), weight zero where nothing was measured; the gain of a row
    without values is NaN. tolerance: relative standard deviation of |gain| from 1, which adds
    ((|gain| - 1) / tolerance)² to each row.
    """
    values = np.where(weight > 0, values, 0)
    inner, power = _inner_and_power(model, values, weight)
    if tolerance is None:
        gains = np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)
    else:
        size, precision = np.abs(inner), tolerance**-2
        magnitude = (size + precision) / (power + precision)
        gains = magnitude * np.where(size > 0, inner / np.where(size > 0, size, 1), 1)
    residual = weight * (values - np.nan_to_num(gains)[..., None] * model)
    return gains, residual


def projection_slopes(
    model: ComplexArray,
    slopes: ComplexArray,
    values: ComplexArray,
    weight: FloatArray,
    *,
    tolerance: float | None = None,
) -> tuple[ComplexArray, ComplexArray]:
    """Derivatives (n, f, e) of the gains of `project_gains`, and (n, f, e, s) of the residual.

    slopes (n, f, e, s): derivatives of the model.
    """
    values = np.where(weight > 0, values, 0)
    inner, power = _inner_and_power(model, values, weight)
    gains = np.nan_to_num(project_gains(model, values, weight, tolerance=tolerance)[0])
    by_inner = np.einsum("nfes,fes->nfe", slopes.conj(), weight**2 * values)
    by_power = 2 * np.einsum("nfes,fes->nfe", slopes, weight**2 * model.conj()).real
    if tolerance is None:
        by_gain = (by_inner - gains * by_power) / np.where(power > 0, power, 1)
    else:
        size = np.where(np.abs(inner) > 0, np.abs(inner), 1)
        phase_factor = np.where(np.abs(inner) > 0, inner / size, 1)
        turned = phase_factor.conj() * by_inner
        by_magnitude = (turned.real - np.abs(gains) * by_power) / (power + tolerance**-2)
        by_gain = phase_factor * (by_magnitude + 1j * np.abs(gains) / size * turned.imag)
    return by_gain, -weight * (by_gain[..., None] * model + gains[..., None] * slopes)


def _inner_and_power(
    model: ComplexArray, values: ComplexArray, weight: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Weighted inner products of model and values, and squares of the model, (f, e)."""
    squares = weight**2
    inner = np.einsum("fes,fes->fe", model.conj(), squares * values)
    power = np.einsum("fes,fes->fe", model.real**2 + model.imag**2, squares)
    return np.asarray(inner), np.asarray(power)


def row_rms(values: ComplexArray, used: NDArray[np.bool_] | None = None) -> FloatArray:
    """Root mean square of each row of values (f, e, s) over its sensors; 1 for an empty row."""
    used = np.isfinite(values) if used is None else used
    power = np.where(used, np.abs(np.where(used, values, 0)) ** 2, 0).sum(axis=2)
    rms = np.sqrt(power / np.maximum(used.sum(axis=2), 1))
    return np.where(rms > 0, rms, 1.0)


def modal_assurance(values: ComplexArray, model: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H d|² / (|a|² |d|²) of shapes (..., s); NaN of empty ones.

    1 for the same shape with any gain, about 1/s for noise. Values that are not finite are ignored.
    """
    measured = np.isfinite(values)
    values = np.where(measured, values, 0)
    model = np.where(measured, model, 0)
    inner = np.abs((model.conj() * values).sum(axis=-1)) ** 2
    power = (np.abs(values) ** 2).sum(axis=-1) * (np.abs(model) ** 2).sum(axis=-1)
    return np.where(power > 0, inner / np.where(power > 0, power, 1), np.nan)
