"""Natural modes of a plate on any mesh, for any support."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.errors import InputError
from model.fem.mesh import Mesh
from model.fem.plate import RIGID_BODY_MODES
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import contribution, reduce_free_plate
from model.reduction.spectral_modes import SpectralModes
from model.rig.meshes import mesh_of
from model.rig.rig import Rig
from model.spectral.mesh import PlateMesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.footprint import as_footprints
from model.structure.modal_elasticity import ModalElasticity


@dataclass(frozen=True, eq=False)
class NaturalModes:
    """Undamped modes: frequencies (n,) [Hz], ascending, and shapes by `at`.

    basis: functions at points (p, m), of which the modes are columns of coordinates (m, n); mesh:
    that they were solved on.
    """

    frequencies: FloatArray
    basis: Callable[[FloatArray], Any]
    coordinates: FloatArray
    mesh: PlateMesh

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points (p, 2) [m], (p, n) [1/sqrt(kg)]."""
        return np.asarray(self.basis(points) @ self.coordinates)

    def only(self, chosen: slice) -> "NaturalModes":
        """Some of them."""
        return replace(
            self,
            frequencies=self.frequencies[chosen],
            coordinates=self.coordinates[:, chosen],
        )


_HELD = 1e-9  # share of the largest motion of the edges that is none
_BEYOND = 4.0  # times what a mesh resolves: coarse ones are compared with others, too


def natural_modes(
    rig: Rig,
    count: int,
    *,
    support: str,
    mesh: PlateMesh | None = None,
    free: FreePlate | None = None,
) -> NaturalModes:
    """Solve for the lowest modes of a rig, on a mesh, by default its own.

    support: free (elastic modes only), eras or simply-supported, without deflection on the edges,
    for which elements of higher order give way to polynomials; free: its plate where it has been
    solved on the mesh. Raises InputError for a count below 1 or above what the mesh has.
    """
    if count < 1:
        raise InputError(f"modes must be 1 or more, got {count}")
    chosen, highest = mesh or rig.mesh, rig.limits.frequency_max
    pins = np.empty((0, 2))
    if support == "simply-supported":
        if isinstance(chosen, Mesh) and chosen.element.order > 1:
            chosen = mesh_of("auto", rig.plate, frequency_max=highest)
        pins = chosen.pins
    attached = list(rig.masses)
    if support == "eras":
        attached += [PointLoad.of_era(era) for era in rig.eras]
    gap = rig.plate.air_gap
    # Air sealed in resists motion up and down; it only flows to and fro under tilts.
    rigid = RIGID_BODY_MODES - (gap is not None and gap.closed) if support == "free" else 0
    while True:
        solved = free or solve_free_plate(rig.plate, chosen, frequency_max=highest)
        modes = _modes_with(solved, attached, pins)
        found = int((modes.frequencies <= highest).sum()) - rigid
        if found >= count:
            break
        if highest > _BEYOND * chosen.highest_frequency(rig.plate):
            raise InputError(
                f"modes must be at most {found} with mesh {chosen}, got {count}; take fewer modes "
                "or a finer mesh"
            )
        highest, free = 1.5 * highest, None
    return modes.only(slice(rigid, rigid + count))


def _modes_with(free: FreePlate, attached: list[PointLoad], pins: FloatArray) -> NaturalModes:
    """All modes of the undamped plate with attachments, of the truncated ones some mixtures.

    pins (n, 2) [m]: where it does not deflect.
    """
    if len(pins) and isinstance(free.modes, SpectralModes):
        free = replace(free, modes=free.modes.along_lines())
    reduced = reduce_free_plate(free, np.vstack([footprints_of(attached), as_footprints(pins)]))
    M, _, K = contribution(reduced.at(footprints_of(attached)), attached)
    elastic = ModalElasticity.of(reduced.plate, reduced.omega**2, reduced.losses).eigenvalues
    moving = np.eye(len(M))
    if len(pins):
        moving = linalg.null_space(reduced.at(pins), rcond=_HELD)
    squares, coordinates = linalg.eigh(
        moving.T @ (K + np.diag(elastic)) @ moving, moving.T @ (M + np.eye(len(M))) @ moving
    )
    frequencies = np.sqrt(np.maximum(squares, 0)) / (2 * np.pi)
    return NaturalModes(frequencies, reduced.at, moving @ coordinates, free.mesh)
