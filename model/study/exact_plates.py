"""Plates within the uncertainty of a rig solved exactly: the check of what answers promise.

Each plate is solved in the reduced coordinates of the table, at the pattern's frequencies. One that
is thicker by a factor has the same mode shapes; natural frequencies and modal masses scale with it.
That is exact for thin plates; shear and rotary inertia of the paper's plate change the response by
less than 1e-3 over 2 %.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, IntArray, Point
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.draws import over_fingertips
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import (
    FingertipLoad,
    attached_stiffness,
    coupled_forces,
    feet_of,
    fingertip_loads,
    footprints_of,
)
from model.structure.modal_elasticity import check_scales, modal_receptance
from model.table.table import LocalizationTable, read_fingertips
from model.vibration import Excitation, base_amplitudes


@dataclass(frozen=True, eq=False)
class Plates:
    """Factors of d plates relative to the modelled one.

    thickness, loss (d,): of the plate; damping (d,): of the ERAs; stiffness (d, eras): of each ERA;
    load (d, contacts): of each finger's dynamic stiffness; gain (d, eras): complex, of each ERA;
    deviation (d, contacts): of the response at each finger, in errors of the field; modulus (d,):
    of elasticity; feet (d, feet): of the stiffness of each foot. Further, places (d, eras, 2): by
    how far each ERA is off [m]; harmonic (d, eras): complex second harmonic of each ERA's motion,
    relative to its own.
    """

    thickness: FloatArray
    loss: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    load: FloatArray
    gain: ComplexArray
    deviation: ComplexArray
    modulus: FloatArray
    places: FloatArray
    harmonic: ComplexArray
    feet: FloatArray


def draw_plates(
    rng: np.random.Generator,
    uncertainty: Uncertainty,
    *,
    of: Rig | LocalizationTable,
    count: int,
    contact_count: int,
) -> Plates:
    """Draw plates on ERAs and feet: normal numbers, of logarithms for damping, loss, load, feet."""
    era_count, foot_count = len(of.eras), len(feet_of(of.masses))

    def normal(*shape: int) -> FloatArray:
        return rng.standard_normal((count, *shape))

    phase = math.radians(uncertainty.phase_deg)

    def complex_normal(size: int) -> ComplexArray:
        real, imaginary = normal(size), normal(size)
        return np.asarray(math.sqrt(0.5) * (real + 1j * imaginary))

    deviation = complex_normal(contact_count)
    common = np.exp(uncertainty.common_gain * normal(1))
    return Plates(
        thickness=1 + uncertainty.thickness * normal(),
        loss=uncertainty.damping ** normal(),
        damping=uncertainty.damping ** normal(),
        stiffness=1 + uncertainty.stiffness * normal(era_count),
        load=np.exp(uncertainty.fingertip * normal(contact_count)),
        gain=common
        * (1 + uncertainty.gain * normal(era_count))
        * np.exp(1j * phase * normal(era_count)),
        deviation=deviation,
        modulus=1 + uncertainty.elasticity * normal(),
        places=uncertainty.place * normal(era_count, 2),
        harmonic=uncertainty.harmonic * complex_normal(era_count),
        feet=np.exp(uncertainty.supports * normal(foot_count)),
    )


@dataclass(frozen=True, eq=False)
class LevelAndContrast:
    """What fingers feel on d plates: amplitude to threshold at the weakest target (d,).

    contrast (d,): of it to that at the loudest quiet point, None without quiet fingers.
    """

    level: FloatArray
    contrast: FloatArray | None


def felt_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> LevelAndContrast:
    """What fingers feel of an excitation on plates; powers of its tones and harmonics add."""
    rows, power = powers_on(table, placed, excitation, plates)
    sensed = (power / table.thresholds[rows, None, None].astype(float) ** 2).sum(axis=0)
    sensed += harmonics_on(table, placed, excitation, plates)
    weights = read_fingertips(table, placed.contacts).fine_weights
    (means,), (loudest,) = over_fingertips(sensed[None], weights)
    count = len(placed.targets)
    level = means[:count].min(axis=0)
    if not placed.quiet:
        return LevelAndContrast(level, None)
    return LevelAndContrast(level, level / np.maximum(np.sqrt(loudest[count:].max(axis=0)), 1e-30))


def powers_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> tuple[IntArray, FloatArray]:
    """Rows of an excitation's frequencies (m,), and squared amplitudes on plates (m, points, d).

    At the fine points of `read_fingertips`, finger by finger.
    """
    rows, found = _responses(table, *touched(table, placed), excitation, plates)
    return rows, np.abs(found) ** 2


def harmonics_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> FloatArray:
    """Power to threshold of an excitation's second harmonics on plates (points, d).

    At the points of `powers_on`.
    """
    discs, fingers = touched(table, placed)
    frequencies, bases = base_amplitudes(excitation, table.eras)
    at = table.at_harmonics.plate, table.rows_of(frequencies), bases[:, None]
    distorted = replace(plates, gain=plates.gain * plates.harmonic)
    found = accelerations_on(table, discs, fingers, *at, distorted)[:, :, 0]
    over = np.abs(found) ** 2 / table.harmonic_thresholds[at[1], None].astype(float) ** 2
    return np.asarray(over.sum(axis=1).T)


def amplitudes_on(
    table: LocalizationTable, points: Sequence[Point], excitation: Excitation, plates: Plates
) -> tuple[FloatArray, FloatArray]:
    """Frequencies (f,) [Hz] and amplitudes (f, points, d) [m/s²] where nothing touches the plate.

    points [m]; plates: of as many contacts as points, whose loads count for nothing.
    """
    shapes = table.shapes_at(points)[:, None]
    rows, found = _responses(table, shapes, (), excitation, plates)
    return table.frequencies[rows], np.abs(found)


def touched(
    table: LocalizationTable, placed: Placement
) -> tuple[FloatArray, Sequence[FingertipLoad]]:
    """Shapes at the fine points of fingers (k, p, r), and their loads."""
    fine = read_fingertips(table, placed.contacts).fine.astype(float)
    return fine, fingertip_loads(table.fingertip, placed.contacts, placed.loads)


def _responses(
    table: LocalizationTable,
    discs: FloatArray,
    fingers: Sequence[FingertipLoad],
    excitation: Excitation,
    plates: Plates,
) -> tuple[IntArray, ComplexArray]:
    """Rows of an excitation's frequencies (m,), and its accelerations (m, points, d) [m/s²]."""
    frequencies, bases = base_amplitudes(excitation, table.eras)
    rows = table.rows_of(frequencies)
    at = table.attached, rows, bases[:, None]
    found = accelerations_on(table, discs, fingers, *at, plates)[:, :, 0]
    weights = np.abs(bases) / table.highest_drives[rows]
    size = np.sqrt((table.field_error_power[rows] * weights**2).sum(axis=1))
    deviation = np.repeat(plates.deviation, discs.shape[1], axis=1)
    return rows, (found + np.multiply.outer(deviation, size).swapaxes(1, 2)).transpose(1, 2, 0)


def accelerations_on(
    table: LocalizationTable,
    discs: FloatArray,
    fingers: Sequence[FingertipLoad],
    attached: AttachedPlate,
    rows: IntArray,
    bases: ComplexArray,
    plates: Plates,
) -> ComplexArray:
    """Acceleration (d, m, c, points) [m/s²] for base motions (m, c, eras) [m].

    At rows (m,) of the frequencies of the attached plate, whose ERAs move as at the table's, and
    points of shapes discs (k, p, r), each finger at the first point of its disc; without the
    deviation of the field.
    """
    check_scales(table.plate, plates.thickness, plates.modulus)
    w, eras = attached.omega[rows], table.eras
    of_each = zip(eras, plates.stiffness.T, strict=True)
    each = [era.deviating(w, by[:, None], plates.damping[:, None]) for era, by in of_each]
    at_eras, pushes = (np.stack(part, axis=-1) for part in zip(*each, strict=True))
    loads = plates.load[:, : len(fingers)]
    factors = np.pad(loads, ((0, 0), (len(table.masses), 0)), constant_values=1.0)
    resting = factors[:, None] * attached_stiffness(w, table.masses, fingers)
    for number, by in zip(feet_of(table.masses), plates.feet.T, strict=True):
        resting[:, :, number] += np.multiply.outer(by - 1, table.masses[number].spring(w))
    stiffness = np.concatenate([at_eras, resting], axis=-1)
    nominal = attached.modal[rows]
    lossy = nominal.real + 1j * plates.loss[:, None, None] * nominal.imag
    stiffer = np.asarray(plates.modulus[:, None, None] * lossy, dtype=complex)
    modal = modal_receptance(stiffer, w, plates.thickness)[:, :, None]
    shapes = np.vstack([table.attachment_shapes, discs[: len(fingers), 0]])
    shapes = np.repeat(shapes[None], len(plates.places), axis=0)
    shapes[:, : len(eras)] += _shifts(table, plates.places)
    shapes = shapes[:, None]
    receptance = np.asarray((modal * shapes) @ shapes.swapaxes(2, 3), dtype=complex)
    gains = np.array([era.gain(table.frequencies[rows]) for era in eras]).T
    driven = (pushes * plates.gain[:, None] * gains)[:, :, None] * bases
    still = ((0, 0), (0, 0), (0, 0), (0, shapes.shape[2] - len(eras)))
    forces = coupled_forces(receptance, stiffness, np.pad(driven, still).swapaxes(2, 3))
    moved = modal * (forces.swapaxes(2, 3) @ shapes)
    found = -(w**2)[:, None, None] * (moved @ discs.reshape(-1, discs.shape[-1]).T)
    return np.asarray(found)


def _shifts(table: LocalizationTable, places: FloatArray) -> FloatArray:
    """By how much the shapes at ERAs change that are off by places (d, n, 2) [m], (d, n, r)."""
    known = footprints_of(table.eras)
    moved = np.repeat(known[None], len(places), axis=0)
    sides = np.array([table.plate.length, table.plate.width])
    moved[:, :, :2] = np.clip(moved[:, :, :2] + places, 0.0, sides)
    there = table.shapes_at(moved.reshape(-1, known.shape[1]))
    return np.asarray(there.reshape(*moved.shape[:2], -1) - table.shapes_at(known))
