"""Estimate of the discretisation error of a response, without a converged one.

Of polynomials over the plate it is the sum of two changes of the response: by two further degrees,
and where the compliance under forces that polynomials do not resolve is higher by 20 % and, under
points, by a decade of the logarithm (`model.spectral.local_compliance`). Of finite elements it is
the change to polynomials over the plate, which are solved in a tenth of the time of elements as
accurate or less (`reference_mesh`).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.fem.mesh import Mesh
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.spectral_modes import SpectralModes
from model.spectral.mesh import PlateMesh, SpectralMesh
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.structure.point_load import PointLoad

_ACCURACY = 0.005  # of polynomials before their two further degrees


def reference_mesh(plate: Plate, *, frequency_max: float) -> Mesh:
    """Half as many elements again along both sides as an accurate mesh, in strips half as wide."""
    accurate = Mesh.accurate(plate, frequency_max=frequency_max)
    nx, ny = (math.ceil(1.5 * count) for count in (accurate.nx, accurate.ny))
    return replace(accurate, nx=nx, ny=ny, strip=accurate.strip / 2)


def finer_mesh(
    plate: Plate, mesh: PlateMesh, *, frequency_max: float, stiffness: float = 0.0
) -> PlateMesh:
    """The mesh whose response a mesh is compared with, accurate up to a frequency [Hz].

    Two further degrees of polynomials; for elements those of polynomials, or elements where there
    would be too many. stiffness [N/m]: of the stiffest ERA.
    """
    if isinstance(mesh, SpectralMesh):
        return mesh.finer()
    polynomials = SpectralMesh.accurate(
        plate, frequency_max=frequency_max, accuracy=_ACCURACY, stiffness=stiffness
    )
    if polynomials is None:
        return reference_mesh(plate, frequency_max=frequency_max)
    return polynomials.finer()


def estimate_error(
    free: FreePlate,
    finer: PlateMesh,
    eras: Sequence[Era],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[PointLoad] = (),
) -> FloatArray:
    """Estimated error of the acceleration over points (p, 2) [m], relative L2, (f, eras).

    finer: of `finer_mesh`; frequencies (f,) [Hz]. Each ERA is driven alone.
    """

    def response(of: FreePlate) -> ComplexArray:
        return of.acceleration(eras, frequencies, points, loads=loads)

    better = solve_free_plate(free.plate, finer, frequency_max=free.frequency_max)
    own, exact = response(free), response(better)
    error = np.linalg.norm(own - exact, axis=2)
    if isinstance(free.modes, SpectralModes):
        softer = response(replace(free, modes=free.modes.softer()))
        error += np.linalg.norm(own - softer, axis=2)
    return np.asarray(error / np.linalg.norm(exact, axis=2))
