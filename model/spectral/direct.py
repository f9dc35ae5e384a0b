"""Response of a plate in polynomials solved at each frequency, without modes: the reference.

Nothing is approximated in frequency: adhesives, air and the inertia along the plate are those of
the frequency at hand, and the compliance that polynomials do not resolve is added.
"""

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.spectral.functions import CLASSES, deflections_by_class
from model.spectral.local_compliance import local_compliance
from model.spectral.mesh import SpectralMesh
from model.spectral.modes import SpectralPlate
from model.spectral.stiffness import air_motion, along_mass
from model.structure.attachments import (
    Source,
    Support,
    coupled_forces,
    footprints_of,
    unit_accelerations,
)
from model.structure.footprint import as_footprints
from model.structure.laminate_section import short_wave_plate
from model.structure.modal_elasticity import loss_factors
from model.structure.plate import Plate

Responder: TypeAlias = Callable[..., ComplexArray]
"""Acceleration [m/s²] of each ERA alone at full stroke, (f, eras, p).

Of ERAs, frequencies (f,) [Hz], points (p, 2) [m], and loads by name.
"""


def direct_spectral_acceleration(
    plate: Plate,
    mesh: SpectralMesh,
    sources: Sequence[Source],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[Support] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and source: (f, n, p).

    Each alone at full level and phase zero, the others at rest. Raises InputError for a
    frequency that the mesh cannot carry, and for a plate whose modes were measured.
    """
    if plate.mode_deviations:
        raise InputError("a direct solution has no modes, which plate.modes would change")
    mesh.check_frequencies(plate, frequencies)
    attached = footprints_of(sources, loads)
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
        layered = AtOneFrequency(plate, degrees, frequency)
        for parity, shapes in zip(CLASSES, bases, strict=True):
            D = layered.dynamic_stiffness(parity, frequency)
            receptance[number] += shapes @ np.linalg.solve(D, shapes[:count].T)
    between, to_points = np.split(receptance, [count], axis=1)
    return unit_accelerations(
        sources, loads, omega, lambda *by: (to_points @ coupled_forces(between, *by)).swapaxes(1, 2)
    )


class AtOneFrequency(SpectralPlate):
    """A plate in polynomials whose response is solved for."""

    def dynamic_stiffness(self, parity: tuple[int, int], frequency: float) -> ComplexArray:
        """Force by deflection in the polynomials of a class at a frequency [Hz], (m, m)."""
        of, omega = self.functions(parity), 2 * math.pi * frequency
        moduli = [layer.modulus(frequency) for layer in self._layers]
        own_loss = 1j * float(loss_factors(self._plate, np.asarray(omega)))
        moduli = [each + own_loss * each.real for each in moduli]
        m = of.deflections
        D: ComplexArray = np.asarray(
            self._stiffness(of, [each.real for each in moduli])
            + 1j * self._stiffness(of, [each.imag for each in moduli])
        )
        D[m:, m:] -= omega**2 * along_mass(of, self._mass, np.eye(of.size - m))
        D[:m, :m] -= omega**2 * self._inertia(of)
        result = D[:m, :m] - D[:m, m:] @ np.linalg.solve(D[m:, m:], D[m:, :m])
        gap = self._plate.air_gap
        if gap is not None:
            air = air_motion(of, gap)
            full = gap.bulk_modulus(frequency) * air.stiffness.astype(complex)
            full -= omega**2 * gap.inertia(frequency) * np.diag(air.inertia)
            result = (
                result + full[:m, :m] - full[:m, m:] @ np.linalg.solve(full[m:, m:], full[m:, :m])
            )
        return np.asarray(result)
