"""What a measurement tells of a board's grain: its modulus across, and that of shear.

A board of a kind has moduli that differ by 10 % and more from another, each by itself, and its
lowest modes shift accordingly. Shifts m (k,) that a fit finds, in standard deviations s of what
modes may shift beside, with their covariance C, are explained by logarithms d of the factors on
moduli, of a prior variance D: to first order

    d = (J^T (1 - C) J + D^-1)^-1 J^T m,   J = (v^T dK v / lambda) / s,

where the first column, all ones, stands for a modulus that is fitted anew.
"""

from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.identification.parameters import KINDS
from model.identification.posterior import Posterior
from model.identification.stages import FittedModel, Setting
from model.reduction.free_plate import FreePlate
from model.rig.rig import Rig
from model.spectral.shape_stiffness import grain_slopes
from model.structure.modal_elasticity import lowest_elastic

_PRIOR = 0.15  # of the logarithms: of a board by its kind
_LEAST = 3e-3  # of a change that is worth another fit

ROUNDS = 3
"""Fits of a board, each with the grain that the one before shows."""


def with_grain_of(setting: Setting, fitted: FittedModel) -> Rig | None:
    """The rig whose board has the grain that a fit shows; None where it has, or has none."""
    rig = setting.rig
    grain = rig.plate.material.orthotropy
    shifts = fitted.space.of("mode_shifts")
    if grain is None or not shifts.any():
        return None
    posterior = Posterior.of(fitted.space, fitted.best)
    told = np.eye(int(shifts.sum())) - posterior.covariance[np.ix_(shifts, shifts)]
    J = _slopes(setting.free, int(shifts.sum())) / KINDS["mode_shifts"].std
    information = J.T @ told @ J + np.eye(3) / _PRIOR**2
    _, across, shear = np.linalg.solve(information, J.T @ posterior.x[shifts]).tolist()
    if max(abs(across), abs(shear)) < _LEAST:
        return None
    other = replace(grain, e2=grain.e2 * np.exp(across), g12=grain.g12 * np.exp(shear))
    plate = replace(rig.plate, material=replace(rig.plate.material, orthotropy=other))
    return replace(rig, plate=plate)


def _slopes(free: FreePlate, count: int) -> FloatArray:
    """Derivatives of the logarithms of the lowest eigenvalues by those of three moduli (k, 3)."""
    modes, mesh = free.modes, free.mesh
    lowest = lowest_elastic(modes.eigenvalues, count)
    shapes = [each[:, lowest] for each in modes.unknowns(np.empty((0, 3)))]
    by_grain = grain_slopes(free.plate, (mesh.nx, mesh.ny), shapes)
    relative = by_grain / modes.eigenvalues[lowest]
    return np.column_stack([np.ones(len(lowest)), *relative])
