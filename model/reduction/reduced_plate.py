"""The plate in a few dozen coordinates, for its solution in time.

Modes of the free plate, and for every attachment three residual vectors, orthogonal to them: the
response of the truncated modes to a force there, and its growth with omega. Without these the modes
converge slowly near a point force. If an attachment is added or removed while the plate vibrates,
the plate is reduced again and its motion is projected.

On its ERAs, its mass, damping and stiffness matrices are

M = I + sum m_b phi phi^T, K = diag(omega²) + sum k_b phi phi^T, C = C_s + sum c phi phi^T; phi are
the free plate's shapes at an ERA. Point masses add in the same way. A fingertip adds its contact
mass, and one coordinate, the displacement x [m] of its phalanx: m_p x'' + c_j x' + k_j x is the
force of the pulp, a spring and a damper between the plate and the phalanx. So does an exciter whose
magnet is free: its spring and damper end at a mass.

Structural damping. The frequency domain uses a hysteretic stiffness (1 + i eta) diag(omega²), which
no causal equation in time has. C_s is its viscous equivalent: in the modes psi_j, omega_j of the
plate *on its ERAs*, C_s,jk = eta psi_j^T diag(omega²) psi_k / sqrt(omega_j omega_k), with eta the
geometric mean of its values at omega_j and omega_k if it varies with frequency. Losses of soft
layers, of air and of support springs with a loss factor are added to eta omega². C_s is positive
semidefinite, and at every resonance of the supported plate it dissipates exactly the power of the
hysteretic one; a ratio eta/2 on the modes of the *free* plate would not, because the energy in the
springs has no loss. Contacts do not change it. The two differ off resonance: with eta = 1 % the
steady accelerations of the paper's plate differ by at most 0.5 % (relative L2 over the plate, 40 to
500 Hz), in proportion to eta; deep nulls move a little, they are not filled.

Its modes on its ERAs are the undamped plate's. The damping ratio of such a mode, psi' C psi / (2
omega) at modal mass 1, includes the plate's own losses and the ERAs' dampers. The coupling of modes
by dampers is neglected here, but not in the time domain.

Slopes of fields with respect to position (`place_slopes`) are second-order differences, one-sided
at edges. Closed forms would be simple for polynomials, but a footprint that an edge cuts adds
integrals along that edge, and the compliance of unresolved waves is fitted, with limits beside
edges. Over this step differences are right to 1e-6 of the largest, and the rounding of another
processor changes them by 3e-8.

A plate with form errors, which a rig file does not describe, is the same coordinates with other
stiffness and mass between them (`ReducedModes`): an estimate fits both to measured responses.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from scipy import linalg

from model.arrays import FloatArray, IntArray
from model.errors import InputError, shown
from model.fem import Mesh, element_slopes
from model.files.csv_file import as_frame
from model.reduction.free_plate import TERMS, FreeModes, FreePlate, solve_free_plate
from model.spectral.direct_solution import stiffness_slopes
from model.spectral.modes import PlateMesh
from model.structure.attachments import (
    Fingertip,
    FingertipLoad,
    InTime,
    PointLoad,
    Source,
    as_footprints,
    check_supported,
    footprints_of,
)
from model.structure.modal_elasticity import (
    Dispersion,
    ModalElasticity,
    check_is_plate,
    loss_factors,
)
from model.structure.plate import Plate

RESIDUAL_VECTORS = 3  # for each attachment

# Residual vectors below this share of their squared norm are linear combinations of the others.
_DEPENDENT = 1e-9
_LEAST_SHIFTED = 0.99


@dataclass(frozen=True, eq=False)
class ReductionBasis:
    """Source of a reduction: the solved free plate and the footprints (n, 3) [m].

    residual_transform (RESIDUAL_VECTORS n, s): from the residual vectors of the points to the
    coordinates.
    """

    free: FreePlate
    points: FloatArray
    residual_transform: FloatArray


@dataclass(frozen=True, eq=False)
class ReducedPlate:
    """The free plate in coordinates with M = I and K = diag(omega²).

    omega: (r,) [rad/s], 0 for rigid-body modes, residual vectors last; losses: (r,) [rad²/s²] in
    addition to the plate's loss factor; at: shapes at points (p, 2) or footprints (p, 3) [m], (p,
    r) [1/sqrt(kg)]; origin: None if only the coordinates are known; dispersion: change of omega²
    with frequency, None without any.
    """

    plate: Plate
    omega: FloatArray
    losses: FloatArray
    at: Callable[[FloatArray], FloatArray]
    origin: ReductionBasis | None = None
    dispersion: Dispersion | None = None

    def with_attachments_at(self, points: FloatArray) -> "ReducedPlate":
        """Reduce the same plate for further points of attachment [m] (n, 2).

        Returns itself where its origin is not known: its shapes are then all there is.
        """
        if self.origin is None or not len(points):
            return self
        together = np.vstack([self.origin.points, as_footprints(points)])
        return reduce_free_plate(self.origin.free, together)

    def unknowns(self) -> tuple[FloatArray, ...]:
        """Its coordinates (r,) in the unknowns of the free plate, by symmetry class, (n, r)."""
        if self.origin is None:
            raise ValueError("only the coordinates of the plate are known")
        modes = self.origin.free.modes
        transform = self.origin.residual_transform
        mode_count = len(modes.eigenvalues)
        residual_end = mode_count + len(transform)
        coordinates = list[FloatArray]()
        for columns in modes.unknowns(self.origin.points):
            residuals = columns[:, mode_count:residual_end] @ transform
            coordinates.append(np.hstack([columns[:, :mode_count], residuals]))
        return tuple(coordinates)

    def projection_from(self, other: "ReducedPlate") -> FloatArray:
        """M-orthogonal projection of another reduction's coordinates onto its own, (r, other's r).

        Exact if it has all points of the other. Both must come from the same free plate. If only
        the coordinates of both are known, they are the same ones.
        """
        if self.origin is None and other.origin is None:
            return np.eye(len(self.omega))
        if self.origin is None or other.origin is None:
            raise ValueError("only the coordinates of one of the plates are known")
        modes = len(self.origin.free.modes.eigenvalues)
        projection = np.zeros((len(self.omega), len(other.omega)))
        projection[:modes, :modes] = np.eye(modes)
        terms = self.origin.free.modes.truncated_terms(self.origin.points, other.origin.points)
        mass = _products(terms, power=1)
        projection[modes:, modes:] = (
            self.origin.residual_transform.T @ mass @ other.origin.residual_transform
        )
        return projection


def reduce_plate(
    plate: Plate, mesh: PlateMesh, attachments: FloatArray, *, frequency_max: float = 500.0
) -> ReducedPlate:
    """Solve and reduce a plate for forces at the attachments [m] (n, 2).

    frequency_max [Hz]: upper limit of the response.
    """
    return reduce_free_plate(
        solve_free_plate(plate, mesh, frequency_max=frequency_max), attachments
    )


def reduce_free_plate(free: FreePlate, attachments: FloatArray) -> ReducedPlate:
    """Reduce a solved free plate for forces at the attachments [m] (n, 2)."""
    attached = as_footprints(attachments)
    modes = len(free.modes.eigenvalues)
    truncated_terms = free.modes.truncated_terms(attached, attached)
    mass = _products(truncated_terms, power=1)
    shifted = _products(truncated_terms, power=0)

    # Orthonormal combinations of the residual vectors, then the eigenvectors among these.
    scale = 1 / np.sqrt(np.diagonal(mass))
    scaled_mass = mass * np.outer(scale, scale)
    squared_norms, vectors = linalg.eigh(scaled_mass)
    independent = squared_norms > _DEPENDENT * squared_norms.max(initial=0.0)
    orthonormal = scale[:, None] * vectors[:, independent] / np.sqrt(squared_norms[independent])
    shifted_eigenvalues, rotation = linalg.eigh(orthonormal.T @ shifted @ orthonormal)
    # At least 1, the lowest truncated mode's; the local compliance between many near points, which
    # is an approximation, leaves a few below zero that yield next to nothing.
    physical = shifted_eigenvalues > _LEAST_SHIFTED
    omega = np.sqrt(shifted_eigenvalues[physical] / free.modes.largest_truncated - free.shift)
    residual_transform = orthonormal @ rotation[:, physical]

    def shapes(points: FloatArray) -> FloatArray:
        places = np.atleast_2d(np.asarray(points, dtype=float))
        basis = free.modes.basis(attached, places)
        residuals = basis[:, modes : modes + len(mass)] @ residual_transform
        return np.hstack([basis[:, :modes], residuals])

    dispersion = free.modes.dispersion
    return ReducedPlate(
        plate=free.plate,
        omega=np.concatenate([np.sqrt(free.modes.eigenvalues), omega]),
        losses=np.concatenate([free.modes.losses, np.zeros(len(omega))]),
        at=shapes,
        origin=ReductionBasis(free, attached, residual_transform),
        dispersion=None if dispersion is None else dispersion.padded(len(omega)),
    )


def _products(truncated_terms: FloatArray, *, power: int) -> FloatArray:
    """Products of residual vectors a and b with M (power 1) or K + shift M (power 0).

    Sums over the truncated modes of phi phi u^(a + b + power), (n, m) for each pair of vectors:
    (RESIDUAL_VECTORS n, RESIDUAL_VECTORS m).
    """
    a = np.arange(RESIDUAL_VECTORS)
    products = truncated_terms[np.add.outer(a, a) + power].transpose(0, 2, 1, 3)
    rows, columns = truncated_terms.shape[1:]
    return np.asarray(products.reshape(RESIDUAL_VECTORS * rows, RESIDUAL_VECTORS * columns))


def modal_matrices(
    reduced: ReducedPlate,
    eras: Sequence[Source],
    *,
    loads: Sequence[PointLoad] = (),
    contacts: Sequence[FingertipLoad] = (),
    attachment_shapes: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return M, C, K (r + m + n, ...) of the plate on its ERAs with its loads and n fingertips.

    The plate's coordinates are followed by those of m far ends of the sources, and of the phalanges
    in the order of contacts. attachment_shapes: shapes at the ERAs, loads and contacts, if already
    known. Raises InputError for ERAs and loads that do not support the plate.
    """
    check_supported(reduced.plate, eras, loads=loads)
    phi = attachment_shapes
    if phi is None:
        phi = reduced.at(footprints_of(eras, loads, contacts))
    fixed = len(eras) + len(loads)
    parts = [era.in_time for era in eras]
    parts += [load.in_time for load in loads]
    elasticity, (M, C, K) = on_springs(reduced, parts, phi[:fixed])
    eigenvalues, psi = linalg.eigh(K, M)
    omega = np.sqrt(eigenvalues)
    plate_psi = psi[: len(reduced.omega)]
    hysteretic = (plate_psi.T * elasticity.eigenvalues * elasticity.relative_loss) @ plate_psi
    root_eta = np.sqrt(loss_factors(reduced.plate, omega))
    in_plate = hysteretic * np.outer(root_eta, root_eta)
    in_layers = (plate_psi.T * elasticity.losses) @ plate_psi
    at_fixed = phi[:fixed] @ plate_psi
    lossy_springs = [0.0] * len(eras) + [load.loss_factor * load.stiffness for load in loads]
    in_springs = (at_fixed.T * lossy_springs) @ at_fixed
    viscous = (in_plate + in_layers + in_springs) / np.sqrt(np.outer(omega, omega))
    mass_weighted_modes = M @ psi
    C += mass_weighted_modes @ viscous @ mass_weighted_modes.T
    fingertips = [contact.fingertip for contact in contacts]
    return _under_fingertips((M, C, K), phi[fixed:], fingertips)


def on_springs(
    reduced: ReducedPlate, parts: Sequence[InTime], phi: FloatArray
) -> tuple[ModalElasticity, tuple[FloatArray, FloatArray, FloatArray]]:
    """Return elasticity of the free plate, and M, C, K (r + m, r + m) with n parts of shapes phi
    (n, r).

    The last m coordinates belong to far ends that have a mass. C includes only the parts.
    """
    elasticity = ModalElasticity.of(reduced.plate, reduced.omega**2, reduced.losses)
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
    K = stiffness + np.diag(np.pad(elasticity.eigenvalues, (0, len(far_masses))))
    return elasticity, (M, damping, K)


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
    plate: tuple[FloatArray, FloatArray, FloatArray],
    phi: FloatArray,
    fingertips: Sequence[Fingertip],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M, C, K with n more coordinates for n fingertips at points of shapes phi (n, r)."""
    plate_size = len(plate[0])
    M, C, K = (np.pad(matrix, (0, len(fingertips))) for matrix in plate)
    for phalanx, (shape, tip) in enumerate(zip(phi, fingertips, strict=True), start=plate_size):
        contact = np.pad(shape, (0, len(M) - len(shape)))
        pulp = contact.copy()
        pulp[phalanx] = -1.0  # its stretch is the displacement of the plate less the phalanx's
        M += tip.contact_mass * np.outer(contact, contact)
        C += tip.damping * np.outer(pulp, pulp)
        K += tip.stiffness * np.outer(pulp, pulp)
        M[phalanx, phalanx] += tip.phalanx_mass
        C[phalanx, phalanx] += tip.joint_damping
        K[phalanx, phalanx] += tip.joint_stiffness
    return M, C, K


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
        named = ", ".join(f"{frequency:.1f}" for frequency in self.natural_frequencies)
        return f"<SupportedModes at {named} Hz>"

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
            places = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            places = np.empty(0)
        if places.shape[-1:] != (2,) or places.ndim > 2:
            raise InputError(
                f"points must be positions on the plate, got {shown(points)}; give x, y in meters, "
                "as in [[0.1, 0.08]]"
            )
        return self.reduced.at(places) @ self.coordinates


def supported_modes(
    reduced: ReducedPlate,
    eras: Sequence[Source],
    *,
    loads: Sequence[PointLoad] = (),
    frequency_max: float,
) -> SupportedModes:
    """Solve all modes up to a frequency [Hz], to which the plate must have been reduced.

    Raises InputError for ERAs that do not hold the plate.
    """
    M, C, K = modal_matrices(reduced, eras, loads=loads)
    eigenvalues, vectors = linalg.eigh(K, M)
    is_low = np.sqrt(eigenvalues) <= 2 * np.pi * frequency_max
    omega = np.sqrt(eigenvalues)[is_low]
    psi = vectors[:, is_low]
    return SupportedModes(
        natural_frequencies=omega / (2 * np.pi),
        damping_ratios=np.einsum("rn,rs,sn->n", psi, C, psi) / (2 * omega),
        reduced=reduced,
        coordinates=psi[: len(reduced.omega)],
    )


_STEP = 1e-5  # of a side


def place_slopes(
    field: Callable[[FloatArray], FloatArray], places: FloatArray, sides: FloatArray
) -> FloatArray:
    """Derivatives [1/m] of a field by x and y of points or footprints (n, 2 or 3), (n, 2, ...).

    field: from places (m, 2 or 3) to (m, ...); sides (2,): of the plate.
    """
    positions = places[:, :2]
    step = _STEP * sides
    is_inner = np.minimum(positions, sides - positions) >= step
    inwards = np.where(positions > sides / 2, -1.0, 1.0)
    # Offsets of two neighboring points in steps, and the weights of the point itself and of these
    # two, (n, 2) each.
    first = np.where(is_inner, 1.0, inwards)
    second = np.where(is_inner, -1.0, 2 * inwards)
    weight = np.where(is_inner, 0.0, -1.5 * inwards)
    first_weight = np.where(is_inner, 0.5, 2 * inwards)
    second_weight = np.where(is_inner, -0.5, -0.5 * inwards)
    moved = np.repeat(places[:, None], 4, axis=1)  # along x, along y, then further
    for number, offsets in enumerate((first, second)):
        for axis in range(2):
            moved[:, 2 * number + axis, axis] += offsets[:, axis] * step[axis]
    points = np.concatenate([places[:, None], moved], axis=1)
    values = field(points.reshape(-1, places.shape[1]))
    values = values.reshape(len(places), 5, *values.shape[1:])
    weights = np.array([weight, first_weight, second_weight]) / step  # (3, n, 2)
    other_axes = [1] * (values.ndim - 2)
    by_weight = values[:, [[0, 0], [1, 2], [3, 4]]].swapaxes(0, 1)  # (3, n, 2, ...)
    return np.asarray((weights.reshape(*weights.shape, *other_axes) * by_weight).sum(axis=0))


@dataclass(frozen=True, eq=False)
class ReducedModes:
    """Modes and residual vectors at all attachments of a plate, in which it can have form errors.

    No further modes count as truncated.
    """

    eigenvalues: FloatArray
    """omega² (r,) [rad²/s²]."""
    losses: FloatArray
    """Their imaginary part in addition to the plate's loss factor (r,)."""
    dispersion: Dispersion | None
    """Their change with frequency, None without any."""
    shapes_at: Callable[[FloatArray], FloatArray]
    """Shapes at points or footprints [m], (n, r)."""
    cells: FloatArray
    """Shapes where foreign mass may lie (c, r)."""
    stiffening: FloatArray
    """Derivatives (3, r, r) [rad²/s²] of the stiffness between coordinates by length, width
    (relative) and Poisson's ratio."""

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums over truncated modes: zero, (TERMS, n, m)."""
        return np.zeros((TERMS, len(points), len(others)))


def reduced_modes(free: FreePlate, footprints: FloatArray, cells: FloatArray) -> ReducedModes:
    """Reduce a free plate to coordinates in which it may have form errors.

    footprints (n, 3) [m]: of its supports; cells (c, 2) [m]: where foreign mass may lie.
    """
    check_is_plate(free.plate, "form errors")
    plate, reduced = free.plate, reduce_free_plate(free, footprints)
    unknowns = reduced.unknowns()
    if isinstance(free.mesh, Mesh):
        stiffening = element_slopes(plate, free.mesh, unknowns[0])
    else:
        degrees = free.mesh.nx, free.mesh.ny
        frequency = math.sqrt(plate.lowest_bending_frequency * free.frequency_max)
        stiffening = stiffness_slopes(plate, degrees, unknowns, frequency=frequency)
    return ReducedModes(
        eigenvalues=np.asarray(reduced.omega**2),
        losses=reduced.losses,
        dispersion=reduced.dispersion,
        shapes_at=reduced.at,
        cells=reduced.at(cells),
        stiffening=stiffening,
    )


Modes: TypeAlias = FreeModes | ReducedModes


@dataclass(frozen=True, eq=False)
class AttachmentPoints:
    """Shapes at `a` points of attachment and observation, v of them movable along x and y."""

    footprints: FloatArray
    """Place and radius of each (a, 3) [m]."""
    shapes: FloatArray
    """Mode shapes (a, r)."""
    truncated: FloatArray
    """Sums over truncated modes (TERMS, a, a)."""
    shape_slopes: FloatArray
    """Derivatives of the shapes by x and y of each movable point in turn (2 v, r) [1/m]."""
    truncated_slopes: FloatArray
    """Derivatives of the sums by the place of the first point (TERMS, 2 v, a) [1/m]."""

    def moved(self, footprints: FloatArray, movable: IntArray) -> "AttachmentPoints":
        """The same for other footprints (a, 3), by the slopes of the shapes alone."""
        off = (footprints - self.footprints)[movable, :2].reshape(-1, 2, 1)
        slopes = self.shape_slopes.reshape(len(movable), 2, self.shapes.shape[1])
        shapes = self.shapes.copy()
        shapes[movable] += (off * slopes).sum(axis=1)
        return replace(self, footprints=footprints, shapes=shapes)


def places_of(
    modes: Modes, footprints: FloatArray, movable: IntArray, sides: FloatArray
) -> AttachmentPoints:
    """Solve for footprints (a, 3) on a plate with given sides (2,) [m].

    movable (v,): indices of movable footprints.
    """
    moving = footprints[movable]
    shapes = modes.shapes_at(footprints)
    truncated = modes.truncated_terms(footprints, footprints)

    def truncated_at(points: FloatArray) -> FloatArray:
        """Return the truncated sums between points and the footprints, points first."""
        return modes.truncated_terms(points, footprints).swapaxes(0, 1)

    shape_slopes = place_slopes(modes.shapes_at, moving, sides)
    truncated_slopes = np.moveaxis(place_slopes(truncated_at, moving, sides), 2, 0)
    return AttachmentPoints(
        footprints=footprints,
        shapes=shapes,
        truncated=truncated,
        shape_slopes=shape_slopes.reshape(-1, shapes.shape[1]),
        truncated_slopes=truncated_slopes.reshape(len(truncated), -1, len(footprints)),
    )
