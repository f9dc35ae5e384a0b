"""Response of a plate on any mesh solved at each frequency, without modes: a reference.

Of polynomials it is `model.spectral.direct`; of finite elements one sparse factorisation for each
frequency.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy import sparse

from model.arrays import ComplexArray, FloatArray
from model.fem.mesh import Mesh
from model.fem.plate import PlateMatrices, assemble, factorise
from model.spectral.direct import Responder, direct_spectral_acceleration
from model.spectral.mesh import PlateMesh
from model.structure.attachments import (
    Era,
    Support,
    attached_stiffness,
    drive_forces,
    footprints_of,
)
from model.structure.modal_elasticity import loss_factors
from model.structure.plate import Plate


def direct_responder(plate: Plate, mesh: PlateMesh) -> Responder:
    """Direct solution of a plate on a mesh."""
    if isinstance(mesh, Mesh):
        return partial(direct_acceleration, assemble(plate, mesh))
    return partial(direct_spectral_acceleration, plate, mesh)


def direct_acceleration(
    matrices: PlateMatrices,
    eras: Sequence[Era],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[Support] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    Each ERA alone at full stroke and phase zero, the others at rest, on finite elements.
    """
    matrices.mesh.check_frequencies(matrices.plate, frequencies)
    touch = matrices.deflection_at(footprints_of(eras, loads))
    observe = matrices.deflection_at(points)
    result = np.empty((len(frequencies), len(eras), observe.shape[0]), dtype=complex)
    omegas = 2 * np.pi * np.asarray(frequencies, dtype=float)
    attached, forces = attached_stiffness(omegas, eras, loads), drive_forces(omegas, eras)
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
