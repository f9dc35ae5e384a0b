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
from model.structure.point_load import PointLoad, load_positions

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
    """The lowest eigenpairs: omega² ascending (count,) and mass-normalised vectors (dof, count).

    shift [rad²/s²]: above zero, of the order of the lowest omega² wanted; stiffness + shift * mass
    is then positive definite even where the free plate's rigid-body modes leave stiffness alone
    singular.
    """
    size = stiffness.shape[0]
    if count >= size:
        raise InputError(
            f"{count} modes asked of a mesh with {size} free degrees of freedom; "
            "ask for fewer modes or use a finer mesh"
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
    order = np.argsort(eigenvalues)
    return eigenvalues[order], vectors[:, order]


def _nothing_held(matrices: PlateMatrices) -> IntArray:
    return np.array([], dtype=np.int64)


def _edges_held(matrices: PlateMatrices) -> IntArray:
    """Deflection on all four edges; rotations stay free (soft simple support)."""
    mesh = matrices.mesh
    node = np.arange(mesh.node_count).reshape(mesh.rows, mesh.columns)
    edge = np.concatenate([node[0], node[-1], node[1:-1, 0], node[1:-1, -1]])
    return 3 * edge


SUPPORTS: dict[str, Callable[[PlateMatrices], IntArray]] = {
    "free": _nothing_held,
    "eras": _nothing_held,
    "simply-supported": _edges_held,
}
"""Degrees of freedom held at zero, by the name of the support; "eras" adds springs and bolts."""


def modes(
    matrices: PlateMatrices,
    count: int,
    *,
    support: str,
    eras: Sequence[Era] = (),
    loads: Sequence[PointLoad] = (),
) -> Modes:
    """The lowest `count` modes without damping; only the elastic ones where the plate is free.

    support: a name in SUPPORTS; with "eras" each ERA adds its stiffness and bolt mass where it
    holds the plate. loads are there whatever holds it.
    """
    if count < 1:
        raise InputError(f"{count} modes asked for; at least one is needed")
    stiffness, mass = matrices.stiffness, matrices.mass
    attached = [*loads]
    if support == "eras":
        attached += [PointLoad(era.x, era.y, era.stiffness, mass=era.bolt_mass) for era in eras]
    if attached:
        touch = matrices.deflection_at(load_positions(attached))
        springs = sparse.diags_array(np.array([load.stiffness for load in attached]))
        masses = sparse.diags_array(np.array([load.mass for load in attached]))
        stiffness = sparse.csc_array(stiffness + touch.T @ springs @ touch)
        mass = sparse.csc_array(mass + touch.T @ masses @ touch)
    held = SUPPORTS[support](matrices)
    free = np.setdiff1d(np.arange(matrices.dof), held)
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
