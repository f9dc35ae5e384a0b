"""What changes in a plate's responses where its losses are viscous, not hysteretic.

A loss factor that is the same at every frequency, (1 + i eta) K, is not causal. The other extreme
loses in each mode j of the plate on its supports as the loss factor does at its own resonance, but
in proportion to frequency, eta omega / omega_j. Both agree at the resonances alone, and most tones
are beside them: a fit of the wrong law finds a loss factor that is off by more than noise and form
errors make it. What lies between them is a form error of its own, of which a fit finds the share.
"""

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.identification.forward import ForwardModel, PlateAt

_LEAST = 2 * np.pi  # rad/s; slower modes have no losses of the plate


def viscous_difference(model: ForwardModel, x: FloatArray) -> ComplexArray:
    """Change of the receptance (f, s, n) [m/N] between sensors and ERAs where losses are viscous.

    Of a plate with form errors, at x (p,).
    """
    plate = model.at(x)
    own, viscous = _lossy(plate), _viscous(plate)
    change = 1j * plate.eta[:, None, None] * (model.omega[:, None, None] * viscous - own)
    columns = plate.force.shape[1]
    other = PlateAt(model, x, np.asarray(change))
    return np.asarray((other.receptance - plate.receptance)[:, model.observed, :columns])


def _lossy(plate: PlateAt) -> FloatArray:
    """Stiffness between coordinates that loses by the plate's loss factor (r, r) [rad²/s²]."""
    theory, rigidity = plate.model.elasticity, plate.modulus * plate.functions.thickness**2
    return np.diag(rigidity * theory.relative_loss * theory.eigenvalues)


def _viscous(plate: PlateAt) -> FloatArray:
    """Damping (r, r) [rad/s] by a loss factor of 1 of each supported mode at its resonance."""
    values, model, shapes = plate.values, plate.model, plate.located.shapes
    rig, h = model.rig, plate.functions.thickness
    springs = [each.in_time.stiffness for each in plate.sources]
    masses = [each.in_time.mass for each in plate.sources]
    factors = np.ones(len(rig.masses))
    factors[list(rig.feet)] = values.supports
    springs += [*factors * [load.stiffness for load in rig.masses]] + [0.0] * len(values.masses)
    masses += [load.mass for load in rig.masses] + [*values.masses[:, 0]]
    on_plate = shapes[: len(springs)]
    lossy = _lossy(plate)
    stiffness = lossy + (on_plate.T * springs) @ on_plate / h
    mass = np.eye(len(lossy)) + (on_plate.T * masses) @ on_plate / h
    eigenvalues, modes = linalg.eigh(stiffness, mass)
    roots = np.maximum(eigenvalues, _LEAST**2) ** 0.25
    weighted = mass @ modes / roots
    return np.asarray(weighted @ (modes.T @ lossy @ modes) @ weighted.T)
