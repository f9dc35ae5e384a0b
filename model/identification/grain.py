"""What a measurement tells of a board's grain: its modulus across, and that of shear.

A board of a kind has moduli that differ by 10 % and more from another, each by itself, and its
lowest modes shift accordingly. Shifts m (k,) that a fit finds, in standard deviations s of what
modes may shift beside, with their covariance C, are explained by logarithms d of the factors on
moduli, of a prior variance D: to first order

    d = (J^T (1 - C) J + D^-1)^-1 J^T m,   J = (v^T dK v / lambda) / s,

where the first column, all ones, stands for a modulus that is fitted anew.
"""

import math
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray, best_by
from model.identification.parameters import KINDS
from model.identification.posterior import Posterior
from model.identification.stages import FittedModel, Setting, chi2, fit_in_stages
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.spectral.shape_stiffness import grain_slopes
from model.structure.modal_elasticity import lowest_elastic

_PRIOR = 0.15  # of the logarithms: of a board by its kind
_LEAST = 3e-3  # of a change that is worth another fit
_STARTS = (1.0, 0.85, 1.18)  # factors on the modulus across, since fits end in wrong minima
_ROUNDS = 3  # fits from a start, each with the grain that the one before shows
_GOOD = 1.0  # chi², and mean square of the shifts of modes, that need no further start


def fit_board(setting: Setting) -> tuple[Setting, FittedModel]:
    """The most likely parameters of a measurement, and the board in whose grain they are.

    Of a plate without a grain those of `fit_in_stages`.
    """
    if setting.rig.plate.material.orthotropy is None:
        return setting, fit_in_stages(setting)
    found = []
    for start in _STARTS:
        found += _fits_from(_with_grain(setting, start, 1.0))
        if any(_is_good(fitted) for _, fitted in found):
            break
    return best_by(found, lambda each: -each[1].best.cost)


def _fits_from(setting: Setting) -> list[tuple[Setting, FittedModel]]:
    """Fits one after the other, each in the grain that the one before shows."""
    found = [(setting, fit_in_stages(setting))]
    for _ in range(_ROUNDS):
        setting, fitted = found[-1]
        across, shear = _grain_shown(setting, fitted)
        if max(abs(across), abs(shear)) < _LEAST:
            break
        other = _with_grain(setting, math.exp(across), math.exp(shear))
        found.append((other, fit_in_stages(other)))
    return found


def _is_good(fitted: FittedModel) -> bool:
    """Whether a fit explains a measurement by a board whose modes need not shift beyond theirs."""
    shifts = fitted.best.x[fitted.space.of("mode_shifts")]
    return chi2(fitted) <= _GOOD and float((shifts**2).mean()) <= _GOOD


def _grain_shown(setting: Setting, fitted: FittedModel) -> tuple[float, float]:
    """Logarithms of the factors on the moduli across and of shear that the shifts of modes show."""
    shifts = fitted.space.of("mode_shifts")
    count = int(shifts.sum())
    posterior = Posterior.of(fitted.space, fitted.best)
    shown = np.eye(count) - posterior.covariance[np.ix_(shifts, shifts)]
    J = _slopes(setting.free, count) / KINDS["mode_shifts"].std
    information = J.T @ shown @ J + np.eye(3) / _PRIOR**2
    _, across, shear = np.linalg.solve(information, J.T @ posterior.x[shifts]).tolist()
    return across, shear


def _with_grain(setting: Setting, across: float, shear: float) -> Setting:
    """The setting of a board with other moduli across and of shear, by factors."""
    rig, of = setting.rig, setting.rig.plate.material.shares
    shares = replace(of, e2=of.e2 * across, g12=of.g12 * shear)
    plate = replace(rig.plate, material=replace(rig.plate.material, orthotropy=shares))
    free = solve_free_plate(plate, setting.free.mesh, frequency_max=setting.free.frequency_max)
    return replace(setting, rig=replace(rig, plate=plate), free=free)


def _slopes(free: FreePlate, count: int) -> FloatArray:
    """Derivatives of the logarithms of the lowest eigenvalues by those of three moduli (k, 3)."""
    modes, mesh = free.modes, free.mesh
    lowest = lowest_elastic(modes.eigenvalues, count)
    shapes = [each[:, lowest] for each in modes.unknowns(np.empty((0, 3)))]
    by_grain = grain_slopes(free.plate, (mesh.nx, mesh.ny), shapes)
    relative = by_grain / modes.eigenvalues[lowest]
    return np.column_stack([np.ones(len(lowest)), *relative])
