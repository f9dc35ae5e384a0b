"""Mass, damping and stiffness matrices of the plate on its ERAs, in reduced coordinates.

M = I + sum m_b phi phi^T, K = diag(omega²) + sum k_b phi phi^T, C = C_s + sum c phi phi^T; phi are
the free plate's shapes at an ERA. Point masses and fingers add to M, K and C in the same way.

Structural damping. The frequency domain uses a hysteretic stiffness (1 + i eta) diag(omega²),
which no causal equation in time has. C_s is its viscous equivalent: in the modes psi_j, omega_j of
the plate *on its ERAs*, C_s,jk = eta psi_j^T diag(omega²) psi_k / sqrt(omega_j omega_k). That is
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
from model.structure.plate import Plate
from model.structure.point_load import PointLoad, footprints_of
from model.structure.support import check_supported


class Reduced(Protocol):
    """A free plate in few coordinates, its mass the identity and its stiffness diag(omega²).

    As `ReducedPlate`: omega (r,) [rad/s]; at(points) gives its shapes (p, r).
    """

    @property
    def plate(self) -> Plate:
        """The plate."""

    @property
    def omega(self) -> FloatArray:
        """Natural frequencies [rad/s], (r,)."""

    def at(self, points: FloatArray) -> FloatArray:
        """Shapes at points (p, 2) or footprints (p, 3) [m], (p, r)."""


def modal_matrices(
    reduced: Reduced,
    eras: Sequence[Era],
    *,
    loads: Sequence[PointLoad] = (),
    contacts: Sequence[PointLoad] = (),
    attachment_shapes: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, C, K (r, r) of the plate on its ERAs, with what it carries and the fingers in contact.

    attachment_shapes: shapes at the ERAs, loads and contacts (n, r) where known already. Raises
    InputError for ERAs that do not support the plate.
    """
    check_supported(reduced.plate, eras, loads=loads)
    fixed = [*(PointLoad.of_era(era) for era in eras), *loads]
    phi = (
        reduced.at(footprints_of([*fixed, *contacts]))
        if attachment_shapes is None
        else attachment_shapes
    )
    elastic = np.diag(reduced.omega**2)
    M, C, K = _contribution(phi[: len(fixed)], fixed)
    M += np.eye(len(elastic))
    K += elastic
    eigenvalues, psi = linalg.eigh(K, M)
    omega = np.sqrt(eigenvalues)
    viscous = reduced.plate.loss_factor * (psi.T @ elastic @ psi) / np.sqrt(np.outer(omega, omega))
    mass_weighted_modes = M @ psi
    C += mass_weighted_modes @ viscous @ mass_weighted_modes.T
    contribution = _contribution(phi[len(fixed) :], contacts)
    return M + contribution[0], C + contribution[1], K + contribution[2]


def _contribution(
    phi: FloatArray, loads: Sequence[PointLoad]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Contribution of loads with these shapes (n, r) to M, C and K."""
    mass = (phi.T * [load.mass for load in loads]) @ phi
    damping = (phi.T * [load.damping for load in loads]) @ phi
    return mass, damping, (phi.T * [load.stiffness for load in loads]) @ phi
