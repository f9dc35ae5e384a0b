"""Dynamic stiffness of what is attached to the plate at points: ERAs, fingertips and masses."""

from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.structure.actuator import Era
from model.structure.point_load import Load


def dynamic_stiffness(
    stiffness: FloatArray | float,
    damping: FloatArray | float,
    mass: FloatArray | float,
    omega: FloatArray | float,
) -> ComplexArray:
    """D = k + i omega c - omega² m [N/m]; the arguments broadcast against each other."""
    k, c, m, w = (np.asarray(value, dtype=float) for value in (stiffness, damping, mass, omega))
    return np.asarray(k + 1j * w * c - w**2 * m)


def attached_stiffness(
    eras: Sequence[Era], loads: Sequence[Load], omega: FloatArray
) -> ComplexArray:
    """Dynamic stiffness [N/m] of ERAs and loads at omega (f,) [rad/s], (f, eras + loads)."""
    parameters = [(era.stiffness, era.damping, era.bolt_mass) for era in eras]
    stiffness, damping, mass = np.array(parameters, dtype=float).reshape(-1, 3).T
    at_eras = dynamic_stiffness(stiffness, damping, mass, omega[:, None])
    return np.column_stack([at_eras, *(load.dynamic_stiffness(omega) for load in loads)])


def base_stiffness(eras: Sequence[Era], omega: FloatArray) -> ComplexArray:
    """Force on the plate per displacement of an ERA's base, k_b + i omega c [N/m], (f, eras)."""
    stiffness = np.array([era.stiffness for era in eras], dtype=float)
    damping = np.array([era.damping for era in eras], dtype=float)
    return dynamic_stiffness(stiffness, damping, 0.0, omega[:, None])


def drive_forces(eras: Sequence[Era], omega: FloatArray) -> ComplexArray:
    """Force of each ERA at full stroke, its own gain included [N], (f, eras) (paper Eq. 25)."""
    return np.asarray(base_stiffness(eras, omega) * full_strokes(eras, omega))


def full_strokes(eras: Sequence[Era], omega: FloatArray) -> ComplexArray:
    """Amplitude of each ERA's base at full stroke, its own gain included [m], (f, eras)."""
    strokes = np.array([era.stroke for era in eras])
    gains = np.array([era.gain(omega / (2 * np.pi)) for era in eras], dtype=complex)
    return np.asarray(strokes * gains.reshape(len(eras), len(omega)).T)
