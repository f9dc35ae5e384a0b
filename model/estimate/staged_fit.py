"""Fit all parameters of an installed rig in stages, since a direct fit ends in wrong minima.

Springs, damping, thickness and gains are fitted first, from several thicknesses and with extra
noise that hides the other parameters. Next come one additional mass, starting at the position where
it would explain most, and then all parameters with the measured noise. A second mass is added only
if it explains part of the remaining error.

For a board with a grain, the fit is repeated with other transverse and shear moduli, which follow
from the shifts of its modes; boards of one kind differ by 10 % and more in each modulus. To first
order the shifts m (k,), relative to their prior s, with covariance C, follow from logarithms d of
factors on the moduli, with prior variance D:

    d = (J^T (1 - C) J + D^-1)^-1 J^T m,   J = (v^T dK v / lambda) / s,

where the first column of J, all ones, represents a modulus that is fitted again.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from model.arrays import FloatArray, ranked_by, rms
from model.estimate.fit import Fit, fit, likeliest_fit
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.measurement import Measurement
from model.estimate.parameter_space import MODE_SHIFTS
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.rig_parameters import inwards, plate_with, space_of
from model.finger import Grid
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_mesh import mesh_of
from model.spectral.direct_solution import grain_slopes
from model.spectral.plate_mesh import PlateMesh, SpectralMesh
from model.structure.modal_elasticity import check_is_plate, lowest_elastic
from model.structure.plate import Plate

_EXTRA_NOISE = 0.05  # of the RMS at each frequency, in the first stages
_THICKNESSES = (0.0, 1.5, -1.5)  # start values of x in the first stage
_MIN_FREQUENCY = 200.0  # Hz, up to which a free plate is solved
_FREQUENCY_MARGIN = 1.02  # because layers do not stiffen all modes equally
_GOOD = 0.5  # chi² with the extra noise; below it no further start is tried
_INWARDS = 0.6  # of the prior; positions on an edge start this far inside
_MASS_GRID = Grid(8, 6)  # start positions of an additional mass
_MASS_STARTS = 4
_FULL_STARTS = 2
_MAX_CHI2 = 1.5  # above it, a second mass is added
_MIN_COST_REDUCTION = 12.5  # by a second mass, five standard errors

_SIMPLE = [kind.name for kind in PARAMETER_KINDS.values() if kind.stage == 0]
_LOCATED = [kind.name for kind in PARAMETER_KINDS.values() if kind.stage <= 1]

_GRAIN_PRIOR = 0.15  # standard error of the logarithms of a board's moduli within its kind
_MIN_GRAIN_CHANGE = 3e-3  # of a logarithm; smaller changes do not justify another fit
# Factors on the transverse modulus, since fits can end in wrong minima.
_GRAIN_STARTS = (1.0, 0.85, 1.18)
_GRAIN_ROUNDS = 3  # fits per start, each with the grain found by the previous one
_GRAIN_GOOD = 1.0  # chi² and mean square mode shift below which no further start is tried

RigFit: TypeAlias = Fit[ForwardModel]


def solved_for(rig: Rig, frequency_max: float) -> FreePlate:
    """Return the free plate of a rig, solved for tones up to a frequency [Hz]."""
    check_is_plate(rig.plate, "a fit or check with measurements")
    mesh: PlateMesh = rig.mesh
    if not isinstance(mesh, SpectralMesh):
        # Positions move freely only on a plate with global basis functions.
        mesh = mesh_of("auto", rig.plate, frequency_max=rig.limits.frequency_max)
    return solve_free_plate(rig.plate, mesh, frequency_max=max(frequency_max, _MIN_FREQUENCY))


def model_of(
    rig: Rig,
    free: FreePlate,
    measurement: Measurement,
    *,
    masses: int,
    more: Sequence[Sensor] = (),
) -> ForwardModel:
    """Return the model of a rig with additional masses at the measured tones.

    free: solved free plate of the rig; masses: their number; more: additional sensors.
    """
    sensors = (*measurement.sensors, *more)
    space = space_of(
        rig,
        [sensor.name for sensor in sensors],
        rig.uncertainty,
        drives_lag=measurement.drives_lag,
        masses=masses,
        mode_count=len(lowest_elastic(free.modes.eigenvalues, MODE_SHIFTS)),
    )
    return ForwardModel(rig, sensors, measurement.frequencies, space, free)


def fit_board(rig: Rig, measurement: Measurement) -> RigFit:
    """Fit in stages; for a board with a grain, fit again with the grain found.

    The rig of the resulting model has this grain.
    """
    if rig.plate.material.orthotropy is None:
        return _fit_in_stages(rig, measurement)
    fits: list[RigFit] = []
    for start in _GRAIN_STARTS:
        fits += _fit_grain(_with_grain(rig, start, 1.0), measurement)
        if any(map(_is_good, fits)):
            break
    return likeliest_fit(fits)


def _fit_grain(rig: Rig, measurement: Measurement) -> list[RigFit]:
    """Fit again with the grain found, until it hardly changes; return all fits."""
    fits = [_fit_in_stages(rig, measurement)]
    for _ in range(_GRAIN_ROUNDS):
        across, shear = _grain_shown(fits[-1])
        if max(abs(across), abs(shear)) < _MIN_GRAIN_CHANGE:
            break
        changed = _with_grain(fits[-1].model.rig, math.exp(across), math.exp(shear))
        fits.append(_fit_in_stages(changed, measurement))
    return fits


def _is_good(result: RigFit) -> bool:
    return result.chi2 <= _GRAIN_GOOD and mode_shift(result) ** 2 <= _GRAIN_GOOD


def mode_shift(result: RigFit) -> float:
    """Return the RMS shift of the lowest modes, relative to their prior, 0 without any."""
    return rms(result.x[result.space.of("mode_shifts")])


def _grain_shown(result: RigFit) -> tuple[float, float]:
    """Return logarithms of factors on the transverse and shear moduli from the shifts of modes."""
    is_shift = result.space.of("mode_shifts")
    free = result.model.free
    lowest = lowest_elastic(free.modes.eigenvalues, int(is_shift.sum()))
    shapes = [unknowns[:, lowest] for unknowns in free.modes.unknowns(np.empty((0, 3)))]
    slopes = grain_slopes(free.plate, (free.mesh.nx, free.mesh.ny), shapes)
    relative = slopes / free.modes.eigenvalues[lowest]
    J = np.column_stack([np.ones(len(lowest)), *relative]) / PARAMETER_KINDS["mode_shifts"].std
    shown = np.eye(len(lowest)) - result.stated_covariance[np.ix_(is_shift, is_shift)]
    information = J.T @ shown @ J + np.eye(3) / _GRAIN_PRIOR**2
    _, across, shear = np.linalg.solve(information, J.T @ result.x[is_shift]).tolist()
    return across, shear


def _with_grain(rig: Rig, across: float, shear: float) -> Rig:
    """Return the rig of a board with transverse and shear moduli multiplied by factors."""
    shares = rig.plate.material.shares
    shares = replace(shares, e2=shares.e2 * across, g12=shares.g12 * shear)
    material = replace(rig.plate.material, orthotropy=shares)
    return replace(rig, plate=replace(rig.plate, material=material))


def _fit_in_stages(rig: Rig, measurement: Measurement) -> RigFit:
    """Find the most likely parameters of a measurement."""
    free = solved_for(rig, float(measurement.frequencies[-1]))
    std = np.hypot(measurement.std, _EXTRA_NOISE * measurement.tone_rms)
    rough = replace(measurement, errors=std)
    model = model_of(rig, free, measurement, masses=1)
    located = _fits_with_mass(model, rough, _simple_fit(model, rough).x, number=0)
    result = _full_fit(located, measurement)
    if result.chi2 > _MAX_CHI2:
        wider = model_of(rig, free, measurement, masses=2)
        x = np.insert(result.x, result.space.groups["masses"].stop, np.zeros(3))
        second = _full_fit(_fits_with_mass(wider, rough, x, number=1), measurement)
        if second.cost <= result.cost - _MIN_COST_REDUCTION:
            result = second
    # Solve the plate for its identified thickness and modulus, as for a table.
    identified = plate_with(rig.plate, result.fitted_plate.values)
    identified = replace(identified, mode_deviations=rig.plate.mode_deviations)
    solved = replace(result.model, free=_solved_again(free, identified))
    return fit(solved, measurement, start=result.x)


def _simple_fit(model: ForwardModel, rough: Measurement) -> RigFit:
    """Fit without form errors from several thicknesses."""
    fits = []
    for thickness in _THICKNESSES:
        start = np.zeros(model.space.size)
        start[model.space.groups["thickness"]] = thickness
        fits.append(fit(model, rough, searched=model.space.of(*_SIMPLE), start=start))
        r, _ = likeliest_fit(fits).of_values
        if r @ r < _GOOD * len(r):
            break
    return likeliest_fit(fits)


def _fits_with_mass(
    model: ForwardModel, rough: Measurement, x: FloatArray, *, number: int
) -> list[RigFit]:
    """Fit positions and an additional mass, from several positions and without it; best first.

    number: index of the mass. Positions are chosen where a mass would explain most.
    """
    space = model.space
    start = inwards(space, x, by=_INWARDS)
    searched = space.uncertain & ~space.of("masses", "mode_shifts", "mode_losses")
    linear = fit(model, rough, searched=searched, start=start, evaluations=1)
    points = _MASS_GRID.centers(model.rig.plate)
    first = space.groups["masses"].start + 3 * number
    part = slice(first, first + 3)
    starts = [start]
    for point, mass in linear.loads(points, std=space.std[first])[:_MASS_STARTS]:
        position = points[point] - model.sides / 2
        with_mass = start.copy()
        with_mass[part] = [mass, *position] / space.std[part]
        starts.append(with_mass)
    located = space.of(*_LOCATED)
    fits = [fit(model, rough, searched=located, start=start) for start in starts]
    return ranked_by(fits, lambda result: -result.cost)


def _full_fit(fits: list[RigFit], measurement: Measurement) -> RigFit:
    """Fit all parameters with the measured noise, from the two best fits."""
    best = fits[:_FULL_STARTS]
    return likeliest_fit([fit(rough.model, measurement, start=rough.x) for rough in best])


def _solved_again(free: FreePlate, plate: Plate) -> FreePlate:
    """Solve a plate on another one's mesh, with all of its modes even if it is stiffer."""
    stiffer = plate.lowest_bending_frequency / free.plate.lowest_bending_frequency
    frequency_max = free.frequency_max * max(stiffer * _FREQUENCY_MARGIN, 1.0)
    return solve_free_plate(plate, free.mesh, frequency_max=frequency_max)
