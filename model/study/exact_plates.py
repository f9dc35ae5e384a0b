"""Random plates within a rig's tolerances, solved exactly at the frequencies of an excitation.

Promises are checked on these plates. Each plate is solved in the reduced coordinates of the table.
A thicker plate has the same mode shapes; natural frequencies and modal masses scale with it. That
is exact for thin plates; shear and rotary inertia of the paper's plate change the response by less
than 1e-3 over 2 %.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, IntArray, Point
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.draws import over_fingertips
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import attached_stiffness, coupled_forces, feet_of, footprints_of
from model.structure.fingertips import FingertipLoad, fingertip_loads
from model.structure.modal_elasticity import check_scales, lowest_elastic, modal_receptance
from model.structure.surface import MAX_DEVIATING
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.vibration import Excitation, base_amplitudes


@dataclass(frozen=True, eq=False)
class Plates:
    """Parameters of d plates, as factors relative to the modeled one unless stated otherwise."""

    thickness: FloatArray
    """Thickness (d,) of the plate."""
    loss: FloatArray
    """Loss factor (d,) of the plate."""
    damping: FloatArray
    """Damping (d,) of the ERAs."""
    stiffness: FloatArray
    """Stiffness (d, eras) of each ERA."""
    load: FloatArray
    """Dynamic stiffness (d, contacts) of each finger."""
    gain: ComplexArray
    """Complex gain (d, eras) of each ERA."""
    deviation: ComplexArray
    """Error (d, contacts) of the response at each finger, in standard errors of the field."""
    modulus: FloatArray
    """Modulus of elasticity (d,)."""
    places: FloatArray
    """Displacement (d, eras, 2) of each ERA from its nominal position [m]."""
    harmonic: ComplexArray
    """Second harmonic (d, eras) of each ERA's motion, relative to the motion."""
    feet: FloatArray
    """Stiffness (d, feet) of each foot."""
    modes: FloatArray = field(default_factory=lambda: np.ones((1, 2, 0)))
    """Factors (d, 2, m) on the eigenvalue and the squared size of each of the lowest elastic
    modes."""
    touches: FloatArray = field(default_factory=lambda: np.zeros((1, 1, 2)))
    """Displacement (d, contacts, 2) of each finger from its reported position [m]."""


def draw_plates(
    rng: np.random.Generator,
    uncertainty: Uncertainty,
    *,
    of: Rig | LocalizationTable,
    count: int,
    contact_count: int,
) -> Plates:
    """Draw plates within an uncertainty.

    Damping, loss, finger loads and feet are log-normal, and springs are normal numbers above zero;
    everything else is normal.
    """
    era_count, foot_count = len(of.eras), len(feet_of(of.masses))

    def normal(*shape: int) -> FloatArray:
        return rng.standard_normal((count, *shape))

    def complex_normal(size: int) -> ComplexArray:
        real, imaginary = normal(size), normal(size)
        return np.asarray(math.sqrt(0.5) * (real + 1j * imaginary))

    mode_stds = np.array([[uncertainty.mode_frequency], [uncertainty.mode_amplitude]])
    mode_count = MAX_DEVIATING if mode_stds.any() else 0
    # Generators of their own: the other draws of a seed do not depend on the number of modes, on
    # how many springs are drawn again, nor on the positions of touches.
    (mode_rng,) = rng.spawn(1)
    (redraw_rng,) = mode_rng.spawn(1)
    (touch_rng,) = redraw_rng.spawn(1)
    mode_draws = mode_rng.standard_normal((count, 2, mode_count))

    # The draws of a seed depend on their order.
    deviation = complex_normal(contact_count)
    common_gain = np.exp(uncertainty.common_gain * normal(1))
    thickness = 1 + uncertainty.thickness * normal()
    loss = uncertainty.damping ** normal()
    damping = uncertainty.damping ** normal()
    stiffness = 1 + uncertainty.stiffness * normal(era_count)
    while (stiffness <= 0).any():
        redrawn = 1 + uncertainty.stiffness * redraw_rng.standard_normal(stiffness.shape)
        stiffness = np.where(stiffness > 0, stiffness, redrawn)
    load = np.exp(uncertainty.fingertip * normal(contact_count))
    gain = common_gain * (1 + uncertainty.gain * normal(era_count))
    phase = math.radians(uncertainty.phase_deg) * normal(era_count)
    return Plates(
        thickness=thickness,
        loss=loss,
        damping=damping,
        stiffness=stiffness,
        load=load,
        gain=gain * np.exp(1j * phase),
        deviation=deviation,
        modulus=1 + uncertainty.elasticity * normal(),
        places=uncertainty.place * normal(era_count, 2),
        harmonic=uncertainty.harmonic * complex_normal(era_count),
        feet=np.exp(uncertainty.supports * normal(foot_count)),
        modes=(1 + mode_stds * mode_draws) ** 2,
        touches=uncertainty.touch_offset * touch_rng.standard_normal((count, contact_count, 2)),
    )


def felt_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> tuple[FloatArray, FloatArray | None]:
    """Return the level and contrast of an excitation at fingers on d plates, both (d,).

    The level is the ratio of amplitude to threshold at the weakest target. The contrast is its
    ratio to the loudest quiet point, or None without quiet fingers. Powers of tones and harmonics
    add.
    """
    rows, power = powers_on(table, placed, excitation, plates)
    thresholds = table.thresholds[rows, None, None].astype(float)
    relative_power = power / thresholds**2
    sensed_power = relative_power.sum(axis=0)
    sensed_power += harmonics_on(table, placed, excitation, plates)
    weights = read_fingertips(table, placed.contacts).fine_weights
    (means,), (loudest,) = over_fingertips(sensed_power[None], weights)
    target_count = len(placed.targets)
    level = means[:target_count].min(axis=0)
    if not placed.quiet:
        return level, None
    loudest_quiet = np.sqrt(loudest[target_count:].max(axis=0))
    return level, level / np.maximum(loudest_quiet, 1e-30)


def powers_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> tuple[IntArray, FloatArray]:
    """Return rows of an excitation's frequencies (m,) and squared amplitudes (m, points, d).

    The points are the fine points of `read_fingertips`, finger by finger.
    """
    discs, fingers = touched(table, placed, plates)
    rows, accelerations = _responses(table, discs, fingers, excitation, plates)
    return rows, np.abs(accelerations) ** 2


def harmonics_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> FloatArray:
    """Return the power of an excitation's second harmonics, relative to threshold: (points, d).

    At the points of `powers_on`.
    """
    discs, fingers = touched(table, placed, plates)
    frequencies, bases = base_amplitudes(excitation, table.eras)
    rows = table.rows_of(frequencies)
    distorted = replace(plates, gain=plates.gain * plates.harmonic)
    harmonics = accelerations_on(
        table, discs, fingers, table.at_harmonics.plate, rows, bases[:, None], distorted
    )
    power = np.abs(harmonics[:, :, 0]) ** 2
    thresholds = table.harmonic_thresholds[rows, None].astype(float)
    return np.asarray((power / thresholds**2).sum(axis=1).T)


def amplitudes_on(
    table: LocalizationTable, points: Sequence[Point], excitation: Excitation, plates: Plates
) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (f,) [Hz] and amplitudes (f, points, d) [m/s²] on untouched plates.

    points: in meters. plates: drawn with as many contacts as points; their loads have no effect.
    """
    shapes = table.shapes_at(points)[None, :, None]
    rows, accelerations = _responses(table, shapes, (), excitation, plates)
    return table.frequencies[rows], np.abs(accelerations)


def touched(
    table: LocalizationTable, placed: Placement, plates: Plates
) -> tuple[FloatArray, Sequence[FingertipLoad]]:
    """Return the shapes at the fine points of fingers, see `discs_on`, and their loads."""
    discs = discs_on(table, placed.contacts, plates)
    return discs, fingertip_loads(table.fingertip, placed.contacts, placed.loads)


def discs_on(table: LocalizationTable, contacts: Sequence[Point], plates: Plates) -> FloatArray:
    """Return the shapes (d, k, p, r) at the fine points of fingers on d plates.

    contacts: reported positions [m], from which the fingers are displaced on each plate. The first
    dimension is 1 if the fingers are in the same positions on all plates.
    """
    reported = np.array(contacts, dtype=float)
    touches = plates.touches if plates.touches.any() else np.zeros((1, 1, 2))
    sides = np.array([table.plate.length, table.plate.width])
    positions = np.clip(reported + touches[:, : len(reported)], 0.0, sides)
    centers = [(x, y) for x, y in positions.reshape(-1, 2).tolist()]
    fine = read_fingertips(table, centers).fine.astype(float)
    return fine.reshape(*positions.shape[:2], *fine.shape[1:])


def _responses(
    table: LocalizationTable,
    discs: FloatArray,
    fingers: Sequence[FingertipLoad],
    excitation: Excitation,
    plates: Plates,
) -> tuple[IntArray, ComplexArray]:
    """Return rows of an excitation's frequencies (m,), and accelerations (m, points, d) [m/s²]."""
    frequencies, bases = base_amplitudes(excitation, table.eras)
    rows = table.rows_of(frequencies)
    accelerations = accelerations_on(
        table, discs, fingers, table.attached, rows, bases[:, None], plates
    )[:, :, 0]
    drive_levels = np.abs(bases) / table.highest_drives[rows]
    error_power = table.field_error_power[rows] * drive_levels**2
    field_errors = np.sqrt(error_power.sum(axis=1))
    deviations = np.repeat(plates.deviation, discs.shape[2], axis=1)
    errors = np.multiply.outer(deviations, field_errors).swapaxes(1, 2)
    return rows, (accelerations + errors).transpose(1, 2, 0)


def accelerations_on(
    table: LocalizationTable,
    discs: FloatArray,
    fingers: Sequence[FingertipLoad],
    attached: AttachedPlate,
    rows: IntArray,
    bases: ComplexArray,
    plates: Plates,
) -> ComplexArray:
    """Solve the acceleration (d, m, c, points) [m/s²] by base motions (m, c, eras) [m].

    rows (m,): table rows, whose frequencies determine the stiffness of the attachments. discs
    (d or 1, k, p, r): shapes at the points of each finger, whose load acts at its first point. The
    error of the field is not included.
    """
    check_scales(table.plate, plates.thickness, plates.modulus)
    omega = attached.omega[rows]
    era_stiffness, era_forces = _stiffness_of_eras(table, omega, plates)
    stiffness_at_rest = _stiffness_at_rest(table, fingers, omega, plates)
    stiffness = np.concatenate([era_stiffness, stiffness_at_rest], axis=-1)
    modal = _modal_receptance(attached.modal[rows], omega, plates)
    finger_shapes = discs[:, : len(fingers), 0]
    shapes = _attachment_shapes(table, finger_shapes, plates.places)[:, None]
    receptance = np.asarray((modal * shapes) @ shapes.swapaxes(2, 3), dtype=complex)
    gains = np.array([era.gain(table.frequencies[rows]) for era in table.eras]).T
    driven_forces = era_forces * plates.gain[:, None] * gains
    driven = driven_forces[:, :, None] * bases
    undriven_count = shapes.shape[2] - len(table.eras)
    applied = np.pad(driven, ((0, 0), (0, 0), (0, 0), (0, undriven_count)))
    forces = coupled_forces(receptance, stiffness, applied.swapaxes(2, 3))
    modal_displacements = modal * (forces.swapaxes(2, 3) @ shapes)
    point_shapes = discs.reshape(len(discs), 1, -1, discs.shape[-1])
    displacements = modal_displacements @ point_shapes.swapaxes(2, 3)
    return -(omega**2)[:, None, None] * displacements


def _stiffness_of_eras(
    table: LocalizationTable, omega: FloatArray, plates: Plates
) -> tuple[ComplexArray, ComplexArray]:
    """Return dynamic stiffness and force per drive of the ERAs on each plate, both (d, m, eras)."""
    dampings = plates.damping[:, None]
    stiffness, forces = [], []
    for era, factors in zip(table.eras, plates.stiffness.T, strict=True):
        era_stiffness, era_force = era.deviating(omega, factors[:, None], dampings)
        stiffness.append(era_stiffness)
        forces.append(era_force)
    return np.stack(stiffness, axis=-1), np.stack(forces, axis=-1)


def _stiffness_at_rest(
    table: LocalizationTable,
    fingers: Sequence[FingertipLoad],
    omega: FloatArray,
    plates: Plates,
) -> ComplexArray:
    """Return the dynamic stiffness of masses, feet and fingers (d, m, masses + fingers) [N/m]."""
    loads = plates.load[:, : len(fingers)]
    factors = np.pad(loads, ((0, 0), (len(table.masses), 0)), constant_values=1.0)
    stiffness = factors[:, None] * attached_stiffness(omega, table.masses, fingers)
    for number, foot_factors in zip(feet_of(table.masses), plates.feet.T, strict=True):
        spring = table.masses[number].spring(omega)
        stiffness[:, :, number] += np.multiply.outer(foot_factors - 1, spring)
    return stiffness


def _modal_receptance(nominal: ComplexArray, omega: FloatArray, plates: Plates) -> ComplexArray:
    """Return the receptance of each mode (d, m, 1, r) from nominal modal stiffness (m, r)."""
    lossy = nominal.real + 1j * plates.loss[:, None, None] * nominal.imag
    plate_count, _, drawn_count = plates.modes.shape
    lowest = lowest_elastic(nominal[0].real, drawn_count)
    mode_factors = np.ones((plate_count, 2, nominal.shape[1]))
    mode_factors[:, :, lowest] = plates.modes[:, :, : len(lowest)]
    eigenvalue_factors = mode_factors[:, :1]
    size_factors = mode_factors[:, None, 1:]
    stiffness = plates.modulus[:, None, None] * eigenvalue_factors * lossy
    receptance = modal_receptance(np.asarray(stiffness, dtype=complex), omega, plates.thickness)
    return receptance[:, :, None] * size_factors


def _attachment_shapes(
    table: LocalizationTable, finger_shapes: FloatArray, displacements: FloatArray
) -> FloatArray:
    """Return mode shapes at ERAs, masses and fingers (d, n, r) with ERAs displaced (d, eras, 2).

    finger_shapes (d or 1, k, r).
    """
    plate_count = len(displacements)
    nominal = np.repeat(table.attachment_shapes[None], plate_count, axis=0)
    fingers = np.broadcast_to(finger_shapes, (plate_count, *finger_shapes.shape[1:]))
    shapes = np.concatenate([nominal, fingers], axis=1)
    footprints = footprints_of(table.eras)
    displaced = np.repeat(footprints[None], len(displacements), axis=0)
    sides = np.array([table.plate.length, table.plate.width])
    positions = displaced[:, :, :2] + displacements
    displaced[:, :, :2] = np.clip(positions, 0.0, sides)
    displaced_shapes = table.shapes_at(displaced.reshape(-1, footprints.shape[1]))
    era_count = displaced.shape[1]
    displaced_shapes = displaced_shapes.reshape(plate_count, era_count, -1)
    shapes[:, :era_count] += displaced_shapes - table.shapes_at(footprints)
    return shapes
