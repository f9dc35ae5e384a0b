"""Verify a table: recompute a sample of its content, answers and promises by other methods.

- Content: fields on the sampling grid and at the cells, against the plate solved at each frequency
  without modes (`model.spectral.direct_solution`), relative L2. With finite elements or measured
  modes, against the free plate solved again with the ERAs attached (`model.reduction.free_plate`).
- Answers: level and contrast at random contacts, against the same solution with the fingers
  attached.
- Answers in time: amplitudes at the fingertips after the pattern, started from rest on the plate in
  time (`model.transients.plate_in_time`), has settled. Contrast above 25 dB counts as 25 dB: in a
  null, hysteretic and viscous damping differ by more than the remaining vibration.
- Promises: the felt contrast on 90 % of exactly solved plates (`model.study.exact_plates`).
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import Answer
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray
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
from model.rig.rig import Rig
from model.spectral.direct_solution import Responder, direct_spectral_acceleration
from model.spectral.plate_mesh import SpectralMesh
from model.structure.attachments import footprints_of
from model.structure.fingertips import FingertipLoad, fingertip_loads
from model.study.contact_sets import random_contacts
from model.study.exact_plates import draw_plates, felt_on
from model.table.table import LocalizationTable
from model.transients.base_motion import ramped_onset
from model.transients.plate_in_time import PlateInTime, plate_in_time
from model.transients.shaping import SAMPLE_RATE, Transients
from model.vibration import Excitation, base_amplitudes, tone_fields

CONTENT_TOLERANCE = 1e-4
"""Relative L2 error of the content; the paper's plate has some 1e-5, on its coarsest mesh 2e-5."""

MODAL_ERROR = 0.03
"""Error from coupling of modes by lossy layers and air, relative to the field."""

UNKNOWN_MODES_ERROR = 5e-3
"""Estimated error from unknown modes of a surface near points, relative to the field."""

ROUNDING_DB = 0.01

RASTER_ERROR = 2e-4
"""Interpolation error of a field on the sampling grid, relative to its root mean square."""

FINGER_ERROR = 7e-3
"""Error from the local deflection under fingers, relative to the field's root mean square."""

TIME_TOLERANCE_DB = 1.0
MAX_CONTRAST_IN_TIME_DB = 25.0

PLATES = 200
"""Number of plates drawn for each answer."""

MIN_KEPT_SHARE = 0.8
"""Fraction of plates that must keep a promise; 90 % are expected on average over answers."""

KEPT_SHARE_STD = 0.06
"""Standard deviation of this fraction between the answers of a table: 0.03 to 0.06 in the example
rigs. A mean over few answers can therefore be lower (`PromiseCheck.required_share`)."""

SAMPLED_FREQUENCIES = 3

_RMS_GRID = Grid(8, 6)  # points over which the root mean square of a field is taken
_ONSET_RAMP = 0.02  # s
_WINDOW = 0.25  # s, over which steady amplitudes are evaluated
_REMAINING = 1e-4  # maximum fraction of the free vibration at the start of the window
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
        level_error = abs(self.direct_level_db_sl - self.predicted_level_db_sl)
        contrast_error = abs(self.direct_contrast_db - self.predicted_contrast_db)
        predicted = min(self.predicted_contrast_db, MAX_CONTRAST_IN_TIME_DB)
        in_time = min(self.contrast_in_time_db, MAX_CONTRAST_IN_TIME_DB)
        return (
            level_error <= self.level_tolerance_db
            and contrast_error <= self.contrast_tolerance_db
            and abs(in_time - predicted) <= self.time_tolerance_db
        )

    @property
    def time_tolerance_db(self) -> float:
        """Tolerance of the contrast in time."""
        return TIME_TOLERANCE_DB + self.contrast_tolerance_db

    def as_json(self) -> dict[str, Any]:
        """Return the check for programs."""
        return {
            "target_m": list(self.placed.targets[0]),
            "quiet_m": [list(position) for position in self.placed.quiet],
            "predicted_level_db_sl": self.predicted_level_db_sl,
            "direct_level_db_sl": self.direct_level_db_sl,
            "level_tolerance_db": self.level_tolerance_db,
            "predicted_contrast_db": self.predicted_contrast_db,
            "direct_contrast_db": self.direct_contrast_db,
            "contrast_tolerance_db": self.contrast_tolerance_db,
            "contrast_in_time_db": self.contrast_in_time_db,
            "time_tolerance_db": self.time_tolerance_db,
            "passed": self.is_passed,
        }


@dataclass(frozen=True)
class PromiseCheck:
    """Share of exact plates on which answers keep their promised felt contrast."""

    kept_share: float
    """Mean over the answers."""
    answer_count: int

    @property
    def plate_count(self) -> int:
        """Number of plates on which the promises were checked."""
        return self.answer_count * PLATES

    @property
    def required_share(self) -> float:
        """Least share: MIN_KEPT_SHARE, or four standard errors below 90 % with few answers."""
        standard_error = KEPT_SHARE_STD / math.sqrt(self.answer_count)
        return min(MIN_KEPT_SHARE, 0.9 - 4 * standard_error)

    @property
    def is_passed(self) -> bool:
        """Whether enough plates keep their promise."""
        return self.kept_share >= self.required_share


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
            "answers": [check.as_json() for check in self.answer_checks],
            "promise": {
                "kept_share": self.promise.kept_share,
                "plates": self.promise.plate_count,
                "passed": self.promise.is_passed,
            },
            "failed": self.failed_count,
        }


def verify_table(
    table: LocalizationTable,
    rig: Rig,
    *,
    samples: int = 12,
    seed: int = 0,
    progress: Progress = unseen,
) -> Verification:
    """Recompute content and answers to random contacts, with 1, 2 and 3 quiet fingers in turn.

    The rig must be the table's own: check the fingerprint when loading. samples: number of answers.
    progress: called with the number of answers done and the total. Raises InputError if no contacts
    have an answer.
    """
    rng = np.random.default_rng(seed)
    free = solve_free_plate(rig.plate, table.mesh, frequency_max=float(table.frequencies[-1]))
    respond: Responder = free.acceleration
    if isinstance(table.mesh, SpectralMesh) and not rig.plate.mode_deviations:  # without modes
        respond = partial(direct_spectral_acceleration, rig.plate, table.mesh)
    content_checks = tuple(_check_content(table, rig, respond, rng))
    answer_checks, kept_shares = [], []
    for number in range(samples):
        answer = _random_answer(table, rng, quiet_count=1 + number % 3)
        answer_checks.append(_check_answer(table, rig, free, respond, answer))
        kept_shares.append(_kept_share(table, answer, rng))
        progress(number + 1, samples)
    promise_check = PromiseCheck(float(np.mean(kept_shares)), samples)
    return Verification(content_checks, tuple(answer_checks), promise_check)


def _random_answer(
    table: LocalizationTable, rng: np.random.Generator, *, quiet_count: int
) -> Answer:
    """Return the table's answer to random contacts 5 cm apart; with fewer if they do not fit."""
    for attempt in range(1000):
        contact_count = 1 + max(1, quiet_count - attempt // 200)
        with contextlib.suppress(InputError):
            contacts = random_contacts(rng, contact_count, table.plate, tries=1)
            answer = query(table, Placement(contacts[:1], contacts[1:]))
            if answer.is_reached:
                return answer
    length, width = table.plate.length, table.plate.width
    raise InputError(
        f"no random contacts on this plate of {length:g} x {width:g} m have an answer at 20 dB "
        "SL to verify; is it smaller than two fingers, or its stroke too small?"
    )


def _kept_share(table: LocalizationTable, answer: Answer, rng: np.random.Generator) -> float:
    """Return the share of exact plates on which an answer keeps its promised felt contrast."""
    layer, promised = answer.layers[0], answer.fingers[0].promised_contrast_db
    plates = draw_plates(
        rng,
        table.uncertainty,
        count=PLATES,
        of=table,
        contact_count=len(answer.fingers),
    )
    _, contrast = felt_on(table, answer.placement(layer), layer.excitation, plates)
    if contrast is None or promised is None:
        return math.nan
    is_kept = decibels(contrast) >= promised - ROUNDING_DB
    return float(is_kept.mean())


def _check_content(
    table: LocalizationTable, rig: Rig, respond: Responder, rng: np.random.Generator
) -> Iterator[ContentCheck]:
    """Check fields on the sampling grid and at the cells at some random frequencies."""
    count = min(SAMPLED_FREQUENCIES, len(table.frequencies))
    rows = np.sort(rng.choice(len(table.frequencies), count, replace=False))
    raster_points = table.raster.points[table.plate.covers(table.raster.points)]
    points = np.concatenate([raster_points, table.cell_centers])
    direct = respond(rig.eras, table.frequencies[rows], points, loads=rig.masses)
    direct = table.allowed_shares[rows, None, None] * direct
    direct_on_raster, direct_at_cells = np.split(direct, [len(raster_points)], axis=2)

    tolerance = CONTENT_TOLERANCE + _modal_error(table)
    on_raster = table.unit_fields(raster_points)[rows]
    error = _relative_error(on_raster, direct_on_raster)
    yield ContentCheck("fields on the raster", error, tolerance)

    interpolation_error = table.mesh.interpolation_error(rig.plate, float(table.frequencies[-1]))
    tolerance += RASTER_ERROR + interpolation_error
    at_cells = table.unit_fields(table.cell_centers)[rows]
    error = _relative_error(at_cells, direct_at_cells)
    yield ContentCheck("fields at the cells", error, tolerance)


def _relative_error(fields: NDArray[Any], exact: NDArray[Any]) -> float:
    """Return the worst relative L2 error along the last axis."""
    errors = np.linalg.norm(fields - exact, axis=-1) / np.linalg.norm(exact, axis=-1)
    return float(errors.max())


def _check_answer(
    table: LocalizationTable, rig: Rig, free: FreePlate, respond: Responder, answer: Answer
) -> AnswerCheck:
    """Recompute an answer with its fingers on the plate, in the frequency and time domains."""
    layer, target = answer.layers[0], answer.fingers[0]
    placed = answer.placement(layer)
    fingers = fingertip_loads(rig.fingertip, placed.contacts, placed.loads)
    discs = [fingertip_points(*contact, rig.plate) for contact in placed.contacts]
    finger_points = np.concatenate(discs)
    rms_points = _RMS_GRID.centers(rig.plate)
    rms_points = rms_points[rig.plate.covers(rms_points)]
    points = np.concatenate([finger_points, rms_points])
    frequencies, amplitudes = tone_fields(
        layer.excitation,
        rig.eras,
        lambda f: respond(rig.eras, f, points, loads=[*rig.masses, *fingers]),
    )
    at_fingers, over_plate = np.split(amplitudes, [len(finger_points)], axis=1)
    in_time = _steady_amplitudes(rig, free, fingers, layer.excitation, finger_points)

    felt_by_set = [
        _DirectSensation.of(
            at_fingers, in_time, over_plate, detection_threshold(frequencies, threshold_set)
        )
        for threshold_set in table.threshold_sets
    ]
    weights = fingertip_weights(*placed.targets[0], rig.plate)
    error = field_error(table, float(frequencies[-1]))
    # The level is relative to the rig's own set; the contrast is promised for every set.
    by_own_set = felt_by_set[0]
    by_worst_set = min(felt_by_set, key=lambda felt: felt.contrast_db(weights))
    predicted_contrast = target.contrast_db
    return AnswerCheck(
        placed,
        predicted_level_db_sl=target.level_db_sl,
        predicted_contrast_db=math.nan if predicted_contrast is None else predicted_contrast,
        direct_level_db_sl=by_own_set.level_db_sl(weights),
        direct_contrast_db=by_worst_set.contrast_db(weights),
        contrast_in_time_db=min(felt.contrast_in_time_db(weights) for felt in felt_by_set),
        level_tolerance_db=by_own_set.level_tolerance_db(weights, error),
        contrast_tolerance_db=by_worst_set.contrast_tolerance_db(weights, error),
    )


@dataclass(frozen=True, eq=False)
class _DirectSensation:
    """Vibration at the fingers of an answer, as ratios of amplitude to the thresholds of a set.

    The target's points come first; their weights (p,) are `fingertip_weights`.
    """

    at_fingers: FloatArray
    """At the points of all fingers."""
    in_time: FloatArray
    """The same in the time domain."""
    plate_rms: float
    """Root mean square over the plate."""

    @classmethod
    def of(
        cls,
        at_fingers: ComplexArray,
        in_time: FloatArray,
        over_plate: ComplexArray,
        thresholds: FloatArray,
    ) -> "_DirectSensation":
        """Relate amplitudes (f, points) to thresholds (f,), both [m/s²]; powers of tones add."""
        per_tone = thresholds[:, None]
        felt_over_plate = np.linalg.norm(over_plate / per_tone, axis=0)
        return cls(
            np.linalg.norm(at_fingers / per_tone, axis=0),
            np.linalg.norm(in_time / per_tone, axis=0),
            math.sqrt(float((felt_over_plate**2).mean())),
        )

    def level_db_sl(self, weights: FloatArray) -> float:
        """Return the level of the target."""
        return float(decibels(self._at_target(weights)))

    def contrast_db(self, weights: FloatArray) -> float:
        """Return the felt contrast of the target."""
        return _contrast(self.at_fingers, weights)

    def contrast_in_time_db(self, weights: FloatArray) -> float:
        """Return the felt contrast of the target in the time domain."""
        return _contrast(self.in_time, weights)

    def level_tolerance_db(self, weights: FloatArray, error: float) -> float:
        """Return the tolerance of the level for a relative error of the field."""
        return ROUNDING_DB + self._error_db(error, self._at_target(weights))

    def contrast_tolerance_db(self, weights: FloatArray, error: float) -> float:
        """Return the tolerance of the contrast for a relative error of the field."""
        loudest_quiet = float(self.at_fingers[len(weights) :].max())
        return self.level_tolerance_db(weights, error) + self._error_db(error, loudest_quiet)

    def _at_target(self, weights: FloatArray) -> float:
        return float(self.at_fingers[: len(weights)] @ weights)

    def _error_db(self, error: float, amplitude: float) -> float:
        return float(decibels(1 + error * self.plate_rms / amplitude))


def field_error(table: LocalizationTable, frequency: float) -> float:
    """Return the error of fields between points of the grid and mesh, and under fingers.

    Relative to the field's root mean square. The error is almost zero for polynomials of high
    degree. Elements of the first order replace a wave by straight lines. Modes that depend on the
    frequency are computed individually.
    """
    finger_error = 0.0 if table.fingertip is None else FINGER_ERROR
    interpolation_error = table.mesh.interpolation_error(table.plate, frequency)
    return RASTER_ERROR + _modal_error(table) + finger_error + interpolation_error


def _modal_error(table: LocalizationTable) -> float:
    if table.plate.surface is not None:
        return UNKNOWN_MODES_ERROR
    return 0.0 if table.modal_dispersion is None else MODAL_ERROR


def _contrast(felt: FloatArray, weights: FloatArray) -> float:
    """Return the felt contrast [dB] of a target, whose points come first, with their weights."""
    target, quiet = np.split(felt, [len(weights)])
    return float(contrast_db([target], quiet, [weights]))


def _steady_amplitudes(
    rig: Rig,
    free: FreePlate,
    fingers: Sequence[FingertipLoad],
    excitation: Excitation,
    points: FloatArray,
) -> FloatArray:
    """Return steady amplitudes (f, p) [m/s²] at points on the rig's plate in time."""
    attached = footprints_of(rig.eras, rig.masses, fingers)
    reduced = reduce_free_plate(free, attached)
    plate = plate_in_time(reduced, rig.eras, loads=rig.masses, contacts=fingers)
    return steady_in_time(plate, Transients(plate), excitation, points)


def steady_in_time(
    plate: PlateInTime, transients: Transients, excitation: Excitation, points: FloatArray
) -> FloatArray:
    """Return amplitudes (f, p) [m/s²] at points [m] long after an excitation started from rest."""
    slowest_decay = -float(plate.eigenvalues.real.max())  # 1/s
    settling_time = _MAX_DURATION
    if slowest_decay > 0:
        settling_time = min(-math.log(_REMAINING) / slowest_decay, _MAX_DURATION)
    bases = ramped_onset(excitation, plate.eras, ramp=_ONSET_RAMP)
    acceleration = transients.acceleration(bases, points, duration=settling_time + _WINDOW)
    window_length = round(_WINDOW * SAMPLE_RATE)
    samples = np.arange(len(acceleration) - window_length, len(acceleration))
    frequencies, _ = base_amplitudes(excitation, plate.eras)
    phases = 2 * np.pi * np.outer(samples / SAMPLE_RATE, frequencies)
    harmonics = np.hstack([np.cos(phases), np.sin(phases)])
    coefficients, *_ = np.linalg.lstsq(harmonics, acceleration[-window_length:])
    cosines, sines = np.split(coefficients, 2)
    return np.asarray(np.hypot(cosines, sines))
