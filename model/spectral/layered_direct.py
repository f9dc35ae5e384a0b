"""Response of a plate of layers solved at each frequency with the moduli there: the check of modes.

Nothing is approximated in frequency: adhesives, air and the inertia along the plate are those of
the frequency at hand.
"""

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.fem.plate_mesh import check_frequencies
from model.fem.symmetry import CLASSES
from model.spectral.direct import driven_acceleration
from model.spectral.layered_class import LayeredPlate
from model.spectral.local_compliance import local_compliance
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import deflections_by_class
from model.structure.actuator import Era
from model.structure.equivalent import short_wave_plate
from model.structure.footprint import as_footprints
from model.structure.modal_elasticity import check_of_theory, loss_factors
from model.structure.plate import Plate
from model.structure.point_load import Load, footprints_of


def direct_layered_acceleration(
    plate: Plate,
    mesh: SpectralMesh,
    eras: Sequence[Era],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[Load] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    As `direct_spectral_acceleration`. Raises InputError as it does.
    """
    check_frequencies(plate, mesh, frequencies)
    check_of_theory(plate)
    attached = footprints_of(eras, loads)
    everywhere = np.concatenate([attached, as_footprints(points)])
    density = plate.material.rho * plate.thickness
    bases = [
        math.sqrt(density) * each
        for each in deflections_by_class(plate, *mesh.directions(plate), everywhere)
    ]
    degrees, count = (mesh.nx, mesh.ny), len(attached)
    omega = 2 * np.pi * np.asarray(frequencies, dtype=float)
    receptance = np.empty((len(omega), len(everywhere), count), dtype=complex)
    for number, frequency in enumerate(frequencies):
        local = short_wave_plate(plate, 2 * math.pi / mesh.shortest_wavelength, frequency)
        receptance[number] = local_compliance(local, degrees, everywhere, attached) / (
            1 + 1j * float(loss_factors(plate, omega[number]))
        )
        layered = LayeredPlate(plate, degrees, frequency)
        for parity, shapes in zip(CLASSES, bases, strict=True):
            D = layered.dynamic_stiffness(parity, frequency)
            receptance[number] += shapes @ np.linalg.solve(D, shapes[:count].T)
    return driven_acceleration(receptance, eras, loads, omega)
