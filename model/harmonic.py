"""Complex steady-state response of the plate to its ERAs, one frequency at a time.

An ERA is a spring k_b and a damper c between the plate and a base that moves y exp(i omega t), with
a bolt of mass m_b on the plate. It drives the plate with (k_b + i omega c) y and, driven or not,
holds it with k_b + i omega c - omega² m_b (paper Eq. 21 and 25). The plate's own damping is
hysteretic: (1 + i eta) K.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy import sparse

from model.actuator import Era
from model.arrays import ComplexArray, FloatArray
from model.assembly import PlateMatrices, era_positions
from model.errors import InputError
from model.factorisation import factorise
from model.mesh import LEAST_NODES_PER_WAVELENGTH, Mesh
from model.plate import Plate
from model.reduction import ReducedPlate


def check_frequencies(plate: Plate, mesh: Mesh, frequencies: FloatArray) -> None:
    """Raise InputError for a frequency [Hz] that is none or that the mesh cannot carry."""
    for frequency in frequencies:
        if not (np.isfinite(frequency) and frequency > 0):
            raise InputError(f"frequency is {frequency} Hz, must be above zero")
        wavelength = plate.bending_wavelength(frequency)
        if wavelength < mesh.shortest_wavelength:
            need = 1.001 * mesh.shortest_wavelength / wavelength
            raise InputError(
                f"the {mesh} mesh has {wavelength / max(mesh.element_size):.1f} elements in a "
                f"bending wavelength at {frequency:g} Hz, too few to answer: "
                f"{LEAST_NODES_PER_WAVELENGTH / mesh.kind.order:g} of {mesh.element} are the "
                f"least; use {math.ceil(mesh.nx * need)}x{math.ceil(mesh.ny * need)} or finer"
            )


def _hold_and_drive(eras: Sequence[Era], omega: float) -> tuple[ComplexArray, ComplexArray]:
    """Per ERA: its dynamic stiffness [N/m], and the force on the plate at full stroke [N]."""
    spring: ComplexArray = np.array([era.stiffness + 1j * omega * era.damping for era in eras])
    bolt = np.array([era.bolt_mass for era in eras])
    stroke = np.array([era.stroke for era in eras])
    hold: ComplexArray = spring - (omega**2 * bolt).astype(complex)
    return hold, spring * stroke


def direct_acceleration(
    matrices: PlateMatrices, eras: Sequence[Era], frequencies: FloatArray, points: FloatArray
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    Each ERA alone at full stroke and phase zero, the others holding. One sparse factorisation per
    frequency: the reference that the reduced answer is compared with. Raises InputError for a
    frequency that is none or that the mesh cannot carry, and for points off the plate.
    """
    check_frequencies(matrices.plate, matrices.mesh, frequencies)
    touch = matrices.deflection_at(era_positions(eras))
    observe = matrices.deflection_at(points)
    result = np.empty((len(frequencies), len(eras), observe.shape[0]), dtype=complex)
    for row, frequency in enumerate(frequencies):
        omega = 2 * np.pi * frequency
        hold, drive = _hold_and_drive(eras, omega)
        dynamic = (
            (1 + 1j * matrices.plate.loss_factor) * matrices.stiffness
            - omega**2 * matrices.mass
            + touch.T @ sparse.diags_array(hold) @ touch
        )
        factor = factorise(dynamic)
        displacement = factor.solve((touch.T @ sparse.diags_array(drive)).toarray())
        result[row] = -(omega**2) * (observe @ displacement).T
    return result


def reduced_acceleration(
    reduced: ReducedPlate, eras: Sequence[Era], frequencies: FloatArray, points: FloatArray
) -> ComplexArray:
    """The same from the reduced plate: a solve as small as the number of ERAs per frequency.

    The free plate's receptance is diagonal in its modes; ERAs are a correction of low rank
    (Woodbury identity). Shapes and units as in `direct_acceleration`.
    """
    touch = reduced.at(era_positions(eras))
    observe = reduced.at(points)
    modal_stiffness = (1 + 1j * reduced.plate.loss_factor) * reduced.omega**2
    result = np.empty((len(frequencies), len(eras), len(observe)), dtype=complex)
    for row, frequency in enumerate(frequencies):
        omega = 2 * np.pi * frequency
        hold, drive = _hold_and_drive(eras, omega)
        receptance = touch / (modal_stiffness - omega**2)
        at_eras = receptance @ touch.T
        # Force on the plate per ERA driven: what its base pushes less what all ERAs hold back.
        force = np.linalg.solve(np.eye(len(eras)) + hold[:, None] * at_eras, np.diag(drive))
        result[row] = -(omega**2) * force.T @ (receptance @ observe.T)
    return result
