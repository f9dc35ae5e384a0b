"""Response of a plate on any mesh solved at each frequency, without modes: a reference.

Of polynomials it is `model.spectral.direct_solution`; of finite elements one sparse factorization
for each frequency. What ERAs and loads do to the plate is computed here: from the motion of an
ERA's base the force (k_b + i omega c) y of the founding paper's Eq. 25, and the dynamic stiffness
of each; of an exciter by the equations of its magnet and of its current, solved beside each other.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy import sparse

from model.arrays import ComplexArray, FloatArray
from model.fem import Mesh, PlateMatrices, assemble, factorize
from model.spectral.direct_solution import Responder, direct_spectral_acceleration
from model.spectral.plate_mesh import PlateMesh, SpectralMesh
from model.structure.attachments import PointLoad, footprints_of
from model.structure.exciter import Actuator, Exciter
from model.structure.fingertips import FingertipLoad
from model.structure.modal_elasticity import loss_factors
from model.structure.plate import Plate
from model.structure.sources import Era


def direct_responder(plate: Plate, mesh: PlateMesh) -> Responder:
    """Direct solution of a plate on a mesh."""
    if isinstance(mesh, Mesh):
        return partial(direct_acceleration, assemble(plate, mesh))
    assert isinstance(mesh, SpectralMesh)  # a surface has no other solution
    return partial(direct_spectral_acceleration, plate, mesh)


def direct_acceleration(
    matrices: PlateMatrices,
    eras: Sequence[Actuator],
    frequencies: FloatArray,
    points: FloatArray,
    *,
    loads: Sequence[PointLoad | FingertipLoad] = (),
) -> ComplexArray:
    """Acceleration [m/s²] at points (p, 2) per frequency [Hz] (f,) and driven ERA: (f, eras, p).

    Each ERA alone at full level and phase zero, the others at rest, on finite elements.
    """
    matrices.mesh.check_frequencies(matrices.plate, frequencies)
    touch = matrices.deflection_at(footprints_of(eras, loads))
    observe = matrices.deflection_at(points)
    result = np.empty((len(frequencies), len(eras), observe.shape[0]), dtype=complex)
    omegas = 2 * np.pi * np.asarray(frequencies, dtype=float)
    losses = loss_factors(matrices.plate, omegas)
    for row, (omega, loss) in enumerate(zip(omegas, losses, strict=True)):
        attached = [_dynamic_stiffness(each, omega) for each in (*eras, *loads)]
        dynamic_stiffness = (
            (1 + 1j * loss) * matrices.stiffness
            - omega**2 * matrices.mass
            + touch.T @ sparse.diags_array(attached) @ touch
        )
        load = touch[: len(eras)].T @ sparse.diags_array([_force(era, omega) for era in eras])
        displacement = factorize(dynamic_stiffness).solve(load.toarray())
        result[row] = -(omega**2) * (observe @ displacement).T
    return result


def _force(era: Actuator, omega: float) -> complex:
    """Force [N] on a plate that is held, driven at full level, at omega [rad/s]."""
    drive = complex(era.full_level)
    if era.gains:
        frequencies, sizes, phases = np.transpose(era.gains)
        drive *= np.interp(omega / (2 * np.pi), frequencies, sizes * np.exp(1j * phases))
    if isinstance(era, Exciter):
        return _on_plate(era, omega, moved=0.0, voltage=drive)
    return (era.stiffness + 1j * omega * era.damping) * drive


def _on_plate(exciter: Exciter, omega: float, *, moved: float, voltage: complex) -> complex:
    """Force of an exciter on the plate [N], which moves by so much [m], at a voltage [V].

    Unknown are the magnet's displacement x and the current: the magnet's equation, x = 0 for one
    that is held, and that of the circuit.
    """
    s, bl = 1j * omega, exciter.force_factor
    spring = exciter.stiffness + s * exciter.damping
    coil = exciter.resistance + exciter.source_resistance + s * exciter.inductance
    magnet = [1, 0] if exciter.held else [s**2 * exciter.magnet_mass + spring, bl]
    of_plate = 0 if exciter.held else spring * moved
    system = np.array([magnet, [-s * bl, coil]], dtype=complex)
    x, current = np.linalg.solve(system, [of_plate, voltage - s * bl * moved])
    return complex(bl * current - spring * (moved - x) - s**2 * exciter.coil_mass * moved)


def _dynamic_stiffness(each: Actuator | PointLoad | FingertipLoad, omega: float) -> complex:
    """Force on what is attached by the plate's displacement there [N/m] at omega [rad/s]."""
    if isinstance(each, Exciter):
        return -_on_plate(each, omega, moved=1.0, voltage=0.0)
    if isinstance(each, FingertipLoad):
        tip = each.fingertip
        pulp = tip.stiffness + 1j * omega * tip.damping
        bone = tip.joint_stiffness + 1j * omega * tip.joint_damping - omega**2 * tip.phalanx_mass
        return pulp * bone / (pulp + bone) - omega**2 * tip.contact_mass
    if isinstance(each, Era):
        mass, loss = each.bolt_mass, 0.0
    else:
        mass, loss = each.mass, each.loss_factor
    return each.stiffness * (1 + 1j * loss) + 1j * omega * each.damping - omega**2 * mass
