"""Law of losses of a plate: between hysteretic and viscous.

Hysteretic losses have a constant loss factor over frequency, (1 + i eta) K, which is not causal.
The other extreme is viscous: the loss of each mode j of the supported plate is proportional to
frequency, eta w / w_j. Both agree only at the resonances, while most tones are off resonance, so a
fit with the wrong law finds a loss factor with an error larger than noise and form errors explain.
A plate with form errors has a parameter between both laws, 0 to 1 (`LossLaw`).

With the stiffness K_l to which the loss factor applies, and modes psi_j of the plate on its
supports with natural frequencies w_j, viscous losses are

    i eta w C,    C = sum_jk M psi_j (psi_j^T K_l psi_k) psi_k^T M / sqrt(w_j w_k),

which equals i eta K_l for a single mode at its resonance (see `model.reduction.supported_plate`).
"""

from dataclasses import replace

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.forward import ForwardModel, PlateAt
from model.structure.attachments import InTime, PointLoad

_SLOWEST = 2 * np.pi  # rad/s; lower bound of a mode's frequency in its losses


def viscous_difference(model: ForwardModel, x: FloatArray) -> ComplexArray:
    """Change of the receptance (f, s, n) [m/N] between sensors and ERAs if losses are viscous.

    At parameters x (p,). Raises InputError for a plate without form errors: its supported modes
    need the residual vectors of its attachments.
    """
    plate = model.at(x)
    form = plate.free.form
    if form is None:
        raise InputError("form must be ReducedModes for viscous losses, got None")
    omega = model.omega[:, None, None]
    loss_factor = plate.free.loss_factor[:, None, None]
    viscous = omega * _viscous_damping(plate)
    change = np.asarray(1j * loss_factor * (viscous - _lossy_stiffness(plate)))
    viscous_form = form._replace(loss_change=change)
    viscous_plate = replace(plate, free=replace(plate.free, form=viscous_form))
    difference = viscous_plate.receptance - plate.receptance
    return np.asarray(difference[:, model.observed, : len(plate.sources)])


def _lossy_stiffness(plate: PlateAt) -> FloatArray:
    """K_l, stiffness between coordinates to which the loss factor applies (r, r) [rad²/s²]."""
    theory = plate.model.elasticity
    rigidity = plate.free.modulus * plate.free.receptance.thickness**2
    return np.diag(rigidity * theory.relative_loss * theory.eigenvalues)


def _viscous_damping(plate: PlateAt) -> FloatArray:
    """C, damping between coordinates for a loss factor of 1 (r, r) [rad/s]."""
    rig = plate.model.rig
    h = plate.free.receptance.thickness
    added_masses = plate.values["masses"][:, 0].tolist()
    supports: list[InTime | PointLoad] = [source.in_time for source in plate.sources]
    supports += rig.masses
    masses = [support.mass for support in supports] + added_masses
    springs = [support.stiffness for support in supports] + [0.0] * len(added_masses)
    for foot, factor in zip(rig.feet, plate.values["supports"], strict=True):
        springs[len(plate.sources) + foot] *= factor
    shapes = plate.attachments.shapes[: len(springs)]
    lossy = _lossy_stiffness(plate)
    stiffness = lossy + (shapes.T * springs) @ shapes / h
    mass = np.eye(len(lossy)) + (shapes.T * masses) @ shapes / h
    eigenvalues, modes = linalg.eigh(stiffness, mass)
    roots = np.maximum(eigenvalues, _SLOWEST**2) ** 0.25
    weighted = mass @ modes / roots
    return np.asarray(weighted @ (modes.T @ lossy @ modes) @ weighted.T)
