"""The plate in finite elements: its matrices, and natural modes of them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from model.arrays import FloatArray
from model.errors import InputError
from model.fem.mesh import DOF_PER_NODE, Mesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.plate import SHEAR_CORRECTION, Plate

RIGID_BODY_MODES = 3  # of a free plate: up and down, and two tilts

_ENERGY = (
    ("ww", "shear_x", "vv", "ss"),
    ("ww", "shear_y", "ss", "vv"),
    ("wx", "-shear_x", "vv", "sv"),
    ("wy", "-shear_y", "sv", "vv"),
    ("xx", "shear_x", "vv", "rr"),
    ("xx", "bending_x", "vv", "ss"),
    ("xx", "twist", "ss", "vv"),
    ("yy", "shear_y", "rr", "vv"),
    ("yy", "bending_y", "ss", "vv"),
    ("yy", "twist", "vv", "ss"),
    ("xy", "coupled", "vs", "sv"),
    ("xy", "twist", "sv", "vs"),
)
"""Stiffness between w and the rotations x and y: fields, rigidity, integrals along y and along x.

Slopes s, functions v, rotations r in shear (paper Eq. 17).
"""


def rigidities(plate: Plate) -> dict[str, float]:
    """Bending, coupled and twist [N m], and shear [N/m] of a plate's section (paper Eq. 5 to 7)."""
    of, shares, h = plate.material, plate.material.shares, plate.thickness
    D, S = of.E * h**3 / (12 * of.plane_stress), SHEAR_CORRECTION * of.E * h
    return {
        "bending_x": D,
        "bending_y": shares.e2 * D,
        "coupled": of.nu * shares.e2 * D,
        "twist": shares.g12 * of.E * h**3 / 12,
        "shear_x": shares.g13 * S,
        "shear_y": shares.g23 * S,
    }


@dataclass(frozen=True)
class PlateMatrices:
    """Stiffness and mass of the free plate, CSC, (dof, dof), with its mesh.

    Degree of freedom 3 * node is the deflection, the next two are the rotations.
    """

    plate: Plate
    mesh: Mesh
    stiffness: sparse.csc_array
    mass: sparse.csc_array

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
    density = plate.surface_density
    rotary = density * plate.thickness**2 / 12
    along_x, along_y = mesh.along
    value = sparse.kron(along_y.integrals["vv"], along_x.integrals["vv"])
    mass = sparse.kron(value, np.diag([density, rotary, rotary]))  # paper Eq. 19 and 20
    return PlateMatrices(plate, mesh, _stiffness(mesh, rigidities(plate)), sparse.csc_array(mass))


def _stiffness(
    mesh: Mesh, section: Mapping[str, float], by_side: str | None = None
) -> sparse.csc_array:
    """Stiffness (dof, dof) of a section's rigidities; or its derivative by one side, "x" or "y".

    By the logarithm of the side at the same mass, where functions are stretched with it and the
    rotations along it times its reciprocal s, as slopes are: each part is a power of s.
    """
    along_x, along_y = mesh.along
    blocks: dict[str, Any] = {}
    for of, rigidity, integral_y, integral_x in _ENERGY:
        factor = -section[rigidity[1:]] if rigidity[0] == "-" else section[rigidity]
        if by_side is not None:
            integral = integral_x if by_side == "x" else integral_y
            factor *= -(of.count(by_side) + integral.count("s"))
        part = sparse.kron(along_y.integrals[integral_y], along_x.integrals[integral_x])
        blocks[of] = blocks.get(of, 0) + factor * part
    found: Any = 0
    for of, block in blocks.items():
        place = np.zeros((DOF_PER_NODE, DOF_PER_NODE))
        place["wxy".index(of[0]), "wxy".index(of[1])] = 1
        whole = sparse.kron(block, place, format="csc")
        found = found + (whole if of[0] == of[1] else whole + whole.T)
    return sparse.csc_array(found)


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
    whole = np.zeros((mesh.dof, count))
    whole[free] = vectors
    return np.sqrt(np.maximum(eigenvalues, 0)) / (2 * np.pi), whole


def lowest_modes(
    stiffness: sparse.csc_array, mass: sparse.csc_array, count: int, *, shift: float
) -> tuple[FloatArray, FloatArray]:
    """Solve K phi = omega² M phi for the lowest eigenpairs; a few by shift-invert Lanczos.

    Returns omega² ascending (count,) and vectors (dof, count) of unit modal mass. shift [rad²/s²]:
    above zero, of the order of the lowest elastic omega²; K + shift M is then positive definite
    although K is singular for a free plate.
    """
    size = stiffness.shape[0]
    if count > size:
        raise InputError(
            f"modes must be at most the mesh's {size} free degrees of freedom, got {count}; take "
            "fewer modes or a finer mesh"
        )
    if count >= size / 2:
        some = (0, count - 1)
        return linalg.eigh(stiffness.toarray(), mass.toarray(), subset_by_index=some)
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

    By the logarithms of length and width, at the same mass, and by Poisson's ratio: exactly, for
    the reasons of `model.spectral.shape_stiffness`.
    """
    of, section = plate.material, rigidities(plate)
    apart = of.orthotropy is not None  # its shear moduli do not follow from nu
    by_nu = {key: 0.0 if apart else -value / (1 + of.nu) for key, value in section.items()}
    for side in ("bending_x", "bending_y"):
        by_nu[side] = 2 * of.nu * of.shares.e2 / of.plane_stress * section[side]
    by_nu["coupled"] = of.nu * by_nu["bending_y"] + section["bending_y"]
    slopes = (
        _stiffness(mesh, section, "x"),
        _stiffness(mesh, section, "y"),
        _stiffness(mesh, by_nu),
    )
    return np.array([shapes.T @ (slope @ shapes) for slope in slopes])
