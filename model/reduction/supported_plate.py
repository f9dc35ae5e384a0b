"""Equations of motion of the reduced plate on its ERAs, and its modes there.

    M x'' + C x' + K x = forces,    x = (q, far ends of sources, phalanges)

with the coordinates q of the reduced plate (`model.reduction.reduced_plate`) and its shapes phi at
each attachment:

    M = I + sum m_b phi phi',    K = diag(omega²) + sum k_b phi phi',    C = C_s + sum c phi phi'

Point masses add in the same way. A fingertip adds its contact mass, and one coordinate, the
displacement of its phalanx: the pulp is a spring and a damper between the plate and the phalanx,
which has a mass on a joint. An exciter with a free magnet adds the magnet's displacement, too.

Structural damping. The frequency domain uses a hysteretic stiffness (1 + i eta) diag(omega²), which
no causal equation in time has. C_s is its viscous equivalent: in the modes psi_j, omega_j of the
plate *on its ERAs*,

    C_s,jk = psi_j' (eta diag(omega²) + losses) psi_k / sqrt(omega_j omega_k),

where eta is the geometric mean of its values at omega_j and omega_k if it varies with frequency,
and losses belong to soft layers, air, and support springs with a loss factor. C_s is
positive semidefinite, and at every resonance of the supported plate it dissipates exactly the power
of the hysteretic plate; a damping ratio of eta/2 in the modes of the *free* plate would not,
because the energy in the springs has no loss. Contacts do not change C_s. Both plates differ off
resonance: with eta = 1 % the steady accelerations of the paper's plate differ by at most 0.5 %
(relative L2 over the plate, 40 to 500 Hz), in proportion to eta.

Damping ratios. The damping ratio of a mode psi with modal mass 1 is psi' C psi / (2 omega). It
includes the plate's losses and the ERAs' dampers, but neglects the coupling of modes by dampers,
which the time domain includes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.errors import InputError, shown
from model.files.csv_file import as_frame
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import InTime, PointLoad, footprints_of
from model.structure.fingertips import Fingertip, FingertipLoad
from model.structure.modal_elasticity import loss_factors
from model.structure.sources import Source
from model.structure.statics import check_supported


class MotionMatrices(NamedTuple):
    """Matrices of the equations of motion, (n, n) each."""

    M: FloatArray
    C: FloatArray
    K: FloatArray


class _SupportedPlate(NamedTuple):
    """The plate on its ERAs and loads, without fingertips, and its undamped modes."""

    matrices: MotionMatrices
    omega: FloatArray
    """Natural frequencies (n,) [rad/s], ascending."""
    psi: FloatArray
    """Modes (n, n), a column each, with modal mass 1."""


def modal_matrices(
    reduced: ReducedPlate,
    eras: Sequence[Source],
    *,
    loads: Sequence[PointLoad] = (),
    contacts: Sequence[FingertipLoad] = (),
    attachment_shapes: FloatArray | None = None,
) -> MotionMatrices:
    """Return M, C, K (r + m + n, ...) of the plate on its ERAs with its loads and n fingertips.

    The coordinates belong to the plate, then to m far ends of the sources, then to the phalanges in
    the order of contacts. attachment_shapes: shapes at the ERAs, loads and contacts, if already
    known. Raises InputError for ERAs and loads that do not support the plate.
    """
    check_supported(reduced.plate, eras, loads=loads)
    phi = attachment_shapes
    if phi is None:
        phi = reduced.at(footprints_of(eras, loads, contacts))
    fixed = len(eras) + len(loads)
    supported = _on_supports(reduced, eras, loads, phi[:fixed])
    fingertips = [contact.fingertip for contact in contacts]
    return _under_fingertips(supported.matrices, phi[fixed:], fingertips)


def _on_supports(
    reduced: ReducedPlate,
    eras: Sequence[Source],
    loads: Sequence[PointLoad],
    phi: FloatArray,
) -> _SupportedPlate:
    """Set up the equations and solve for the undamped modes; phi (n, r): at ERAs, then loads."""
    parts = [era.in_time for era in eras] + [load.in_time for load in loads]
    M, C, K = on_springs(reduced, parts, phi)
    eigenvalues, psi = linalg.eigh(K, M)
    omega = np.sqrt(eigenvalues)
    lossy_springs = [0.0] * len(eras) + [load.loss_factor * load.stiffness for load in loads]
    viscous = _viscous_equivalent(reduced, omega, psi[: len(reduced.omega)], phi, lossy_springs)
    mass_weighted_modes = M @ psi
    C += mass_weighted_modes @ viscous @ mass_weighted_modes.T
    return _SupportedPlate(MotionMatrices(M, C, K), omega, psi)


def _viscous_equivalent(
    reduced: ReducedPlate,
    omega: FloatArray,
    psi: FloatArray,
    phi: FloatArray,
    lossy_springs: Sequence[float],
) -> FloatArray:
    """Return C_s in the modes of the supported plate, (n, n).

    omega (n,), psi (r, n): its modes in the coordinates of the plate; phi (a, r): shapes at
    supports; lossy_springs (a,): loss factor times stiffness of each [N/m].
    """
    elasticity = reduced.elasticity
    hysteretic = (psi.T * elasticity.eigenvalues * elasticity.relative_loss) @ psi
    root_eta = np.sqrt(loss_factors(reduced.plate, omega))
    in_plate = hysteretic * np.outer(root_eta, root_eta)
    in_layers = (psi.T * elasticity.losses) @ psi
    at_supports = phi @ psi
    in_springs = (at_supports.T * lossy_springs) @ at_supports
    return np.asarray((in_plate + in_layers + in_springs) / np.sqrt(np.outer(omega, omega)))


def on_springs(reduced: ReducedPlate, parts: Sequence[InTime], phi: FloatArray) -> MotionMatrices:
    """Return M, C, K (r + m, r + m) of the plate with n parts of shapes phi (n, r).

    The last m coordinates belong to far ends that have a mass. C includes only the parts.
    """
    r = len(reduced.omega)
    stretch = stretches(parts, phi)
    plate_motion = stretch.copy()
    plate_motion[:, r:] = 0.0  # a part's mass moves with the plate alone
    mass = _weighted_square(plate_motion, [part.mass for part in parts])
    inertance = _weighted_square(stretch, [part.inertance for part in parts])
    damping = _weighted_square(stretch, [part.damping for part in parts])
    stiffness = _weighted_square(stretch, [part.stiffness for part in parts])
    far_masses = [part.far_mass for part in parts if part.far_mass is not None]
    M = mass + inertance + np.diag([*np.ones(r), *far_masses])
    K = stiffness + np.diag(np.pad(reduced.elasticity.eigenvalues, (0, len(far_masses))))
    return MotionMatrices(M, damping, K)


def _weighted_square(shapes: FloatArray, weights: Sequence[float]) -> FloatArray:
    """Return the sum over n parts of a weight times phi phi^T, for shapes (n, r)."""
    return np.asarray((shapes.T * np.array(weights)) @ shapes)


def stretches(parts: Sequence[InTime], phi: FloatArray) -> FloatArray:
    """Return the stretch of n parts with shapes phi (n, r) per coordinate, (n, r + m).

    The plate's displacement minus the far end's, if that has a mass.
    """
    with_far_mass = [number for number, part in enumerate(parts) if part.far_mass is not None]
    far_count = len(with_far_mass)
    stretch = np.pad(phi, ((0, 0), (0, far_count)))
    stretch[with_far_mass, phi.shape[1] + np.arange(far_count)] = -1.0
    return stretch


def _under_fingertips(
    plate: MotionMatrices, phi: FloatArray, fingertips: Sequence[Fingertip]
) -> MotionMatrices:
    """Add n fingertips at points of shapes phi (n, r), each with a coordinate of its phalanx."""
    plate_size = len(plate.M)
    M, C, K = (np.pad(matrix, (0, len(fingertips))) for matrix in plate)
    for phalanx, (shape, tip) in enumerate(zip(phi, fingertips, strict=True), start=plate_size):
        contact = np.pad(shape, (0, len(M) - len(shape)))
        pulp = contact.copy()
        pulp[phalanx] = -1.0  # its stretch is the displacement of the plate minus the phalanx's
        M += tip.contact_mass * np.outer(contact, contact)
        C += tip.damping * np.outer(pulp, pulp)
        K += tip.stiffness * np.outer(pulp, pulp)
        M[phalanx, phalanx] += tip.phalanx_mass
        C[phalanx, phalanx] += tip.joint_damping
        K[phalanx, phalanx] += tip.joint_stiffness
    return MotionMatrices(M, C, K)


@dataclass(frozen=True, eq=False)
class SupportedModes:
    """Natural frequencies (n,) [Hz], ascending, and damping ratios (n,); `at` returns mode shapes.

    coordinates (r, n): the modes in the coordinates of the plate `reduced`.
    """

    natural_frequencies: FloatArray
    damping_ratios: FloatArray
    reduced: ReducedPlate
    coordinates: FloatArray

    def __repr__(self) -> str:
        frequencies = ", ".join(f"{frequency:.1f}" for frequency in self.natural_frequencies)
        return f"<SupportedModes at {frequencies} Hz>"

    def to_frame(self) -> Any:
        """Frequency and damping ratio as a pandas DataFrame, a row a mode; needs pandas."""
        return as_frame(
            {"frequency_hz": self.natural_frequencies, "damping_ratio": self.damping_ratios}
        )

    def at(self, points: FloatArray) -> FloatArray:
        """Return mode shapes (p, n) at points (p, 2) [m], scaled to modal mass 1 [1/sqrt(kg)].

        Raises InputError for points off the plate, and invalid points.
        """
        try:
            positions = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            positions = np.empty(0)
        if positions.shape[-1:] != (2,) or positions.ndim > 2:
            raise InputError(
                f"points must be positions on the plate, got {shown(points)}; give x, y in meters, "
                "as in [[0.1, 0.08]]"
            )
        return self.reduced.at(positions) @ self.coordinates


def supported_modes(
    reduced: ReducedPlate,
    eras: Sequence[Source],
    *,
    loads: Sequence[PointLoad] = (),
    frequency_max: float,
) -> SupportedModes:
    """Return all modes up to a frequency [Hz], to which the plate must have been reduced.

    Raises InputError for ERAs that do not hold the plate.
    """
    check_supported(reduced.plate, eras, loads=loads)
    supported = _on_supports(reduced, eras, loads, reduced.at(footprints_of(eras, loads)))
    is_low = supported.omega <= 2 * np.pi * frequency_max
    omega = supported.omega[is_low]
    psi = supported.psi[:, is_low]
    modal_damping = np.einsum("rn,rs,sn->n", psi, supported.matrices.C, psi)
    return SupportedModes(
        natural_frequencies=omega / (2 * np.pi),
        damping_ratios=modal_damping / (2 * omega),
        reduced=reduced,
        coordinates=psi[: len(reduced.omega)],
    )
