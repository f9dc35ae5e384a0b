"""Natural frequencies and mode shapes of the plate, free, simply supported or on its ERAs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from model.arrays import FloatArray, IntArray
from model.errors import InputError
from model.fem.assembly import PlateMatrices
from model.fem.factorisation import factorise
from model.structure.actuator import Era
from model.structure.point_load import PointLoad, footprints_of

RIGID_BODY_MODES = 3  # of a free plate: up and down, and two tilts


@dataclass(frozen=True)
class Modes:
    """Natural frequencies [Hz] (n,), ascending, and mode shapes as deflections at the mesh nodes.

    mode_shapes: (node_count, n), scaled to modal mass 1 [1/sqrt(kg)].
    """

    natural_frequencies: FloatArray
    mode_shapes: FloatArray


def shift_invert_modes(
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


def _no_dofs(matrices: PlateMatrices) -> IntArray:
    return np.array([], dtype=np.int64)


def _edge_deflections(matrices: PlateMatrices) -> IntArray:
    """Deflection on all four edges; rotations stay free (soft simple support)."""
    mesh = matrices.mesh
    node = np.arange(mesh.node_count).reshape(mesh.rows, mesh.columns)
    edge = np.concatenate([node[0], node[-1], node[1:-1, 0], node[1:-1, -1]])
    return 3 * edge


SUPPORTS: dict[str, Callable[[PlateMatrices], IntArray]] = {
    "free": _no_dofs,
    "eras": _no_dofs,
    "simply-supported": _edge_deflections,
}
"""Fixed degrees of freedom by the name of the support; "eras" adds springs and bolts."""


def modes(
    matrices: PlateMatrices,
    count: int,
    *,
    support: str,
    eras: Sequence[Era] = (),
    loads: Sequence[PointLoad] = (),
) -> Modes:
    """Solve for the lowest `count` undamped modes; of a free plate only the elastic ones.

    support: a name in SUPPORTS; with "eras" each ERA adds its stiffness and bolt mass. loads act
    with any support. Raises InputError for a count below 1 or above what the mesh has.
    """
    if count < 1:
        raise InputError(f"modes must be 1 or more, got {count}")
    stiffness, mass = matrices.stiffness, matrices.mass
    attachments = [*loads]
    if support == "eras":
        attachments += [PointLoad.of_era(era) for era in eras]
    if attachments:
        interpolation = matrices.deflection_at(footprints_of(attachments))
        springs = sparse.diags_array(np.array([load.stiffness for load in attachments]))
        masses = sparse.diags_array(np.array([load.mass for load in attachments]))
        stiffness = sparse.csc_array(stiffness + interpolation.T @ springs @ interpolation)
        mass = sparse.csc_array(mass + interpolation.T @ masses @ interpolation)
    free = np.setdiff1d(np.arange(matrices.dof), SUPPORTS[support](matrices))
    rigid = RIGID_BODY_MODES if support == "free" else 0
    eigenvalues, vectors = shift_invert_modes(
        sparse.csc_array(stiffness[free][:, free]),
        sparse.csc_array(mass[free][:, free]),
        count + rigid,
        shift=(2 * np.pi * matrices.plate.lowest_bending_frequency) ** 2,
    )
    whole = np.zeros((matrices.dof, count))
    whole[free] = vectors[:, rigid:]
    frequencies = np.sqrt(np.maximum(eigenvalues[rigid:], 0)) / (2 * np.pi)
    return Modes(frequencies, whole[0::3])
