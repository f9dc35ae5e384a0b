"""Mass, damping and stiffness matrices of the plate on its ERAs, in reduced coordinates.

M = I + sum m_b phi phi^T, K = diag(omega²) + sum k_b phi phi^T, C = C_s + sum c phi phi^T; phi are
the free plate's shapes at an ERA. Point masses add in the same way. A fingertip adds its contact
mass, and one coordinate, the displacement x [m] of its phalanx: m_p x'' + c_j x' + k_j x is the
force of the pulp, a spring and a damper between the plate and the phalanx.

Structural damping. The frequency domain uses a hysteretic stiffness (1 + i eta) diag(omega²),
which no causal equation in time has. C_s is its viscous equivalent: in the modes psi_j, omega_j of
the plate *on its ERAs*, C_s,jk = eta psi_j^T diag(omega²) psi_k / sqrt(omega_j omega_k), eta the
geometric mean of those at omega_j and omega_k where it varies with frequency, and what soft layers
and air lose added to eta omega². That is
positive semidefinite, and at every resonance of the supported plate it dissipates exactly the power
of the hysteretic one; a ratio eta/2 on the modes of the *free* plate would not, because the energy
in the springs has no loss. Contacts do not change it. The two differ off resonance: with eta = 1 %
the steady accelerations of the paper's plate differ by at most 0.5 % (relative L2 over the plate,
40 to 500 Hz), in proportion to eta; deep nulls move a little, they are not filled.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.structure.actuator import Era
from model.structure.fingertip import Fingertip, FingertipLoad
from model.structure.modal_elasticity import ModalElasticity, loss_factors
from model.structure.plate import Plate
from model.structure.point_load import PointLoad, footprints_of
from model.structure.support import check_supported


class Reduced(Protocol):
    """A free plate in few coordinates, its mass the identity and its stiffness diag(omega²).

    As `ReducedPlate`: omega (r,) [rad/s], losses (r,) [rad²/s²]; at(points) gives its shapes
    (p, r).
    """

    @property
    def plate(self) -> Plate:
        """The plate."""

    @property
    def omega(self) -> FloatArray:
        """Natural frequencies [rad/s], (r,)."""

    @property
    def losses(self) -> FloatArray:
        """Losses beside those of the plate's loss factor [rad²/s²], (r,)."""

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points (p, 2) or footprints (p, 3) [m], (p, r)."""


def modal_matrices(
    reduced: Reduced,
    eras: Sequence[Era],
    *,
    loads: Sequence[PointLoad] = (),
    contacts: Sequence[FingertipLoad] = (),
    attachment_shapes: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, C, K (r + n, r + n) of the plate on its ERAs with its loads under n fingertips.

    The last n coordinates are the phalanges', in the order of contacts. attachment_shapes: shapes
    at the ERAs, loads and contacts where known already. Raises InputError for ERAs that do not
    support the plate.
    """
    check_supported(reduced.plate, eras, loads=loads)
    fixed = [*(PointLoad.of_era(era) for era in eras), *loads]
    phi = (
        reduced.at(footprints_of(fixed, contacts))
        if attachment_shapes is None
        else attachment_shapes
    )
    elasticity = ModalElasticity.of(reduced.plate, reduced.omega**2, reduced.losses)
    elastic = np.diag(elasticity.eigenvalues)
    M, C, K = _contribution(phi[: len(fixed)], fixed)
    M += np.eye(len(elastic))
    K += elastic
    eigenvalues, psi = linalg.eigh(K, M)
    omega = np.sqrt(eigenvalues)
    lossy = (psi.T * elasticity.eigenvalues * elasticity.relative_loss) @ psi
    share = np.sqrt(loss_factors(reduced.plate, omega))
    lost = lossy * np.outer(share, share) + (psi.T * elasticity.losses) @ psi
    viscous = lost / np.sqrt(np.outer(omega, omega))
    mass_weighted_modes = M @ psi
    C += mass_weighted_modes @ viscous @ mass_weighted_modes.T
    return _under_fingertips((M, C, K), phi[len(fixed) :], [each.fingertip for each in contacts])


def _contribution(
    phi: FloatArray, loads: Sequence[PointLoad]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Contribution of loads with these shapes (n, r) to M, C and K."""
    mass = (phi.T * [load.mass for load in loads]) @ phi
    damping = (phi.T * [load.damping for load in loads]) @ phi
    return mass, damping, (phi.T * [load.stiffness for load in loads]) @ phi


def _under_fingertips(
    plate: tuple[FloatArray, FloatArray, FloatArray],
    phi: FloatArray,
    fingertips: Sequence[Fingertip],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, C, K (r + n, r + n) with n fingertips at points of shapes phi (n, r)."""
    n = len(fingertips)
    M, C, K = (np.pad(matrix, (0, n)) for matrix in plate)
    for phalanx, (shape, tip) in enumerate(zip(phi, fingertips, strict=True), start=len(phi.T)):
        contact = np.pad(shape, (0, n))
        pulp = contact.copy()
        pulp[phalanx] = -1.0  # its stretch is the displacement of the plate less the phalanx's
        M += tip.contact_mass * np.outer(contact, contact)
        C += tip.damping * np.outer(pulp, pulp)
        K += tip.stiffness * np.outer(pulp, pulp)
        M[phalanx, phalanx] += tip.phalanx_mass
        C[phalanx, phalanx] += tip.joint_damping
        K[phalanx, phalanx] += tip.joint_stiffness
    return M, C, K
