"""Complex steady-state response of the plate to its ERAs, one frequency at a time.

An ERA is a spring k_b and a damper c between the plate and a base that moves y exp(i omega t), with
a bolt of mass m_b on the plate. It drives the plate with (k_b + i omega c) y and, driven or not,
holds it with k_b + i omega c - omega² m_b (paper Eq. 21 and 25). The plate's own damping is
hysteretic: (1 + i eta) K.
"""

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.assembly import PlateMatrices, era_positions
from model.fem.factorisation import factorise
from model.fem.mesh import LEAST_NODES_PER_WAVELENGTH, Mesh
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import PointLoad, load_positions


def check_frequencies(plate: Plate, mesh: Mesh, frequencies: FloatArray) -> None:
    """Raise InputError if one of frequencies (f,) [Hz] is none or the mesh cannot carry it."""
    for frequency in frequencies:
        if not (np.isfinite(frequency) and frequency > 0):
            raise InputError(f"frequency is {frequency} Hz, must be above zero")
    highest = max(frequencies, default=0.0)
    if highest > mesh.highest_frequency(plate):
        wavelength = plate.bending_wavelength(highest)
        raise InputError(
            f"the mesh {mesh} has {wavelength / max(mesh.element_size):.1f} elements in a bending "
            f"wavelength at {highest:g} Hz, too few to answer: "
            f"{LEAST_NODES_PER_WAVELENGTH / mesh.kind.order:g} of {mesh.element} are the least; "
            + (
                f"raise the upper limits.frequency to {highest:g} Hz, which mesh: auto follows"
                if mesh.strip
                else f"use {Mesh.coarsest(plate, frequency=highest, element=mesh.element)} or finer"
            )
        )


def hold_and_drive(
    eras: Sequence[Era], loads: Sequence[PointLoad], omega: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Dynamic stiffness (f, eras + loads) [N/m], and each ERA's force at full stroke (f, eras) [N].

    omega: (f,) [rad/s]. The force is that of the base as it moves with the ERA's own gain.
    """
    held = np.array(
        [(era.stiffness, era.damping, era.bolt_mass) for era in eras]
        + [(load.stiffness, load.damping, load.mass) for load in loads],
        dtype=float,
    ).reshape(-1, 3)
    spring = held[:, 0] + 1j * omega[:, None] * held[:, 1]
    stroke = np.array([era.stroke for era in eras])
    drive = spring[:, : len(eras)] * stroke
    for number, era in enumerate(eras):
        drive[:, number] *= era.gain(omega / (2 * np.pi))
    return spring - (omega**2)[:, None] * held[:, 2], drive


def direct_acceleration(
    matrices: PlateMatrices,
    eras: Sequence[Era],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[PointLoad] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    Each ERA alone at full stroke and phase zero, the others and the loads holding. One sparse
    factorisation per frequency: the reference that the free plate's answer is compared with. Raises
    InputError for a frequency that is none or that the mesh cannot carry, and for points off the
    plate.
    """
    check_frequencies(matrices.plate, matrices.mesh, frequencies)
    touch = matrices.deflection_at(np.vstack([era_positions(eras), load_positions(loads)]))
    observe = matrices.deflection_at(points)
    result = np.empty((len(frequencies), len(eras), observe.shape[0]), dtype=complex)
    omegas = 2 * np.pi * np.asarray(frequencies, dtype=float)
    holds, drives = hold_and_drive(eras, loads, omegas)
    for row, (omega, hold, drive) in enumerate(zip(omegas, holds, drives, strict=True)):
        dynamic = (
            (1 + 1j * matrices.plate.loss_factor) * matrices.stiffness
            - omega**2 * matrices.mass
            + touch.T @ sparse.diags_array(hold) @ touch
        )
        factor = factorise(dynamic)
        displacement = factor.solve((touch[: len(eras)].T @ sparse.diags_array(drive)).toarray())
        result[row] = -(omega**2) * (observe @ displacement).T
    return result
