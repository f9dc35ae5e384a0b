"""Steady-state response solved directly at each frequency: the check of the reduction."""

from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.fem.plate_mesh import check_frequencies
from model.fem.symmetry import CLASSES
from model.spectral.local_compliance import local_compliance
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import deflections_by_class
from model.spectral.stiffness import class_stiffness
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import attached_stiffness, drive_forces
from model.structure.footprint import as_footprints
from model.structure.low_rank import coupled_forces, on_diagonal
from model.structure.modal_elasticity import check_of_theory, loss_factors
from model.structure.plate import Plate
from model.structure.point_load import Load, footprints_of


def direct_spectral_acceleration(
    plate: Plate,
    mesh: SpectralMesh,
    eras: Sequence[Era],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[Load] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    As `direct_acceleration` on finite elements: ((1 + i eta) K - omega² M) u = F in all unknowns,
    plus the compliance that the polynomials do not resolve.
    """
    check_of_theory(plate)
    check_frequencies(plate, mesh, frequencies)
    attached = footprints_of(eras, loads)
    x, y = mesh.directions(plate)
    omega = 2 * np.pi * np.asarray(frequencies, dtype=float)
    loss = (1 + 1j * loss_factors(plate, omega))[:, None, None]
    everywhere = np.concatenate([attached, as_footprints(points)])
    degrees = (mesh.nx, mesh.ny)
    receptance = np.empty((len(omega), len(everywhere), len(attached)), dtype=complex)
    receptance[:] = local_compliance(plate, degrees, everywhere, attached) / loss
    for parity, shapes in zip(CLASSES, deflections_by_class(plate, x, y, everywhere), strict=True):
        upper = np.triu(class_stiffness(plate, x, y, parity))
        K = upper + np.triu(upper, 1).T
        forces = np.zeros((len(K), len(attached)))
        forces[: shapes.shape[1]] = shapes[: len(attached)].T
        for number, each in enumerate(omega):
            moved = np.linalg.solve(loss[number] * K - each**2 * np.eye(len(K)), forces)
            receptance[number] += shapes @ moved[: shapes.shape[1]]
    return driven_acceleration(receptance, eras, loads, omega)


def driven_acceleration(
    receptance: ComplexArray, eras: Sequence[Era], loads: Sequence[Load], omega: FloatArray
) -> ComplexArray:
    """Acceleration [m/s²] at p points per angular frequency (f,) and driven ERA: (f, eras, p).

    receptance (f, n + p, n) [m/N]: of the free plate, from the n attachments of ERAs and loads to
    themselves and then to the points.
    """
    count = receptance.shape[2]
    between, to_points = np.split(receptance, [count], axis=1)
    stiffness = attached_stiffness(eras, loads, omega)
    applied = on_diagonal(drive_forces(eras, omega), rows=count)
    displacement = (to_points @ coupled_forces(between, stiffness, applied)).transpose(0, 2, 1)
    return np.asarray(-(omega**2)[:, None, None] * displacement)
