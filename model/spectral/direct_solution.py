"""Direct solution of a plate in polynomials at each frequency, and derivatives of its stiffness.

The direct solution is the reference for the modal one, without approximation in frequency.
Adhesives, air and in-plane inertia have their values at each frequency, and the compliance that
polynomials do not resolve is added.

Derivatives are those of the stiffness between given shapes with respect to the plate's sides and
Poisson's ratios. Displacements along the plate follow deflections by least energy: a change of
stiffness dK then changes the energy of shapes v by v^T dK v, to first order without a solve of
another plate. By a side it has a closed form (`class_stiffness`); by Poisson's ratio nu, which
changes alike in all layers, it follows from a small change of the section, in which K is linear.
The stiffness that air adds, and changes of rotary inertia, are left out.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.spectral.modes import SpectralMesh, SpectralPlate, layers_of, local_compliance
from model.spectral.polynomials import (
    CLASSES,
    ClassFunctions,
    EdgedFunctions,
    air_motion,
    along_mass,
    class_stiffness,
    deflections_by_class,
    edge_decays,
    follow,
)
from model.structure.attachments import (
    Source,
    Support,
    as_footprints,
    coupled_forces,
    footprints_of,
    unit_accelerations,
)
from model.structure.modal_elasticity import loss_factors
from model.structure.plate import (
    CrossSection,
    LaminateLayer,
    Plate,
    interface_mass,
    section_of,
    shear_corrections,
    short_wave_plate,
)

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
            self.stiffness(of, [each.real for each in moduli])
            + 1j * self.stiffness(of, [each.imag for each in moduli])
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
        return result


_STEP = 1e-4  # of Poisson's ratio: exact to its square


def stiffness_slopes(
    plate: Plate,
    degrees: tuple[int, int],
    unknowns: Sequence[FloatArray],
    *,
    frequency: float,
) -> FloatArray:
    """Derivatives of the stiffness between shapes (r,) of a plate, (3, r, r).

    By the logarithms of length and width, at the same mass, and by Poisson's ratio. unknowns: of
    the shapes in orthonormal polynomials up to these degrees, by symmetry class, (n, r); frequency
    [Hz]: of the moduli.
    """
    layers = layers_of(plate)
    corrections = shear_corrections(layers)
    moduli = [layer.modulus(frequency).real for layer in layers]

    def section(further_nu: float) -> CrossSection:
        changed = [
            replace(each, material=replace(each.material, nu=each.material.nu + further_nu))
            for each in layers
        ]
        return section_of(changed, moduli, corrections)

    nominal = section(0.0)
    slopes = np.zeros((3, *2 * unknowns[0].shape[1:]))
    for of, v in _shapes(plate, degrees, unknowns, nominal):
        for side in range(2):
            slopes[side] += v.T @ class_stiffness(of, nominal, side) @ v
        for step in (_STEP, -_STEP):
            slopes[2] += v.T @ class_stiffness(of, section(step)) @ v / (2 * step)
    return slopes


def grain_slopes(
    plate: Plate, degrees: tuple[int, int], unknowns: Sequence[FloatArray]
) -> FloatArray:
    """Derivatives of the stiffness of shapes (r,) of a board, (2, r), each separately.

    With respect to the logarithms of its transverse modulus and its in-plane shear modulus.
    unknowns: see `stiffness_slopes`.
    """
    layers = layers_of(plate)
    material, thickness = plate.material, plate.thickness

    def section(**shares: float) -> CrossSection:
        other = replace(material, orthotropy=replace(material.shares, **shares))
        layer = LaminateLayer(other, thickness)
        return section_of([layer], [material.E], shear_corrections(layers))

    slopes = np.zeros((2, unknowns[0].shape[1]))
    for of, v in _shapes(plate, degrees, unknowns, section()):
        for number, key in enumerate(("e2", "g12")):
            own = getattr(material.shares, key)
            for step in (_STEP, -_STEP):
                K = class_stiffness(of, section(**{key: own * (1 + step)}))
                slopes[number] += np.einsum("nr,nr->r", v, K @ v) / (2 * step)
    return slopes


def _shapes(
    plate: Plate, degrees: tuple[int, int], unknowns: Sequence[FloatArray], nominal: CrossSection
) -> Iterator[tuple[ClassFunctions, FloatArray]]:
    """Yield of each class its functions, and shapes with their displacements along the plate."""
    layers = layers_of(plate)
    x, y = (
        EdgedFunctions(side, degree, edge_decays(nominal, along))
        for along, (side, degree) in enumerate(
            zip((plate.length, plate.width), degrees, strict=True)
        )
    )
    shift = (2 * np.pi * plate.lowest_bending_frequency) ** 2
    for parity, w in zip(CLASSES, unknowns, strict=True):
        of = ClassFunctions(x, y, parity, len(layers) + 1)
        along = follow(of, class_stiffness(of, nominal), interface_mass(layers), shift) @ w
        yield of, np.vstack([w, along])
