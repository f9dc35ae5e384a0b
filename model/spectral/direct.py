"""Response of a plate solved at each frequency with the moduli there: the check of modes.

Nothing is approximated in frequency: adhesives, air and the inertia along the plate are those of
the frequency at hand.
"""

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.spectral.functions import CLASSES, deflections_by_class
from model.spectral.local_compliance import local_compliance
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import SpectralPlate
from model.structure.attachments import (
    Era,
    Load,
    attached_stiffness,
    coupled_forces,
    drive_forces,
    footprints_of,
    on_diagonal,
)
from model.structure.footprint import as_footprints
from model.structure.laminate_section import short_wave_plate
from model.structure.modal_elasticity import check_of_theory, loss_factors
from model.structure.plate import Plate


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

    As `direct_acceleration` on finite elements, plus the compliance that the polynomials do not
    resolve. Raises InputError as it does.
    """
    mesh.check_frequencies(plate, frequencies)
    check_of_theory(plate)
    attached = footprints_of(eras, loads)
    everywhere = np.concatenate([attached, as_footprints(points)])
    degrees, count = (mesh.nx, mesh.ny), len(attached)
    bases = deflections_by_class((plate.length, plate.width), degrees, everywhere)
    omega = 2 * np.pi * np.asarray(frequencies, dtype=float)
    receptance = np.empty((len(omega), len(everywhere), count), dtype=complex)
    for number, frequency in enumerate(frequencies):
        local = short_wave_plate(plate, 2 * math.pi / mesh.shortest_wavelength, frequency)
        receptance[number] = local_compliance(local, degrees, everywhere, attached) / (
            1 + 1j * float(loss_factors(plate, omega[number]))
        )
        layered = SpectralPlate(plate, degrees, frequency)
        for parity, shapes in zip(CLASSES, bases, strict=True):
            D = layered.dynamic_stiffness(parity, frequency)
            receptance[number] += shapes @ np.linalg.solve(D, shapes[:count].T)
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
