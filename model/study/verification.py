"""Verify promises of answers on exactly solved plates within a rig's uncertainty.

Each plate is solved in the reduced coordinates of the table, at the pattern's frequencies. A
thicker plate has the same mode shapes; natural frequencies and modal masses scale with it. That is
exact for thin plates; shear and rotary inertia of the paper's plate change the response by less
than 1e-3 over 2 %.

Verification of a table: recomputes a sample by other methods.

- Content: fields on the raster and at the cells, against the plate solved at each frequency without
  modes (`model.spectral.direct_solution`), relative L2. On finite elements, and with measured
  modes, against the free plate solved again with the ERAs attached (`model.reduction.free_plate`).
- Answers: level and contrast at random contacts, against the same with the fingers attached, too.
- Promises: the felt contrast on 90 % of exactly solved plates.
- Answers in time: amplitudes at the fingertips once the pattern, started from rest on the plate in
  time (`model.transients.time_response`), has settled. Contrast beyond 25 dB counts as 25: in a
  null, hysteretic and viscous damping differ by more than the remaining vibration.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import Answer
from model.answer.plan import query
from model.answer.stimulus import MIN_LEVEL_DB_SL, Placement
from model.arrays import ComplexArray, FloatArray, IntArray, Point
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.draws import PERCENTILE, over_fingertips
from model.errors import InputError
from model.finger import (
    Grid,
    contrast_db,
    decibels,
    detection_threshold,
    fingertip_points,
    fingertip_weights,
)
from model.processes import Progress, unseen
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.rig.rig import Rig, Uncertainty
from model.spectral.direct_solution import Responder, direct_spectral_acceleration
from model.spectral.modes import SpectralMesh
from model.structure.attachments import (
    FingertipLoad,
    attached_stiffness,
    coupled_forces,
    feet_of,
    fingertip_loads,
    footprints_of,
)
from model.structure.modal_elasticity import check_scales, lowest_elastic, modal_receptance
from model.structure.surface import MAX_DEVIATING
from model.study.contrast_maps import MIN_DISTANCE, random_contacts
from model.table.table import LocalizationTable, read_fingertips
from model.table.table_file import build_table
from model.transients.base_motion import ramped_onset
from model.transients.shaping import SAMPLE_RATE, Transients
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration import Excitation, base_amplitudes, tone_fields


@dataclass(frozen=True, eq=False)
class Plates:
    """Parameters of d plates, as factors relative to the modelled one unless stated otherwise."""

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
    """Deviation (d, contacts) of the response at each finger, in errors of the field."""
    modulus: FloatArray
    """Modulus of elasticity (d,)."""
    places: FloatArray
    """Displacement (d, eras, 2) of each ERA from its place [m]."""
    harmonic: ComplexArray
    """Second harmonic (d, eras) of each ERA's motion, relative to it."""
    feet: FloatArray
    """Stiffness (d, feet) of each foot."""
    modes: FloatArray = field(default_factory=lambda: np.ones((1, 2, 0)))
    """Eigenvalue and squared size (d, 2, m) of each of the lowest elastic modes by itself."""


def draw_plates(
    rng: np.random.Generator,
    uncertainty: Uncertainty,
    *,
    of: Rig | LocalizationTable,
    count: int,
    contact_count: int,
) -> Plates:
    """Draw plates; damping, loss, load and feet are log-normal, all else is normal."""
    era_count, foot_count = len(of.eras), len(feet_of(of.masses))

    def normal(*shape: int) -> FloatArray:
        return rng.standard_normal((count, *shape))

    phase = math.radians(uncertainty.phase_deg)

    def complex_normal(size: int) -> ComplexArray:
        real, imaginary = normal(size), normal(size)
        return np.asarray(math.sqrt(0.5) * (real + 1j * imaginary))

    of_modes = np.array([[uncertainty.mode_frequency], [uncertainty.mode_amplitude]])
    modes = MAX_DEVIATING if of_modes.any() else 0
    (apart,) = rng.spawn(1)  # so that all else of a seed stays
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
        modes=(1 + of_modes * apart.standard_normal((count, 2, modes))) ** 2,
    )


def felt_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> tuple[FloatArray, FloatArray | None]:
    """Return what fingers feel of an excitation on d plates: level and contrast, both (d,).

    Level is the amplitude to threshold at the weakest target, contrast its ratio to that at the
    loudest quiet point, None without quiet fingers. Powers of tones and harmonics add.
    """
    rows, power = powers_on(table, placed, excitation, plates)
    sensed = (power / table.thresholds[rows, None, None].astype(float) ** 2).sum(axis=0)
    sensed += harmonics_on(table, placed, excitation, plates)
    weights = read_fingertips(table, placed.contacts).fine_weights
    (means,), (loudest,) = over_fingertips(sensed[None], weights)
    count = len(placed.targets)
    level = means[:count].min(axis=0)
    if not placed.quiet:
        return level, None
    return level, level / np.maximum(np.sqrt(loudest[count:].max(axis=0)), 1e-30)


def powers_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> tuple[IntArray, FloatArray]:
    """Return rows of an excitation's frequencies (m,) and squared amplitudes (m, points, d).

    At the fine points of `read_fingertips`, finger by finger.
    """
    rows, found = _responses(table, *touched(table, placed), excitation, plates)
    return rows, np.abs(found) ** 2


def harmonics_on(
    table: LocalizationTable, placed: Placement, excitation: Excitation, plates: Plates
) -> FloatArray:
    """Return the power to threshold of an excitation's second harmonics on plates, (points, d).

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
    """Return frequencies (f,) [Hz] and amplitudes (f, points, d) [m/s²] on untouched plates.

    points [m]; plates: with as many contacts as points, whose loads have no effect.
    """
    shapes = table.shapes_at(points)[:, None]
    rows, found = _responses(table, shapes, (), excitation, plates)
    return table.frequencies[rows], np.abs(found)


def touched(
    table: LocalizationTable, placed: Placement
) -> tuple[FloatArray, Sequence[FingertipLoad]]:
    """Return the shapes at the fine points of fingers (k, p, r), and their loads."""
    fine = read_fingertips(table, placed.contacts).fine.astype(float)
    return fine, fingertip_loads(table.fingertip, placed.contacts, placed.loads)


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
    """Solve the acceleration (d, m, c, points) [m/s²] by base motions (m, c, eras) [m].

    At rows (m,) of the frequencies of the attached plate, whose ERAs move as at the table's, and at
    points of shapes discs (k, p, r). Each finger is at the first point of its disc; the deviation
    of the field is not included.
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
    lowest = lowest_elastic(nominal[0].real, plates.modes.shape[2])
    of_modes = np.ones((len(plates.modes), 2, nominal.shape[1]))
    of_modes[:, :, lowest] = plates.modes[:, :, : len(lowest)]
    stiffer = np.asarray(plates.modulus[:, None, None] * of_modes[:, :1] * lossy, dtype=complex)
    modal = modal_receptance(stiffer, w, plates.thickness)[:, :, None] * of_modes[:, None, 1:]
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
    """Return the change (d, n, r) of the shapes at ERAs that are off by places (d, n, 2) [m]."""
    known = footprints_of(table.eras)
    moved = np.repeat(known[None], len(places), axis=0)
    sides = np.array([table.plate.length, table.plate.width])
    moved[:, :, :2] = np.clip(moved[:, :, :2] + places, 0.0, sides)
    there = table.shapes_at(moved.reshape(-1, known.shape[1]))
    return np.asarray(there.reshape(*moved.shape[:2], -1) - table.shapes_at(known))


CONTENT_TOLERANCE = 1e-4
"""Relative L2 error of the content; the paper's plate has some 1e-5, on its coarsest mesh 2e-5."""

MODAL_ERROR = 0.03
"""Coupling of modes by lossy layers and air, relative to the field."""

UNKNOWN_MODES_ERROR = 5e-3
"""Estimated compliance of a surface in modes that are not known, near points, to the field."""

ROUNDING_DB = 0.01

RASTER_ERROR = 2e-4
"""Interpolation error of a field on the raster, relative to its root mean square."""

FINGER_ERROR = 7e-3
"""Local deflection under fingers that the table's modes lack, relative to the same."""

TIME_TOLERANCE_DB = 1.0
MAX_CONTRAST_IN_TIME_DB = 25.0

PLATES = 200
"""Number of plates drawn for each answer."""

MIN_KEPT_SHARE = 0.8
"""Fraction of plates that must keep a promise; 90 % are expected on average over answers."""

SAMPLED_FREQUENCIES = 3

_ANSWERS = 30  # on another plate, ten each with one, two and three quiet fingers
_ALL_OVER = Grid(8, 6)  # where the root mean square is taken

_WINDOW = 0.25  # s, over which steady amplitudes are evaluated
_REMAINING = 1e-4  # share of the free vibration by the start that may be left then
_MAX_DURATION = 20.0  # s


@dataclass(frozen=True)
class ContentCheck:
    """Error and tolerance of a kind of content, relative L2."""

    name: str
    error: float
    tolerance: float

    @property
    def is_passed(self) -> bool:
        """Whether the error is within the tolerance."""
        return self.error <= self.tolerance


@dataclass(frozen=True)
class AnswerCheck:
    """Level [dB SL] and felt contrast [dB] of an answer: predicted, solved directly, and in time.

    The tolerances [dB] follow from `field_error`: they are larger where less vibration is left.
    """

    placed: Placement
    predicted_level_db_sl: float
    predicted_contrast_db: float
    direct_level_db_sl: float
    direct_contrast_db: float
    contrast_in_time_db: float
    level_tolerance_db: float
    contrast_tolerance_db: float

    @property
    def is_passed(self) -> bool:
        """Whether all are within their tolerances; False for NaN."""
        level = abs(self.direct_level_db_sl - self.predicted_level_db_sl)
        contrast = abs(self.direct_contrast_db - self.predicted_contrast_db)
        predicted, in_time = (
            min(each, MAX_CONTRAST_IN_TIME_DB)
            for each in (self.predicted_contrast_db, self.contrast_in_time_db)
        )
        return (
            level <= self.level_tolerance_db
            and contrast <= self.contrast_tolerance_db
            and abs(in_time - predicted) <= self.time_tolerance_db
        )

    @property
    def time_tolerance_db(self) -> float:
        """Tolerance of the contrast in time."""
        return TIME_TOLERANCE_DB + self.contrast_tolerance_db


@dataclass(frozen=True)
class PromiseCheck:
    """Share of exact plates on which answers keep their promised felt contrast."""

    kept_share: float
    plate_count: int

    @property
    def is_passed(self) -> bool:
        """Whether enough plates keep it."""
        return self.kept_share >= MIN_KEPT_SHARE


@dataclass(frozen=True)
class Verification:
    """The checks of all recomputed content and answers."""

    content: tuple[ContentCheck, ...]
    answer_checks: tuple[AnswerCheck, ...]
    promise: PromiseCheck

    @property
    def checks(self) -> tuple[ContentCheck | AnswerCheck | PromiseCheck, ...]:
        """All checks."""
        return (*self.content, *self.answer_checks, self.promise)

    @property
    def failed_count(self) -> int:
        """Number of failed checks."""
        return [check.is_passed for check in self.checks].count(False)

    def as_json(self) -> dict[str, Any]:
        """Return all checks for programs."""
        return {
            "content": [
                {"what": check.name, "relative_error": check.error, "passed": check.is_passed}
                for check in self.content
            ],
            "answers": [
                {
                    "target_m": list(answer.placed.targets[0]),
                    "quiet_m": [list(place) for place in answer.placed.quiet],
                    "predicted_level_db_sl": answer.predicted_level_db_sl,
                    "direct_level_db_sl": answer.direct_level_db_sl,
                    "level_tolerance_db": answer.level_tolerance_db,
                    "predicted_contrast_db": answer.predicted_contrast_db,
                    "direct_contrast_db": answer.direct_contrast_db,
                    "contrast_tolerance_db": answer.contrast_tolerance_db,
                    "contrast_in_time_db": answer.contrast_in_time_db,
                    "time_tolerance_db": answer.time_tolerance_db,
                    "passed": answer.is_passed,
                }
                for answer in self.answer_checks
            ],
            "promise": {
                "kept_share": self.promise.kept_share,
                "plates": self.promise.plate_count,
                "passed": self.promise.is_passed,
            },
            "failed": self.failed_count,
        }


def field_error(table: LocalizationTable, frequency: float) -> float:
    """Return the error of raster and mesh between their points, and of fingers on them.

    Relative to the field's root mean square. Polynomials of high degree have next to none; elements
    of the first order make straight lines of a wave, the raster does not. Modes that change with
    frequency are computed one by one.
    """
    finger = 0.0 if table.fingertip is None else FINGER_ERROR
    return (
        RASTER_ERROR
        + _modal_error(table)
        + finger
        + table.mesh.interpolation_error(table.plate, frequency)
    )


def _modal_error(table: LocalizationTable) -> float:
    if table.plate.surface is not None:
        return UNKNOWN_MODES_ERROR
    return 0.0 if table.modal_dispersion is None else MODAL_ERROR


def verify_table(
    table: LocalizationTable,
    rig: Rig,
    *,
    samples: int = 12,
    seed: int = 0,
    progress: Progress = unseen,
) -> Verification:
    """Recompute content and answers to random contacts, with 1, 2, 3 quiet ones in turn.

    The rig must be the table's own: check the fingerprint when loading. samples: number of answers;
    progress: called with the number of answers done and the total. Raises InputError if no contacts
    have an answer.
    """
    rng = np.random.default_rng(seed)
    free = solve_free_plate(rig.plate, table.mesh, frequency_max=float(table.frequencies[-1]))
    respond: Responder = free.acceleration
    if isinstance(table.mesh, SpectralMesh) and not rig.plate.mode_deviations:  # without modes
        respond = partial(direct_spectral_acceleration, rig.plate, table.mesh)
    content = tuple(_check_content(table, rig, respond, rng))
    answer_checks, kept = [], []
    for number in range(samples):
        answer = _random_answer(table, rng, others=1 + number % 3)
        answer_checks.append(_check_answer(table, rig, free, respond, answer))
        kept.append(_kept_share(table, answer, rng))
        progress(number + 1, samples)
    promise = PromiseCheck(float(np.mean(kept)), samples * PLATES)
    return Verification(content, tuple(answer_checks), promise)


def _kept_share(table: LocalizationTable, answer: Answer, rng: np.random.Generator) -> float:
    """Return the share of exact plates on which an answer keeps its promised felt contrast."""
    layer, promise = answer.layers[0], answer.fingers[0].promised_contrast_db
    plates = draw_plates(
        rng,
        table.uncertainty,
        count=PLATES,
        of=table,
        contact_count=len(answer.fingers),
    )
    _, contrast = felt_on(table, answer.placement(layer), layer.excitation, plates)
    if contrast is None or promise is None:
        return math.nan
    return float((decibels(contrast) >= promise - ROUNDING_DB).mean())


def _check_content(
    table: LocalizationTable, rig: Rig, respond: Responder, rng: np.random.Generator
) -> Iterator[ContentCheck]:
    """Check fields on the raster and at the cells at some random frequencies."""
    count = min(SAMPLED_FREQUENCIES, len(table.frequencies))
    chosen = np.sort(rng.choice(len(table.frequencies), count, replace=False))
    on_raster = table.raster.points[table.plate.covers(table.raster.points)]
    points = np.concatenate([on_raster, table.cell_centres])
    exact = respond(rig.eras, table.frequencies[chosen], points, loads=rig.masses)
    exact = table.allowed_shares[chosen, None, None] * exact
    there, at_cells = np.split(exact, [len(on_raster)], axis=2)
    found = table.unit_fields(on_raster)[chosen]
    tolerance = CONTENT_TOLERANCE + _modal_error(table)
    yield ContentCheck("fields on the raster", _relative(found, there), tolerance)
    between = table.mesh.interpolation_error(rig.plate, float(table.frequencies[-1]))
    found = table.unit_fields(table.cell_centres)[chosen]
    tolerance += RASTER_ERROR + between
    yield ContentCheck("fields at the cells", _relative(found, at_cells), tolerance)


def _relative(found: NDArray[Any], exact: NDArray[Any]) -> float:
    """Return the worst relative L2 error along the last axis."""
    size = np.linalg.norm(exact, axis=-1)
    return float((np.linalg.norm(found - exact, axis=-1) / size).max())


def _check_answer(
    table: LocalizationTable, rig: Rig, free: FreePlate, respond: Responder, answer: Answer
) -> AnswerCheck:
    """Recompute an answer with its fingers on the plate, at frequencies and in time."""
    layer, target = answer.layers[0], answer.fingers[0]
    placed = answer.placement(layer)
    contacts = placed.contacts
    discs = np.concatenate([fingertip_points(*each, rig.plate) for each in contacts])
    weights = fingertip_weights(*contacts[0], rig.plate)
    count = len(weights)
    centres = _ALL_OVER.centres(rig.plate)
    points = np.concatenate([discs, centres[rig.plate.covers(centres)]])
    fingers = fingertip_loads(rig.fingertip, contacts, placed.loads)
    frequencies, everywhere = tone_fields(
        layer.excitation,
        rig.eras,
        lambda f: respond(rig.eras, f, points, loads=[*rig.masses, *fingers]),
    )
    direct, rest = np.split(everywhere, [len(discs)], axis=1)
    attached = footprints_of(rig.eras, rig.masses, fingers)
    plate = plate_in_time(
        reduce_free_plate(free, attached), rig.eras, loads=rig.masses, contacts=fingers
    )
    in_time = steady_in_time(plate, Transients(plate), layer.excitation, discs)
    threshold = detection_threshold(frequencies, table.threshold)[:, None]
    felt, felt_in_time, felt_elsewhere = (
        np.linalg.norm(tones / threshold, axis=0) for tones in (direct, in_time, rest)
    )
    error = field_error(table, float(frequencies[-1]))
    error *= math.sqrt(float((felt_elsewhere**2).mean()))
    at_target = float(decibels(1 + error / (felt[:count] @ weights)))
    at_quiet = float(decibels(1 + error / felt[count:].max()))
    contrast = target.contrast_db
    return AnswerCheck(
        placed,
        target.level_db_sl,
        predicted_contrast_db=math.nan if contrast is None else contrast,
        direct_level_db_sl=float(decibels(felt[:count] @ weights)),
        direct_contrast_db=_contrast(felt, weights),
        contrast_in_time_db=_contrast(felt_in_time, weights),
        level_tolerance_db=ROUNDING_DB + at_target,
        contrast_tolerance_db=ROUNDING_DB + at_target + at_quiet,
    )


def steady_in_time(
    plate: PlateInTime, transients: Transients, excitation: Excitation, points: FloatArray
) -> FloatArray:
    """Return amplitudes (f, p) [m/s²] at points [m] long after an excitation started from rest."""
    slowest = -float(plate.eigenvalues.real.max())
    settled = -math.log(_REMAINING) / slowest if slowest > 0 else _MAX_DURATION
    duration = min(settled, _MAX_DURATION) + _WINDOW
    bases = ramped_onset(excitation, plate.eras, ramp=0.02)
    felt = transients.acceleration(bases, points, duration=duration)
    last = round(_WINDOW * SAMPLE_RATE)
    times = np.arange(len(felt) - last, len(felt)) / SAMPLE_RATE
    frequencies, _ = base_amplitudes(excitation, plate.eras)
    phases = 2 * np.pi * np.outer(times, frequencies)
    fitted, *_ = np.linalg.lstsq(np.hstack([np.cos(phases), np.sin(phases)]), felt[-last:])
    return np.asarray(np.hypot(*np.split(fitted, 2)))


def _contrast(felt: FloatArray, weights: FloatArray) -> float:
    """Return the felt contrast [dB] of a target, whose points come first, with their weights."""
    target, quiet = np.split(felt, [len(weights)])
    return float(contrast_db([target], quiet, [weights]))


def _random_answer(table: LocalizationTable, rng: np.random.Generator, *, others: int) -> Answer:
    """Return the table's answer to random contacts 5 cm apart; fewer if they do not fit."""
    for tries in range(1000):
        count = 1 + max(1, others - tries // 200)
        with contextlib.suppress(InputError):
            contacts = random_contacts(rng, count, table.plate, tries=1)
            answer = query(table, Placement(contacts[:1], contacts[1:]))
            if answer.is_reached:
                return answer
    length, width = table.plate.length, table.plate.width
    raise InputError(
        f"no random contacts on this plate of {length:g} x {width:g} m have an answer at 20 dB "
        "SL to verify; is it smaller than two fingers, or its stroke too small?"
    )


def promise_margins(rig: Rig, plate: Rig) -> tuple[float, ...]:
    """Return margins [dB] of contrasts over the promises of a rig's table, on another plate.

    For random fingers, on the exactly solved plate. Empty if the rig has no table or no room for
    four fingers.
    """
    rng, margins = np.random.default_rng(0), []
    try:
        table = build_table(rig, drive_mode="phased")
        there = build_table(plate, frequencies=table.frequencies, drive_mode="phased")
        for number in range(_ANSWERS):
            fingers = 2 + number % 3
            places = random_contacts(rng, fingers, rig.plate)
            placed = Placement(places[:1], places[1:])
            answer = query(table, placed)
            none = Uncertainty.none()
            exact = draw_plates(rng, none, of=there, count=1, contact_count=fingers)
            _, felt = felt_on(there, placed, answer.layers[0].excitation, exact)
            promised = answer.fingers[0].promised_contrast_db
            assert felt is not None  # noqa: S101  there are quiet fingers
            assert promised is not None  # noqa: S101
            margins.append(float(20 * np.log10(felt[0])) - promised)
    except InputError:
        return ()
    return tuple(margins)


_EXPECTED_PLATES = 60
_MARGIN = 0.013  # m, of fingers from the edges


@dataclass(frozen=True)
class ExpectedContrast:
    """Contrast [dB] with a number of quiet fingers, medians over sets of contacts."""

    quiet: int
    before: float
    """Given by half of the plates like the identified one, with answers of the rig as written."""
    after: float
    """The same with answers of the identified rig."""
    promised: float
    """Contrast that 90 % of the plates have with answers of the identified rig."""


def expected_contrast(
    before: Rig, after: Rig, *, seed: int, frequencies: FloatArray | None = None, sets: int = 12
) -> list[ExpectedContrast]:
    """Expect contrasts for one, two and three quiet fingers; the same for the same seed.

    before, after: the rig as written and as identified, on plates within whose uncertainty they
    are; frequencies (f,) [Hz]: of the tables, by default the usual ones; sets: of contacts.
    """
    written, identified = (
        build_table(rig, frequencies=frequencies, drive_mode="phased") for rig in (before, after)
    )
    expected, plate = [], identified.plate
    shorter = min(plate.length, plate.width)
    margin = min(_MARGIN, shorter / 4)
    for quiet in (1, 2, 3):
        rng = np.random.default_rng([seed, quiet])
        apart = min(MIN_DISTANCE, shorter / (2 * (quiet + 1)))
        rows = []
        for _ in range(sets):
            places = random_contacts(rng, quiet + 1, plate, margin=margin, apart=apart)
            placed = Placement(places[:1], places[1:])
            plates = draw_plates(
                rng,
                identified.uncertainty,
                count=_EXPECTED_PLATES,
                of=identified,
                contact_count=quiet + 1,
            )
            felt = []
            for table in (written, identified):
                drive = query(table, placed, MIN_LEVEL_DB_SL).layers[0].excitation
                _, contrast = felt_on(identified, placed, drive, plates)
                assert contrast is not None  # noqa: S101  there are quiet fingers
                felt.append(20 * np.log10(contrast))
            rows.append((*np.median(felt, axis=1), np.percentile(felt[1], PERCENTILE)))
        expected.append(ExpectedContrast(quiet, *np.median(rows, axis=0).tolist()))
    return expected
