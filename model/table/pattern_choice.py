"""Choice of the pattern to play at given contacts.

The search ranks drives by their expected powers; the best few are judged by drawn plates: level at
nine of ten goes first, then felt contrast. The promise is of other draws.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray, IntArray
from model.choice import best_first, best_of
from model.drive_modes import ALTERNATIVES, UNRESTRICTED, find_drives, max_sensation
from model.drive_modes.coherent import CoherentResult
from model.drive_modes.forms import Forms, Weights
from model.drive_modes.phased import PHASED
from model.drive_modes.tones import excitation_of
from model.ensemble.measures import Felt, percentile, percentile_of_sorted
from model.errors import InputError
from model.finger.perception import decibels
from model.structure.attachments import Era
from model.table.contents import (
    JUDGING_DRAWS,
    ONSET_MARGIN_DB,
    ONSET_WEIGHT,
    PROMISED_DRAWS,
    PROMISED_PERCENTILE,
    REACHED,
    Tones,
)
from model.table.fingers_on_plate import (
    CENTRE_AND_FOUR,
    MAX_FINGERS_BY_POINT,
    FingersOnPlate,
)
from model.table.pattern import ONSET_RAMP, Pattern
from model.table.pulse_gains import OverEffect, contrast_over_effect
from model.table.question import Question
from model.transients.onset import RampedRinging

MAX_DURING_EFFECT = 3
"""Drives that are rated by what is felt over a short effect, and as many at their frequencies."""

_PERCENTS = (PROMISED_PERCENTILE, 50, 100 - PROMISED_PERCENTILE)

_NEARLY = 10 ** (-1 / 20)  # within a decibel

OnsetContrast: TypeAlias = Callable[[IntArray, Complex64Array], FloatArray | None]
"""Contrast of ramped onsets (n,) for indices of frequencies (n,) and weights of ERAs (n, eras).

None where the plate cannot be solved in time.
"""


class UnreachableLevel(InputError):
    """A level that no pattern reaches at the targets.

    reachable_db_sl: one that is reached; is_exhaustive: whether no higher one is.
    """

    def __init__(
        self, question: Question, drive_mode: str, reachable_db_sl: float, *, is_exhaustive: bool
    ) -> None:
        self.reachable_db_sl = reachable_db_sl
        self.is_exhaustive = is_exhaustive
        where = " and ".join(f"({x:g}, {y:g})" for x, y in question.targets)
        what = "the highest level is" if is_exhaustive else "the highest level found is"
        super().__init__(
            f"level at {where} m must be reachable in mode {drive_mode}, got "
            f"{question.level_db_sl:g} dB SL; {what} {reachable_db_sl:.1f} dB SL"
        )


@dataclass(frozen=True, eq=False)
class Candidates:
    """What to choose from: rows (f,) of the table's frequencies [Hz] that may be played.

    background (rows, eras, eras): mean power of the rest of the plate, for no quiet finger;
    threshold (rows,) [m/s²], and its name; over_effect: gains over the duration of a short effect,
    None for a steady vibration; ringing: of the plate over it, None where it cannot be solved.
    """

    eras: tuple[Era, ...]
    frequencies: FloatArray
    playable: IntArray
    fingers: FingersOnPlate
    background: Complex64Array | None
    threshold: Float32Array
    threshold_name: str
    onset_contrast: OnsetContrast
    over_effect: OverEffect | None
    ringing: RampedRinging | None


def choose_pattern(question: Question, drive_mode: str, candidates: Candidates) -> Pattern:
    """Choose the best pattern of a drive mode that reaches the level at the targets.

    At nine of ten plates where possible, else at the nominal plate. Raises InputError where
    none does.
    """
    forms = _forms(question, candidates)
    for some in (forms, replace(forms, level_margin=0.0)):
        found = _search(question, drive_mode, candidates, some)
        if found:
            return _best(question, drive_mode, candidates, found)
    raise _level_error(question, drive_mode, max_sensation(forms, drive_mode))


def pattern_of(
    question: Question,
    tones: Tones,
    *,
    eras: Sequence[Era],
    frequencies: FloatArray,
    thresholds: Float32Array,
    threshold_name: str,
    background: Complex64Array | None,
) -> Pattern:
    """The pattern of the only content's tone; its level is that of the weakest target.

    thresholds (f,) [m/s²], background (f, eras, eras): as of `Candidates`, at all frequencies.
    """
    nominal = min(tones.level_db_sl[target][0] for target in range(len(question.targets)))
    pattern = partial(
        Pattern,
        excitation=excitation_of(
            [(tones.rows[0], tones.weights[0])], eras, frequencies, gain=tones.gains[0]
        ),
        ramp=ONSET_RAMP,
        level_db_sl=nominal,
        robust_level_db_sl=question.level_db_sl + float(decibels(tones.stroke_factor)),
        drive_mode=UNRESTRICTED,
        threshold=threshold_name,
    )
    if background is not None:
        weights: ComplexArray = np.multiply(tones.gains[0], tones.weights[0])
        drive = [(tones.rows[0], weights)]
        around = _level_around(drive, background, thresholds)
        return pattern(
            contrast_db=None, quiet_level_db_sl=None, surroundings_contrast_db=nominal - around
        )
    contrast, median, promised = tones.contrast_db[0]
    return pattern(
        contrast_db=contrast,
        quiet_level_db_sl=nominal - contrast,
        robust_quiet_level_db_sl=tones.loudest_db_sl,
        robust_contrast_db=promised,
        robust_felt_contrast_db=promised,
        median_felt_contrast_db=median,
    )


def _level_around(
    drive: Sequence[tuple[int, ComplexArray | Complex64Array]],
    background: Complex64Array,
    thresholds: Float32Array,
) -> float:
    """Level [dB SL] of the rest of the plate, root mean square, of weights by row."""
    power = sum(
        float(np.vdot(w, background[row] @ w).real) / float(thresholds[row]) ** 2
        for row, w in drive
    )
    return float(decibels(math.sqrt(max(power, 1e-60))))


def _forms(question: Question, candidates: Candidates) -> Forms:
    """Forms to search, at the playable frequencies."""
    playable = candidates.playable
    forms = candidates.fingers.forms(candidates.background)
    if candidates.ringing is not None and question.quiet:
        forms = candidates.fingers.forms_over(candidates.ringing)
    return forms.at(playable) if len(playable) < forms.frequency_count else forms


def _search(
    question: Question, drive_mode: str, candidates: Candidates, forms: Forms
) -> list[tuple[float, Weights]]:
    """The drives of the best scores, and further ones at their frequencies."""
    is_steady = candidates.over_effect is None
    if drive_mode == "switched" and is_steady and 1 <= len(question.quiet) <= MAX_FINGERS_BY_POINT:
        forms = candidates.fingers.by_point(forms, candidates.playable, CENTRE_AND_FOUR)
    found = find_drives(forms, drive_mode)
    if not found:
        return []
    if candidates.over_effect is not None and question.quiet:
        found = found[:MAX_DURING_EFFECT]
        return found + _during_effect(question, drive_mode, candidates, forms, found)
    return found + _by_point(question, drive_mode, candidates, forms)


def _best(
    question: Question,
    drive_mode: str,
    candidates: Candidates,
    found: Sequence[tuple[float, Weights]],
) -> Pattern:
    """The pattern of the drive that drawn plates prefer."""
    playable = candidates.playable
    scores = np.array([score for score, _ in found])
    drives = [each for _, each in found]
    if len(playable) < len(candidates.frequencies):
        drives = [replace(each, frequencies=_rows(each, playable)) for each in drives]
    best = _judged(question, drives, scores, candidates)
    return _pattern(question, drive_mode, candidates, drives[best])


def _by_point(
    question: Question,
    drive_mode: str,
    candidates: Candidates,
    forms: Forms,
) -> list[tuple[float, Weights]]:
    """Drives that minimise over the points of the quiet fingers.

    Where nulls are narrow, with few fingers and small errors, these do better.
    """
    if drive_mode != UNRESTRICTED:
        return []
    if not 1 <= len(question.quiet) <= MAX_FINGERS_BY_POINT:
        return []
    by_point = candidates.fingers.by_point(forms, candidates.playable)
    found = _drives_of(PHASED.search(by_point), np.arange(forms.frequency_count))
    return [found[each] for each in best_first([score for score, _ in found])[:ALTERNATIVES]]


def _during_effect(
    question: Question,
    drive_mode: str,
    candidates: Candidates,
    forms: Forms,
    drives: Sequence[tuple[float, Weights]],
) -> list[tuple[float, Weights]]:
    """Drives at the same frequencies that minimise what is felt over a short effect.

    On the plate with the fingers on it, whose ringing takes too long to solve at every frequency.
    """
    if drive_mode != UNRESTRICTED or candidates.over_effect is None:
        return []
    at = _rows_of([drive for _, drive in drives])
    responses = candidates.over_effect.responses(candidates.playable[at])
    return _drives_of(PHASED.search_all(candidates.fingers.forms_during(responses)), at)


def _rows_of(drives: Sequence[Weights]) -> IntArray:
    """Frequencies of drives, by index, ascending."""
    return np.array(sorted({row for drive in drives for row, _ in drive.tones()}), dtype=int)


def _drives_of(found: CoherentResult, rows: IntArray) -> list[tuple[float, Weights]]:
    """The drives at rows (n,) of frequencies that reach the level, with their scores."""
    return [
        (score, Weights.at(row, weights))
        for row, score, weights in zip(
            rows.tolist(), found.score.tolist(), found.weights, strict=True
        )
        if score > 0
    ]


def _rows(drive: Weights, playable: IntArray) -> IntArray:
    """Frequencies of a drive as rows of the table, SILENT as it is."""
    return np.where(drive.frequencies < 0, drive.frequencies, playable[drive.frequencies])


def _judged(
    question: Question,
    drives: Sequence[Weights],
    scores: FloatArray,
    candidates: Candidates,
) -> int:
    """Index of the drive that drawn plates prefer.

    Without quiet fingers the score counts, and as much a level that is much the same on all plates.
    """
    if len(drives) == 1:
        return 0
    judged = candidates.fingers.felt(drives, JUDGING_DRAWS)
    if candidates.over_effect is not None:
        return _judged_over_effect(question, drives, scores, judged, candidates.over_effect)
    least = percentile(judged.level[:, 1:])
    reaches = least >= 10 ** (question.level_db_sl / 20) * REACHED
    if not reaches.any():
        reaches[:] = True
    if judged.contrast is None:
        steadiness = least / percentile(judged.level[:, 1:], 50)
        return best_of(reaches * scores * steadiness)
    robust = np.where(reaches, percentile(judged.contrast.felt[:, 1:]), 0.0)
    best = best_of(robust)
    if question.envelopes:
        return best
    near = np.flatnonzero(robust >= 10 ** (-ONSET_MARGIN_DB / 20) * robust[best]).tolist()
    near = [each for each in near if len(drives[each].tones()) == 1]
    if len(near) > 1 and best in near:
        tones = [drives[each].tones()[0] for each in near]
        contrast = candidates.onset_contrast(
            np.array([index for index, _ in tones]), np.array([weights for _, weights in tones])
        )
        if contrast is not None:
            best = near[best_of(robust[near] * contrast**ONSET_WEIGHT)]
    return best


def _judged_over_effect(
    question: Question,
    drives: Sequence[Weights],
    scores: FloatArray,
    judged: Felt,
    over_effect: OverEffect,
) -> int:
    """Index of the drive of the best contrast over the duration of an effect.

    Of those that reach the level over it on the nominal plate, or come near the strongest.
    """
    responses = over_effect.responses(_rows_of(drives))
    gains = [responses.gains(drive) for drive in drives]
    lag = 10 ** (np.array([min(each.targets) for each in gains]) / 20)
    level = judged.level[:, 0] * lag
    near = min(10 ** (question.level_db_sl / 20) * REACHED, level.max() * _NEARLY)
    if judged.contrast is None:
        return best_of((level >= near) * scores * lag)
    quiet = 10 ** (np.array([each.quiet_db_sl for each in gains]) / 20)
    felt = judged.contrast.felt
    contrast = contrast_over_effect(level / quiet, felt[:, 0], percentile(felt[:, 1:]))
    return best_of((level >= near) * contrast)


def _level_error(question: Question, drive_mode: str, reachable: float) -> UnreachableLevel:
    is_exhaustive = drive_mode == "switched" or len(question.targets) == 1
    # Rounded down, so that the level named can be reached.
    level = math.floor(10 * float(decibels(reachable))) / 10
    return UnreachableLevel(question, drive_mode, level, is_exhaustive=is_exhaustive)


def _pattern(
    question: Question, drive_mode: str, candidates: Candidates, drive: Weights
) -> Pattern:
    """The pattern of a drive, turned down to the wanted level at nine of ten plates."""
    drawn = candidates.fingers.felt([drive], PROMISED_DRAWS)
    measures = [drawn.level]
    if drawn.contrast is not None:
        measures += [drawn.contrast.loudest, drawn.contrast.acceleration, drawn.contrast.felt]
    each = np.concatenate(measures)
    ordered = np.sort(each[:, 1:], axis=1)
    levels = [percentile_of_sorted(ordered, percent) for percent in _PERCENTS]
    nominal, robust, median, highest = decibels(np.array([each[:, 0], *levels])).tolist()
    gain_db = min(0.0, question.level_db_sl - robust[0])
    gain = 10 ** (gain_db / 20)
    tones = [(row, weights.tolist()) for row, weights in drive.tones()]
    pattern = partial(
        Pattern,
        excitation=excitation_of(tones, candidates.eras, candidates.frequencies, gain=gain),
        ramp=ONSET_RAMP,
        level_db_sl=gain_db + nominal[0],
        robust_level_db_sl=gain_db + robust[0],
        drive_mode=drive_mode,
        threshold=candidates.threshold_name,
    )
    if candidates.background is not None:
        around = _level_around(drive.tones(), candidates.background, candidates.threshold)
        surroundings = nominal[0] - around
        return pattern(
            contrast_db=None, quiet_level_db_sl=None, surroundings_contrast_db=surroundings
        )
    if drawn.contrast is None:
        return pattern(contrast_db=None, quiet_level_db_sl=None)
    return pattern(
        contrast_db=nominal[2],
        quiet_level_db_sl=gain_db + nominal[1],
        robust_quiet_level_db_sl=gain_db + highest[1],
        robust_contrast_db=robust[2],
        robust_felt_contrast_db=robust[3],
        median_felt_contrast_db=median[3],
    )
