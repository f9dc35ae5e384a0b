"""Direct solution of a plate in polynomials at each frequency, and derivatives of its stiffness.

The direct solution is the reference for the modal one, without approximation in frequency.
Adhesives, air and in-plane inertia have their values at each frequency, and the compliance that
polynomials do not resolve is added.

Derivatives are the changes of the stiffness between given shapes with the plate's sides and
Poisson's ratios. Displacements along the plate minimize the energy for a given deflection. To first
order, a change of stiffness dK therefore changes the energy of shapes v by v^T dK v, and no other
plate is solved. The derivative with respect to a side has a closed form (`class_stiffness`). The
derivative with respect to Poisson's ratio nu, whose change is the same in all layers, follows from
a small change of the section, because K is linear in the section. The stiffness of air and changes
of rotary inertia are neglected.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.spectral.modes import SpectralPlate, layers_of
from model.spectral.plate_mesh import SpectralMesh
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
from model.spectral.unresolved_compliance import unresolved_at
from model.structure.attachments import Attachment, coupled_forces, footprints_of
from model.structure.footprints import as_footprints
from model.structure.laminate_bending import (
    CrossSection,
    interface_mass,
    section_of,
    shear_corrections,
    short_wave_plate,
)
from model.structure.modal_elasticity import loss_factors
from model.structure.plate import LaminateLayer, Plate
from model.structure.sources import Source, unit_accelerations

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
    loads: Sequence[Attachment] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and source: (f, n, p).

    Each alone at full level and phase zero, the others at rest. Raises InputError for a
    frequency that the mesh cannot carry, and for a plate whose modes were measured.
    """
    if plate.mode_deviations:
        raise InputError("a direct solution has no modes, which plate.modes would change")
    mesh.check_frequencies(plate, frequencies)
    attached = footprints_of(sources, loads)
    places = np.concatenate([attached, as_footprints(points)])
    degrees = (mesh.nx, mesh.ny)
    count = len(attached)
    bases = deflections_by_class((plate.length, plate.width), degrees, places)
    shortest = 2 * math.pi / mesh.shortest_wavelength
    omega = 2 * np.pi * np.asarray(frequencies, dtype=float)
    receptance = np.empty((len(omega), len(places), count), dtype=complex)
    for number, frequency in enumerate(frequencies):
        local_plate = short_wave_plate(plate, shortest, frequency)
        unresolved = unresolved_at(local_plate, degrees, places)
        compliance = unresolved.shared_with(unresolved_at(local_plate, degrees, attached))
        receptance[number] = compliance / (1 + 1j * float(loss_factors(plate, omega[number])))
        spectral_plate = SpectralPlate(plate, degrees, frequency)
        for parity, shapes in zip(CLASSES, bases, strict=True):
            D = dynamic_stiffness(spectral_plate, parity, frequency)
            receptance[number] += shapes @ np.linalg.solve(D, shapes[:count].T)
    between, to_points = np.split(receptance, [count], axis=1)

    def displacements(stiffness: ComplexArray, applied: ComplexArray) -> ComplexArray:
        """Return displacements (f, n, p), from stiffnesses of attachments and forces on them."""
        forces = coupled_forces(between, stiffness, applied)
        return np.asarray(to_points @ forces).swapaxes(1, 2)

    return unit_accelerations(sources, loads, omega, displacements)


def dynamic_stiffness(
    plate: SpectralPlate, parity: tuple[int, int], frequency: float
) -> ComplexArray:
    """Force by deflection in the polynomials of a class at a frequency [Hz], (m, m)."""
    functions = plate.functions(parity)
    omega = 2 * math.pi * frequency
    loss_factor = 1j * float(loss_factors(plate.plate, np.asarray(omega)))
    real_moduli = list[float]()
    imaginary_moduli = list[float]()
    for layer in plate.layers:
        own_modulus = layer.modulus(frequency)
        modulus = own_modulus + loss_factor * own_modulus.real
        real_moduli.append(modulus.real)
        imaginary_moduli.append(modulus.imag)
    elastic = plate.stiffness(functions, real_moduli)
    lossy = plate.stiffness(functions, imaginary_moduli)
    D: ComplexArray = elastic + 1j * lossy
    w = slice(0, functions.deflections)
    along = slice(functions.deflections, None)
    identity = np.eye(functions.size - functions.deflections)
    D[along, along] -= omega**2 * along_mass(functions, plate.interface_mass, identity)
    D[w, w] -= omega**2 * plate.deflection_mass(functions)
    condensed = D[w, w] - _yielding(D, functions.deflections)
    gap = plate.plate.air_gap
    if gap is None:
        return np.asarray(condensed)
    air = air_motion(functions, gap)
    G = gap.bulk_modulus(frequency) * air.stiffness.astype(complex)
    G -= omega**2 * gap.inertia(frequency) * np.diag(air.inertia)
    return condensed + G[w, w] - _yielding(G, functions.deflections)


def _yielding(D: ComplexArray, count: int) -> ComplexArray:
    """Decrease of the stiffness of the first unknowns because all others are free, (n, n)."""
    w = slice(0, count)
    free = slice(count, None)
    return D[w, free] @ np.linalg.solve(D[free, free], D[free, w])


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
        changed = list[LaminateLayer]()
        for layer in layers:
            material = replace(layer.material, nu=layer.material.nu + further_nu)
            changed.append(replace(layer, material=material))
        return section_of(changed, moduli, corrections)

    nominal = section(0.0)
    slopes = np.zeros((3, *2 * unknowns[0].shape[1:]))
    for functions, v in _shapes(plate, degrees, unknowns, nominal):
        for side in range(2):
            K = class_stiffness(functions, nominal, side)
            slopes[side] += v.T @ K @ v
        for step in (_STEP, -_STEP):
            K = class_stiffness(functions, section(step))
            slopes[2] += v.T @ K @ v / (2 * step)
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
    for functions, v in _shapes(plate, degrees, unknowns, section()):
        for number, key in enumerate(("e2", "g12")):
            share = getattr(material.shares, key)
            for step in (_STEP, -_STEP):
                changed = section(**{key: share * (1 + step)})
                K = class_stiffness(functions, changed)
                slopes[number] += np.einsum("nr,nr->r", v, K @ v) / (2 * step)
    return slopes


def _shapes(
    plate: Plate, degrees: tuple[int, int], unknowns: Sequence[FloatArray], nominal: CrossSection
) -> Iterator[tuple[ClassFunctions, FloatArray]]:
    """Yield of each class its functions, and shapes with their displacements along the plate."""
    layers = layers_of(plate)
    nx, ny = degrees
    x = EdgedFunctions(plate.length, nx, edge_decays(nominal, 0))
    y = EdgedFunctions(plate.width, ny, edge_decays(nominal, 1))
    shift = (2 * np.pi * plate.lowest_bending_frequency) ** 2
    mass = interface_mass(layers)
    for parity, w in zip(CLASSES, unknowns, strict=True):
        functions = ClassFunctions(x, y, parity, len(layers) + 1)
        K = class_stiffness(functions, nominal)
        along = follow(functions, K, mass, shift) @ w
        yield functions, np.vstack([w, along])
