"""The plate in finite elements: its matrices, natural modes, and response frequency by frequency.

An ERA is a spring k_b and a damper c between the plate and a base that moves y exp(i omega t), with
a bolt of mass m_b on the plate. Its force on the plate is (k_b + i omega c) y minus its dynamic
stiffness k_b + i omega c - omega² m_b times the deflection (paper Eq. 21 and 25). The plate's own
damping is hysteretic: ((1 + i eta) K - omega² M) u = F.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.mesh import DOF_PER_NODE, Mesh, check_frequencies
from model.structure.attachments import (
    Era,
    Load,
    PointLoad,
    attached_stiffness,
    drive_forces,
    footprints_of,
)
from model.structure.modal_elasticity import check_of_theory, loss_factors
from model.structure.plate import Plate

RIGID_BODY_MODES = 3  # of a free plate: up and down, and two tilts

NUS = (0.0, 0.4)
"""Poisson's ratios of a difference: any two, since the stiffness is linear in between."""

SQUARES = (0.5, 1.5)
"""Squares of s of a difference, about 1."""


@dataclass(frozen=True)
class PlateMatrices:
    """Stiffness and mass of the free plate, CSC, (dof, dof), with its mesh.

    Degree of freedom 3 * node is the deflection, the next two are the rotations.
    """

    plate: Plate
    mesh: Mesh
    stiffness: sparse.csc_array
    mass: sparse.csc_array

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return DOF_PER_NODE * self.mesh.node_count

    def deflection_at(self, points: FloatArray) -> sparse.csr_array:
        """Map of the degrees of freedom to deflections at points [m] (n, 2), sparse (n, dof)."""
        pick = sparse.csr_array(np.array([[1.0, 0.0, 0.0]]))
        return sparse.csr_array(sparse.kron(self.mesh.interpolation(points), pick, format="csr"))


def assemble(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """Assemble stiffness and mass of the free plate.

    Raises InputError for a mesh of another plate, and for a plate of layers or with air behind it.
    """
    if plate.is_layered:
        what = "a laminate" if plate.laminate is not None else "a plate with an air gap"
        raise InputError(
            f"mesh: must be of polynomials for {what}, got {mesh}; finite elements are for "
            "homogeneous plates in a vacuum: use mesh auto, or Legendre with degrees"
        )
    sides = ((plate.length, mesh.length), (plate.width, mesh.width))
    if not all(math.isclose(*side) for side in sides):
        raise InputError(
            f"mesh: must cover the plate of {plate.length:g} x {plate.width:g} m, got "
            f"{mesh.length:g} x {mesh.width:g} m; make the mesh for this plate"
        )
    sizes = _sizes(mesh)
    stiffness = np.array([mesh.element.stiffness(plate, *size) for size in sizes])
    mass = np.array([mesh.element.mass(plate, *size) for size in sizes])
    return PlateMatrices(plate, mesh, _assembled(mesh, stiffness), _assembled(mesh, mass))


def direct_acceleration(
    matrices: PlateMatrices,
    eras: Sequence[Era],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[Load] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    Each ERA alone at full stroke and phase zero, the others at rest. One sparse factorisation per
    frequency: the reference that `FreePlate.acceleration` is compared with. Raises InputError as
    `check_frequencies`, and for points off the plate.
    """
    check_of_theory(matrices.plate)
    check_frequencies(matrices.plate, matrices.mesh, frequencies)
    touch = matrices.deflection_at(footprints_of(eras, loads))
    observe = matrices.deflection_at(points)
    result = np.empty((len(frequencies), len(eras), observe.shape[0]), dtype=complex)
    omegas = 2 * np.pi * np.asarray(frequencies, dtype=float)
    attached, forces = attached_stiffness(eras, loads, omegas), drive_forces(eras, omegas)
    losses = loss_factors(matrices.plate, omegas)
    for row, (omega, loss) in enumerate(zip(omegas, losses, strict=True)):
        dynamic_stiffness = (
            (1 + 1j * loss) * matrices.stiffness
            - omega**2 * matrices.mass
            + touch.T @ sparse.diags_array(attached[row]) @ touch
        )
        load = touch[: len(eras)].T @ sparse.diags_array(forces[row])
        displacement = factorise(dynamic_stiffness).solve(load.toarray())
        result[row] = -(omega**2) * (observe @ displacement).T
    return result


def simply_supported_modes(
    matrices: PlateMatrices, count: int, loads: Sequence[PointLoad] = ()
) -> tuple[FloatArray, FloatArray]:
    """Natural frequencies (n,) [Hz], ascending, and undamped modes (dof, n) of modal mass 1.

    Without deflection on all four edges, where rotations are free. Raises InputError for a count
    above what the mesh has.
    """
    mesh, touch = matrices.mesh, matrices.deflection_at(footprints_of(loads))
    springs = sparse.diags_array(np.array([load.stiffness for load in loads], dtype=float))
    masses = sparse.diags_array(np.array([load.mass for load in loads], dtype=float))
    is_free = np.ones((mesh.rows, mesh.columns, DOF_PER_NODE), dtype=bool)
    is_free[[0, -1], :, 0] = is_free[:, [0, -1], 0] = False
    free = np.flatnonzero(is_free)
    eigenvalues, vectors = lowest_modes(
        sparse.csc_array(
            sparse.csc_array(matrices.stiffness + touch.T @ springs @ touch)[free][:, free]
        ),
        sparse.csc_array(sparse.csc_array(matrices.mass + touch.T @ masses @ touch)[free][:, free]),
        count,
        shift=(2 * np.pi * matrices.plate.lowest_bending_frequency) ** 2,
    )
    whole = np.zeros((matrices.dof, count))
    whole[free] = vectors
    return np.sqrt(np.maximum(eigenvalues, 0)) / (2 * np.pi), whole


def lowest_modes(
    stiffness: sparse.csc_array, mass: sparse.csc_array, count: int, *, shift: float
) -> tuple[FloatArray, FloatArray]:
    """Solve K phi = omega² M phi for the lowest eigenpairs by shift-invert Lanczos.

    Returns omega² ascending (count,) and vectors (dof, count) of unit modal mass. shift [rad²/s²]:
    above zero, of the order of the lowest elastic omega²; K + shift M is then positive definite
    although K is singular for a free plate.
    """
    size = stiffness.shape[0]
    if count >= size:
        raise InputError(
            f"modes must be fewer than the mesh's {size} free degrees of freedom, got {count}; "
            "take fewer modes or a finer mesh"
        )
    factor = factorise(stiffness + shift * mass)
    eigenvalues, vectors = eigsh(
        stiffness,
        count,
        M=mass,
        sigma=-shift,
        which="LM",
        OPinv=LinearOperator(stiffness.shape, matvec=factor.solve, dtype=float),
        v0=np.random.default_rng(0).standard_normal(size),  # ARPACK's own start is random
    )
    order = np.argsort(eigenvalues, kind="stable")
    return eigenvalues[order], vectors[:, order]


def factorise(matrix: sparse.sparray) -> SuperLU:
    """Factorise a matrix with symmetric pattern and a strong diagonal.

    SuperLU's defaults, meant for unsymmetric matrices, take several times longer here; a pivot
    threshold above zero alone made it 80 times slower.
    """
    return splu(
        sparse.csc_array(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def element_slopes(plate: Plate, mesh: Mesh, shapes: FloatArray) -> FloatArray:
    """Derivatives of the stiffness between shapes (dof, r) of a plate on a mesh, (3, r, r).

    By the logarithms of length and width, at the same mass, and by Poisson's ratio: exactly, as
    `model.spectral.shape_stiffness`, whose reasons hold for the elements' functions, too.
    """
    sizes, element = _sizes(mesh), mesh.element
    nominal = np.array([element.stiffness(plate, *size) for size in sizes])
    slopes = np.zeros((3, *nominal.shape))
    for axis in range(2):
        for square, share in zip(SQUARES, (2.0, -2.0), strict=True):  # d s² / d ln side = -2
            s = np.ones(DOF_PER_NODE)
            s[1 + axis] = square**0.5
            nodal = np.tile(s, nominal.shape[1] // DOF_PER_NODE)
            stretched = [
                element.stiffness(plate, dx / s[1], dy / s[2]) * s.prod() for dx, dy in sizes
            ]
            slopes[axis] += share * np.array(stretched) * np.outer(nodal, nodal)
    nu, material = plate.material.nu, plate.material
    slopes[2] = 2 * nu * nominal
    for other, share in zip(NUS, (-1.0, 1.0), strict=True):
        changed = replace(plate, material=replace(material, nu=other))
        factor = share * (1 - other**2) / (NUS[1] - NUS[0])
        slopes[2] += factor * np.array([element.stiffness(changed, *size) for size in sizes])
    slopes[2] /= 1 - nu**2
    return np.array([shapes.T @ (_assembled(mesh, slope) @ shapes) for slope in slopes])


def _sizes(mesh: Mesh) -> list[tuple[float, float]]:
    """Length and width [m] of each size of element: one, or four with strips along the edges."""
    widths = [(size, mesh.strip) if mesh.strip else (size,) for size in mesh.element_size]
    return [(dx, dy) for dy in widths[1] for dx in widths[0]]


def _assembled(mesh: Mesh, matrices: FloatArray) -> sparse.csc_array:
    """The whole plate's matrix (dof, dof) of those of each size of element, (sizes, n, n)."""
    dofs = DOF_PER_NODE * mesh.connectivity[:, :, None] + np.arange(DOF_PER_NODE)
    dofs = dofs.reshape(len(mesh.connectivity), -1)
    side_x, side_y = mesh.element_sides
    size_of = ((2 if mesh.strip else 1) * side_y[:, None] + side_x).ravel()
    row, column = np.nonzero(matrices.any(axis=0))
    values = matrices[:, row, column][size_of]
    places = (dofs[:, row].ravel(), dofs[:, column].ravel())
    size = DOF_PER_NODE * mesh.node_count
    return sparse.csc_array(sparse.coo_array((values.ravel(), places), shape=(size, size)))
