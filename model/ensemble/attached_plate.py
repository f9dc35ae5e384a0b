"""The plate with its attachments, at drive frequencies and possible thicknesses, without fingers.

`AttachedPlate` has the reduced plate, its ERAs and masses, and their uncertainty. `PlateOnEras`
eliminates these, for each thickness and once per table.

Free plate in reduced coordinates: A(x, y) = phi_x diag(g) phi_y^T with g = 1 / (s lambda - w²), s
lambda = (1 + i eta) lambda + i loss. A plate that is thicker by a factor has modal masses larger by
this factor, and frequencies higher by this factor (`model.reduction.free_plate`); another modulus
changes the frequencies alone. With h times the thickness, and frequencies q times as high,

    g = 1 / (h (q² s lambda - w²)),    dg / d ln loss = -i h q² Im(s lambda) g².

Plates are drawn along the axis of q; h is the expected value for a plate with this q. Modes
with individually uncertain frequency and amplitude are drawn separately for each plate: with
frequency factor v and amplitude factor a of a mode,

    g = a² / (h (v² q² s lambda - w²)).

With dynamic stiffness Z of the attachments b, ERAs first, elimination gives

    K = (1 + Z A)^-1,  T = -w² K^T phi g,  Y = -(Z + Z A Z) / w⁴.

T is the acceleration of the reduced coordinates due to a force at each attachment of the plate on
its ERAs. The receptance of that plate between positions x and y is phi_x g phi_y^T + (T phi_x)^T Y
T phi_y, without further reference to the attachments.

Thicknesses are solved exactly, because closely spaced modes can move past a tone. Within their
uncertainty the other parameters change the response nearly in proportion.

Sources can also be misplaced. A source acts with its force F on a plate that moves by w, F = F_0 -
Z w when all sources are driven. At shapes phi + d it adds a force F d - phi Z d w: a couple, and a
force at its own position. For an ERA, which is stiff, both count as an equivalent error of its
stiffness, which changes the fields of all sources. An exciter is a force driven by its own signal;
there such an error would be a gain error, which changes nothing at fingers in a null, although the
field of a couple has another shape. The part of the couple's field along the force's field
therefore counts as an error of stiffness, and the rest as an error of the source's field, at each
finger.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray
from model.ensemble.draws import standard_normal
from model.rig.rig import Uncertainty
from model.structure.attachments import PointLoad, attached_stiffness, coupled_forces, feet_of
from model.structure.fingertips import HAND_STD, Fingertip
from model.structure.modal_elasticity import (
    Dispersion,
    ModalElasticity,
    check_scales,
    modal_receptance,
)
from model.structure.plate import Plate
from model.structure.sources import Source, drive_forces
from registry.limits import MAX_FINGER_LOAD

LEAST_THICKNESS = 0.1
"""Minimum relative thickness of drawn plates."""


@dataclass(frozen=True, eq=False)
class Mounts:
    """b fixed attachments of a plate, n ERAs first and then masses, at f frequencies."""

    minus_omega2: Float32Array
    """-w² (f,) [rad²/s²]."""
    stiffness: Complex64Array
    """Dynamic stiffness (f, b) of the attachments [N/m]."""
    forces: Complex64Array
    """Force (f, n) of each ERA at full stroke [N]."""
    strokes: Complex64Array
    """Stroke (f, n) of each ERA's base [m], through which errors of its spring and damper act."""
    by_stiffness: Complex64Array
    """Change (f, s) of `stiffness` per standard deviation of the attachments' stiffness [N/m].

    Covers attachments up to the last uncertain foot; 0 for masses other than feet.
    """
    by_damping: Complex64Array
    """Change (f, n) of the ERAs' dynamic stiffness per standard deviation of damping [N/m]."""


def mounts_of(
    eras: Sequence[Source], masses: Sequence[PointLoad], w: FloatArray, uncertainty: Uncertainty
) -> Mounts:
    """Compute ERAs and masses at w (f,) [rad/s], independent of their positions.

    Errors of an ERA's stiffness are half the difference between one standard deviation up and down,
    since the suspension of an exciter is resonant; `supports` is the uncertainty of feet.
    """
    by_spring = list[ComplexArray]()
    by_damper = list[ComplexArray]()
    for era in eras:
        stiffer, _ = era.deviating(w, 1 + uncertainty.stiffness, 1.0)
        softer, _ = era.deviating(w, 1 - uncertainty.stiffness, 1.0)
        by_spring.append((stiffer - softer) / 2)
        by_damping, _ = era.slopes(w)["damping"]
        by_damper.append(getattr(era, era.fields["damping"]) * by_damping)
    feet = feet_of(masses) if uncertainty.supports else ()
    by_foot = np.zeros((len(w), max(feet, default=-1) + 1), dtype=complex)
    for number in feet:
        by_foot[:, number] = uncertainty.supports * masses[number].spring(w)
    log_damping = math.log(uncertainty.damping)
    return Mounts(
        minus_omega2=-(w**2).astype(np.float32),
        stiffness=attached_stiffness(w, eras, masses).astype(np.complex64),
        forces=drive_forces(w, eras).astype(np.complex64),
        strokes=np.array([era.base(w) for era in eras]).T.astype(np.complex64),
        by_stiffness=np.hstack([np.array(by_spring).T, by_foot]).astype(np.complex64),
        by_damping=(log_damping * np.array(by_damper).T).astype(np.complex64),
    )


@dataclass(frozen=True, eq=False)
class AttachedPlate(Mounts):
    """The plate with its fixed attachments.

    Arrays for answers are in single precision: accelerations are within 1e-5 of their largest.
    """

    modal: ComplexArray
    """s lambda (f, r) of the reduced coordinates [rad²/s²], with all losses."""
    shapes: Float32Array
    """Mode shapes (b, r) at the attachments."""
    omega: FloatArray
    """w (f,) [rad/s]."""
    fingertip: Fingertip | None
    """The rig's fingertip, None for weightless ones."""
    uncertainty: Uncertainty
    """Uncertainty of the rig's parameters."""

    @property
    def era_count(self) -> int:
        """Number of ERAs."""
        return int(self.forces.shape[1])

    def of_thicknesses(
        self, deviations: FloatArray, mode_deviations: FloatArray, row: int
    ) -> tuple[Complex64Array, Complex64Array]:
        """Return g for plates of several thicknesses at a row of the frequencies, (d, r) [s²/kg].

        Also its change by one standard deviation of the loss factor. deviations (d,): of the
        plates' frequencies; mode_deviations (2, r, d): of each mode's own frequency and size; both
        in standard deviations.
        """
        uncertainty = self.uncertainty
        modal = self.modal[row]
        mode_frequencies, mode_amplitudes = mode_deviations
        v = np.maximum(1 + uncertainty.mode_frequency * mode_frequencies.T, LEAST_THICKNESS)
        v_squared = v**2
        # The amplitude of rigid-body modes follows from the plate's known mass.
        a = 1 + uncertainty.mode_amplitude * (modal.real > 0) * mode_amplitudes.T
        a_squared = a**2
        share = 1.0
        if uncertainty.frequency > 0:
            share = (uncertainty.thickness / uncertainty.frequency) ** 2
        change = uncertainty.frequency * deviations
        q = np.maximum(1 + change, LEAST_THICKNESS)
        h = np.maximum(1 + share * change, LEAST_THICKNESS)
        stiffness = ((q / h)[:, None] ** 2 * v_squared * modal)[:, None]
        receptance = a_squared * modal_receptance(stiffness, self.omega[[row]], h)[:, 0]
        by_log_loss = -1j * math.log(uncertainty.damping) * modal.imag
        by_loss = by_log_loss * (h * q**2)[:, None] * v_squared / a_squared * receptance**2
        return receptance.astype(np.complex64), by_loss.astype(np.complex64)

    def finger_stiffness(self, count: int, loads: Sequence[float] = ()) -> Complex64Array:
        """Dynamic stiffness of a number of fingers (f, count) [N/m], 0 for weightless ones.

        loads (count,): relative to the rig's fingertip, empty for 1 each.
        """
        stiffness = np.repeat(self._finger[:, None], count, axis=1)
        if self.fingertip is not None:
            for number, load in enumerate(loads):
                if load != 1:
                    loaded = self.fingertip.under(load)
                    stiffness[:, number] = loaded.dynamic_stiffness(self.omega)
        return stiffness.astype(np.complex64)

    def load_stds(self, count: int, loads: Sequence[float] = ()) -> Float32Array:
        """Return standard deviations of the logarithm of loads, see `finger_stiffness`,
        (count,)."""
        is_hand = np.array(loads or (1.0,) * count) > MAX_FINGER_LOAD
        return np.where(is_hand, HAND_STD, self.uncertainty.fingertip).astype(np.float32)

    def driven_less(self, shares: FloatArray) -> "AttachedPlate":
        """Return the plate with ERAs at shares (f,) of full level."""
        if (shares == 1).all():
            return self
        factors = shares[:, None].astype(np.float32)
        return replace(self, forces=factors * self.forces, strokes=factors * self.strokes)

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies (f,) [Hz]."""
        return self.omega / (2 * math.pi)

    @cached_property
    def _finger(self) -> ComplexArray:
        if self.fingertip is None:
            return np.zeros(len(self.omega), dtype=complex)
        return self.fingertip.dynamic_stiffness(self.omega)


def attach(
    plate: Plate,
    omega: FloatArray,
    losses: FloatArray,
    shapes: FloatArray,
    *,
    eras: Sequence[Source],
    masses: Sequence[PointLoad],
    fingertip: Fingertip | None,
    uncertainty: Uncertainty,
    frequencies: FloatArray,
    dispersion: Dispersion | None = None,
) -> AttachedPlate:
    """Attach ERAs and masses to a reduced free plate.

    omega (r,) [rad/s] and losses (r,) [rad²/s²]: of its coordinates; shapes (eras + masses, r);
    frequencies (f,) [Hz]; dispersion: how omega² changes with them. Raises InputError for a plate
    that does not scale with one thickness.
    """
    check_scales(plate, 1 + uncertainty.frequency)
    w = 2 * np.pi * frequencies
    elasticity = ModalElasticity.of(plate, omega**2, losses, dispersion)
    return AttachedPlate(
        **vars(mounts_of(eras, masses, w, uncertainty)),
        modal=elasticity.stiffness(w),
        shapes=shapes.astype(np.float32),
        omega=w,
        fingertip=fingertip,
        uncertainty=uncertainty,
    )


def at_harmonics(twice: AttachedPlate, sources: Sequence[Source]) -> AttachedPlate:
    """Return a plate at twice the frequencies, with the sources' gains at the original ones."""
    frequencies = twice.frequencies
    original_gains = np.array([source.gain(0.5 * frequencies) for source in sources]).T
    gains = np.array([source.gain(frequencies) for source in sources]).T
    ratio = (original_gains / gains).astype(np.complex64)
    return replace(twice, forces=twice.forces * ratio, strokes=twice.strokes * ratio)


MODELED, THICKER, THINNER = 0, 1, 2
"""Indices of the nominal thickness, and of the thicknesses one standard deviation above and
below."""


@lru_cache(maxsize=8)
def thickness_nodes(count: int) -> FloatArray:
    """Return deviations (count,) that represent a normal distribution, ascending.

    In standard deviations: means of strata of equal probability, scaled to variance 1.
    """
    normal = NormalDist()
    bounds = [normal.inv_cdf(number / count) for number in range(1, count)]
    density = np.array([0.0, *map(normal.pdf, bounds), 0.0])
    means = -np.diff(density)
    size = np.sqrt((means**2).mean())
    nodes = means / size if size > 0 else means
    nodes.setflags(write=False)  # cached, and so shared
    return nodes


def mode_numbers(modes: int, count: int) -> FloatArray:
    """Return deviations (2, modes, count) of each mode's frequency and amplitude, 0 for a single
    plate.

    In standard deviations, in addition to the `thickness_nodes` of as many plates.
    """
    if count < 2:
        return np.zeros((2, modes, count))
    drawn = standard_normal(np.random.default_rng([modes, count]), 2 * modes, count)
    return drawn.reshape(2, modes, count)


@dataclass(frozen=True, eq=False)
class PlateOnEras:
    """The plate on its b attachments, without fingers, at f frequencies and t thicknesses."""

    plate: AttachedPlate
    first: dict[int, int]
    """Index of the first of the `thickness_nodes`, by number of nodes."""
    receptance: Complex64Array
    """g (f, t, r) of the free plate [s²/kg]."""
    by_loss: Complex64Array
    """Change (f, t, r) per standard deviation of the loss factor."""
    by_force: Complex64Array
    """T (f, t, b, r) [m/s²/N]."""
    coupling: Complex64Array
    """Y (f, t, b, b)."""
    moved: Complex64Array
    """Displacement (f, t, b, n) of the attachments by each ERA at full stroke [m]."""

    @classmethod
    def of(cls, plate: AttachedPlate, *node_counts: int) -> "PlateOnEras":
        """Eliminate the attachments of a plate, for several numbers of `thickness_nodes`.

        If its thickness is certain, there is only the nominal one.
        """
        groups = [np.zeros(1)]
        first = {}
        if plate.uncertainty.changes_modes:
            groups.append(np.array([1.0, -1.0]))
            for count in node_counts:
                first[count] = sum(map(len, groups))
                groups.append(thickness_nodes(count))
        deviations = np.concatenate(groups)
        f, b = plate.stiffness.shape
        r = plate.shapes.shape[1]
        t = len(deviations)
        mode_deviations = np.concatenate([mode_numbers(r, len(group)) for group in groups], axis=2)
        result = cls(
            plate=plate,
            first=first,
            receptance=np.empty((f, t, r), dtype=np.complex64),
            by_loss=np.empty((f, t, r), dtype=np.complex64),
            by_force=np.empty((f, t, b, r), dtype=np.complex64),
            coupling=np.empty((f, t, b, b), dtype=np.complex64),
            moved=np.empty((f, t, b, plate.era_count), dtype=np.complex64),
        )
        for row in range(f):
            receptance, by_loss = plate.of_thicknesses(deviations, mode_deviations, row)
            by_force, coupling, moved = _eliminated(plate, row, receptance)
            result.receptance[row] = receptance
            result.by_loss[row] = by_loss
            result.by_force[row] = by_force
            result.coupling[row] = coupling
            result.moved[row] = moved
        return result

    @property
    def fields(self) -> Complex64Array:
        """Acceleration of the reduced coordinates by each ERA at full stroke, (f, n, r)."""
        plate = self.plate
        return self.by_force[:, MODELED, : plate.era_count] * plate.forces[:, :, None]


def _eliminated(
    plate: AttachedPlate, row: int, receptance: Complex64Array
) -> tuple[Complex64Array, ...]:
    """Return T, Y and motion (t, ...) of plates of receptances g (t, r) at a row."""
    Z = plate.stiffness[row]
    w2 = plate.minus_omega2[row]
    n = plate.era_count
    modal = plate.shapes * receptance[:, None]
    A = modal @ plate.shapes.T
    K = coupled_forces(A, Z, np.eye(len(Z), dtype=np.complex64))
    coupling = np.asarray(Z[:, None] * A * Z, dtype=np.complex64)
    diagonal = coupling.reshape(len(A), -1)[:, :: len(Z) + 1]
    diagonal += Z
    moved = A @ (K[:, :, :n] * plate.forces[row])
    by_force = np.asarray(w2 * (K.swapaxes(1, 2) @ modal), dtype=np.complex64)
    return by_force, np.asarray(-coupling / w2**2), moved


def with_places(
    plates: PlateOnEras, shifts: FloatArray, gram: Float32Array, by_field: Sequence[bool]
) -> tuple[PlateOnEras, FloatArray]:
    """Include position errors of the sources in a plate, as larger errors of their stiffness.

    Also return the remaining mean square error (f, n) of each source's field [(m/s²)²], at full
    stroke, on the modeled plate without fingers. shifts (n, 2, r): change of the shapes at the
    sources per standard deviation along x and y; gram (r, r): mean product of the shapes where
    fingers rest; by_field (n,): whether couples count as errors of the field.
    """
    plate = plates.plate
    n = plate.era_count
    deformation = np.eye(n) * plate.strokes[:, None] - plates.moved[:, MODELED, :n]
    by_unit_force = np.linalg.norm(plates.by_force[:, MODELED, :n], axis=2)
    by_unit_stiffness = by_unit_force * np.linalg.norm(deformation, axis=2)
    changes = np.empty_like(by_unit_stiffness)
    field_errors = np.empty_like(by_unit_stiffness)
    counts_for_field = np.array(by_field)
    for row in range(len(changes)):
        change, field_error = _misplacement(plates, row, shifts, gram, counts_for_field)
        changes[row] = change
        field_errors[row] = field_error
    by_stiffness = plate.by_stiffness.copy()
    by_spring = plate.by_stiffness[:, :n]
    size = np.hypot(np.abs(by_spring), changes / by_unit_stiffness)
    by_stiffness[:, :n] = size * np.exp(1j * np.angle(by_spring))
    displaced = replace(plate, by_stiffness=by_stiffness)
    return replace(plates, plate=displaced), field_errors


def _misplacement(
    plates: PlateOnEras,
    row: int,
    shifts: FloatArray,
    gram: Float32Array,
    by_field: NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray]:
    """Return the change (n,) of all fields by the position errors of each source, at a row.

    Norms of the accelerations of the reduced coordinates [m/s²], without the part of the couples'
    fields that no stiffness error covers; and the mean square (n,) of that part in each field.
    """
    plate = plates.plate
    n = plate.era_count
    w2 = plate.minus_omega2[row]
    Z = plate.stiffness[row]
    T = plates.by_force[row, MODELED]
    forces = np.diag(plate.forces[row]) - Z[:n, None] * plates.moved[row, MODELED, :n]
    free = plates.receptance[row, MODELED] * shifts
    prevented = ((free @ plate.shapes.T) * Z) @ T
    couples = np.asarray(w2 * free - prevented)  # (n, 2, r), by 1 N
    by_force = T[:n, None]
    along = by_force.conj() @ gram
    share = (along * couples).sum(axis=2) / (along * by_force).sum(axis=2)
    field_errors = np.zeros_like(couples)
    field_errors[by_field] = (couples - share[..., None] * by_force)[by_field]
    tilts = Z[:n, None, None] * (shifts @ (plates.fields[row] / w2).T)  # (n, 2, n)
    by_couples = forces[:, None, :, None] * (couples - field_errors)[:, :, None]
    changes = by_couples - tilts[..., None] * by_force[:, :, None]
    squares = np.vecdot(field_errors, field_errors @ gram).real.sum(axis=1)
    error_power = (np.abs(forces) ** 2 * squares[:, None]).sum(axis=0)
    return np.linalg.norm(changes.reshape(n, -1), axis=1), error_power
