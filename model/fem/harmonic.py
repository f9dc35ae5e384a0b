"""Complex steady-state response of the plate to its ERAs, one frequency at a time.

An ERA is a spring k_b and a damper c between the plate and a base that moves y exp(i omega t), with
a bolt of mass m_b on the plate. Its force on the plate is (k_b + i omega c) y minus its dynamic
stiffness k_b + i omega c - omega² m_b times the deflection (paper Eq. 21 and 25). The plate's own
damping is hysteretic: ((1 + i eta) K - omega² M) u = F.
"""

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from model.arrays import ComplexArray, FloatArray
from model.fem.assembly import PlateMatrices
from model.fem.factorisation import factorise
from model.fem.plate_mesh import check_frequencies
from model.structure.actuator import Era
from model.structure.dynamic_stiffness import attached_stiffness, drive_forces
from model.structure.modal_elasticity import check_of_theory, loss_factors
from model.structure.point_load import Load, footprints_of


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
