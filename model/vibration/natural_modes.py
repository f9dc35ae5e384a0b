"""A plate on any mesh: natural modes for any support, and its response solved directly."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from scipy import linalg

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem.mesh import Mesh
from model.fem.plate import RIGID_BODY_MODES, assemble, direct_acceleration, modes
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.spectral.direct import direct_spectral_acceleration
from model.spectral.mesh import PlateMesh, SpectralMesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.modal_elasticity import ModalElasticity
from model.structure.plate import Plate


@dataclass(frozen=True, eq=False)
class NaturalModes:
    """Undamped modes: frequencies (n,) [Hz], ascending, and shapes (p, n) [1/sqrt(kg)] at points.

    mesh: that they were solved on.
    """

    frequencies: FloatArray
    at: Callable[[FloatArray], FloatArray]
    mesh: PlateMesh


def natural_modes(
    rig: Rig, count: int, *, support: str, mesh: PlateMesh | None = None
) -> NaturalModes:
    """Solve for the lowest modes of a rig, on a mesh, by default its own.

    support: free (elastic modes only), eras or simply-supported, for which polynomials over the
    plate give way to finite elements. Raises InputError for a count below 1 or above what the mesh
    has, and for a simply supported plate of layers.
    """
    chosen = rig.mesh if mesh is None else mesh
    if isinstance(chosen, SpectralMesh):
        if support != "simply-supported":
            return _on_polynomials(rig, count, support=support, mesh=chosen)
        if rig.plate.is_layered:
            raise InputError(
                "support must be free or eras for a plate of layers or with an air gap, got "
                f"{support}: finite elements of it are not solved"
            )
        chosen = Mesh.accurate(rig.plate, frequency_max=rig.limits.frequency_max)
    elements = chosen
    matrices = assemble(rig.plate, elements)
    solved = modes(matrices, count, support=support, eras=rig.eras, loads=rig.masses)

    def shapes_at(points: FloatArray) -> FloatArray:
        return np.asarray(elements.interpolation(points) @ solved.mode_shapes)

    return NaturalModes(solved.natural_frequencies, shapes_at, elements)


def _on_polynomials(rig: Rig, count: int, *, support: str, mesh: SpectralMesh) -> NaturalModes:
    if count < 1:
        raise InputError(f"modes must be 1 or more, got {count}")
    attached = list(rig.masses)
    if support == "eras":
        attached += [PointLoad.of_era(era) for era in rig.eras]
    gap = rig.plate.air_gap
    # Air sealed in resists motion up and down; it only flows to and fro under tilts.
    rigid = RIGID_BODY_MODES - (gap is not None and gap.closed) if support == "free" else 0
    highest = rig.limits.frequency_max
    while True:
        reduced = reduce_plate(rig.plate, mesh, footprints_of(attached), frequency_max=highest)
        frequencies, coordinates = _modes_with(reduced, attached)
        found = int((frequencies <= highest).sum()) - rigid
        if found >= count:
            break
        if highest > mesh.highest_frequency(rig.plate):
            raise InputError(
                f"modes must be at most {found} with mesh {mesh}, got {count}; take fewer modes or "
                "higher degrees"
            )
        highest *= 1.5
    chosen = slice(rigid, rigid + count)
    return NaturalModes(
        frequencies[chosen], partial(_shapes, reduced, coordinates[:, chosen]), mesh
    )


def _modes_with(reduced: ReducedPlate, attached: list[PointLoad]) -> tuple[FloatArray, FloatArray]:
    """Frequencies [Hz] (r,) and coordinates (r, r) of the undamped plate with attachments."""
    phi = reduced.at(footprints_of(attached)).T
    elastic = ModalElasticity.of(reduced.plate, reduced.omega**2, reduced.losses).eigenvalues
    K = np.diag(elastic) + (phi * [load.stiffness for load in attached]) @ phi.T
    M = np.eye(len(K)) + (phi * [load.mass for load in attached]) @ phi.T
    squares, coordinates = linalg.eigh(K, M)
    return np.sqrt(np.maximum(squares, 0)) / (2 * np.pi), coordinates


def _shapes(reduced: ReducedPlate, coordinates: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(reduced.at(points) @ coordinates)


Responder: TypeAlias = Callable[..., ComplexArray]
"""Acceleration [m/s²] of each ERA alone at full stroke, (f, eras, p).

Of ERAs, frequencies (f,) [Hz], points (p, 2) [m], and loads by name.
"""


def direct_responder(plate: Plate, mesh: PlateMesh) -> Responder:
    """Direct solution of a plate on a mesh, the check of its reduction."""
    if isinstance(mesh, Mesh):
        return partial(direct_acceleration, assemble(plate, mesh))
    return partial(direct_spectral_acceleration, plate, mesh)
