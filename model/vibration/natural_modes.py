"""Natural modes of a plate on any mesh, for any support."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.errors import InputError
from model.fem.mesh import Mesh
from model.fem.plate import (
    RIGID_BODY_MODES,
    assemble,
    simply_supported_modes,
)
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import on_springs, reduce_free_plate
from model.rig.rig import Rig
from model.spectral.mesh import PlateMesh, SpectralMesh
from model.structure.attachments import PointLoad, Source, footprints_of


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

    support: free (elastic modes only), eras or simply-supported, for which polynomials over the
    plate give way to finite elements; free: its plate where it has been solved on the mesh. Raises
    InputError for a count below 1 or above what the mesh has, and for a simply supported plate of
    layers.
    """
    if count < 1:
        raise InputError(f"modes must be 1 or more, got {count}")
    chosen = mesh or rig.mesh
    if support == "simply-supported":
        return _simply_supported(rig, count, chosen)
    attached: list[Source | PointLoad] = [*rig.masses]
    if support == "eras":
        attached += rig.eras
    gap = rig.plate.air_gap
    # Air sealed in resists motion up and down; it only flows to and fro under tilts.
    rigid = RIGID_BODY_MODES - (gap is not None and gap.closed) if support == "free" else 0
    highest = rig.limits.frequency_max
    while True:
        solved = free or solve_free_plate(rig.plate, chosen, frequency_max=highest)
        modes = _modes_with(solved, attached)
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


def _modes_with(free: FreePlate, attached: list[Source | PointLoad]) -> NaturalModes:
    """All modes of the undamped plate with attachments, of the truncated ones some mixtures."""
    places = footprints_of(attached)
    reduced = reduce_free_plate(free, places)
    _, (M, _, K) = on_springs(reduced, [each.in_time for each in attached], reduced.at(places))
    squares, coordinates = linalg.eigh(K, M)
    frequencies = np.sqrt(np.maximum(squares, 0)) / (2 * np.pi)
    return NaturalModes(frequencies, reduced.at, coordinates[: len(reduced.omega)], free.mesh)


def _simply_supported(rig: Rig, count: int, mesh: PlateMesh) -> NaturalModes:
    """Modes of finite elements, whose shapes are those of the nodes."""
    if rig.plate.is_layered:
        raise InputError(
            "support must be free or eras for a plate of layers or with an air gap, got "
            "simply-supported: finite elements of it are not solved"
        )
    if isinstance(mesh, SpectralMesh):
        mesh = Mesh.accurate(rig.plate, frequency_max=rig.limits.frequency_max)
    matrices = assemble(rig.plate, mesh)
    frequencies, unknowns = simply_supported_modes(matrices, count, rig.masses)
    return NaturalModes(frequencies, matrices.deflection_at, unknowns, mesh)
