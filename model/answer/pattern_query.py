"""From a question to its pattern: the answer with an only content, in any drive mode.

In mode `phased` it is that of `model.answer.search_in_c`. Patterns of `switched`, and short
effects, have candidates of their own, which are judged by the same draws.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from model.answer.fingers_on_plate import FingerForms, FingersOnPlate
from model.answer.pattern import ONSET_RAMP, Pattern
from model.answer.promised import promised
from model.answer.pulse_gains import OverEffect
from model.answer.question import MIN_LEVEL_DB_SL, Question
from model.answer.search import Contents, Stream, Tones
from model.answer.search_in_c import choose_tones
from model.answer.search_in_numpy import best_tone
from model.answer.short_effects import best_over_effect, forms_during, forms_over
from model.arrays import Complex64Array, Float32Array, IntArray
from model.choice import best_first
from model.drive_modes import UNRESTRICTED
from model.drive_modes.coherent import CoherentResult, search_all, search_to_level
from model.drive_modes.forms import Drive, Forms
from model.drive_modes.switched import find_switched, max_sensation_switched
from model.drive_modes.tones import excitation_of
from model.ensemble.draws import JUDGING_DRAWS
from model.errors import InputError
from model.finger.perception import decibels
from model.table.table import EFFECT_DURATIONS, LocalizationTable

MAX_DURING_EFFECT, MAX_ALONE = 3, 4
"""Candidates of a short effect, and as many at their frequencies; without a quiet finger."""

_SHORT_OF = 0.05  # dB; a level closer to the wanted one is reached


class UnreachableLevel(InputError):
    """A level that no pattern reaches at the targets.

    reachable_db_sl: one that is reached; is_exhaustive: whether no higher one is.
    """

    def __init__(self, question: Question, drive_mode: str, highest_db_sl: float) -> None:
        # Rounded down, so that the level named can be reached.
        self.reachable_db_sl = math.floor(10 * highest_db_sl) / 10
        self.is_exhaustive = drive_mode != UNRESTRICTED or len(question.targets) == 1
        where = " and ".join(f"({x:g}, {y:g})" for x, y in question.targets)
        what = "the highest level is" if self.is_exhaustive else "the highest level found is"
        super().__init__(
            f"level at {where} m must be reachable in mode {drive_mode}, got "
            f"{question.level_db_sl:g} dB SL; {what} {self.reachable_db_sl:.1f} dB SL"
        )


def find_pattern(
    table: LocalizationTable, question: Question, over_effect: OverEffect | None = None
) -> Pattern:
    """Find the best pattern in a drive mode among those that reach a level at the targets.

    Of the highest felt contrast that nine of ten plates within the rig's uncertainty give, the
    fingers' load on the plate; with no quiet finger contrast is to the plate beyond 50 mm, root
    mean square. The pattern is turned down to the level, which nine of ten plates reach where
    possible. over_effect: gains of drives over the duration of a short effect, which then
    decide with the steady measures; None where the steady vibration counts. Raises InputError
    for contacts off the plate and for a level that cannot be reached.
    """
    question.check_on(table.plate)
    drive_mode = question.drive_mode_on(table.drive_mode)
    contents = _contents(table, question)
    if over_effect is None:
        contents = replace(contents, drive_mode=drive_mode)
        return _pattern(table, question, drive_mode, contents, choose_tones(table, contents))
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    if drive_mode == UNRESTRICTED:
        found = _effect_drives(fingers, contents, over_effect)
    else:
        found = _switched_drives(fingers, question, contents, over_effect)
    drive = found[_best(fingers, contents, found, over_effect)][1]
    rows, weights, owners = _tones([drive])
    tones = promised(fingers, contents, rows, weights, owners)
    return _pattern(table, question, drive_mode, contents, tones)


def prepare_patterns(
    table: LocalizationTable, drive_mode: str | None = None, *, with_ringing: bool = True
) -> None:
    """Compute ahead what the first question to a table in a drive mode needs.

    with_ringing: of short effects, too, which takes the longest.
    """
    centre = (table.plate.length / 2, table.plate.width / 2)
    for quiet in ((), ((0.0, 0.0),)):
        question = Question((centre,), quiet, level_db_sl=MIN_LEVEL_DB_SL, drive_mode=drive_mode)
        find_pattern(table, question)
    if (drive_mode or table.drive_mode) != "switched":
        for duration in EFFECT_DURATIONS if with_ringing else ():
            table.ringing(duration)


def _contents(table: LocalizationTable, question: Question) -> Contents:
    """A question as an only content. Raises InputError for frequencies that a table lacks."""
    low, high = question.frequencies
    playable = np.flatnonzero((table.frequencies >= low) & (table.frequencies <= high))
    if len(playable) == 0:
        raise InputError(
            f"frequencies of the table must include some from {low:g} to {high:g} Hz, which "
            f"these amplifiers play, got {table.frequencies[0]:g} to {table.frequencies[-1]:g} "
            "Hz; build a table with others: era table build --frequencies"
        )
    count, band = len(question.targets), (int(playable[0]), int(playable[-1]) + 1)
    places = question.contacts
    return Contents(
        places,
        question.loads,
        (Stream(tuple(range(count)), question.level_db_sl, (band,)),),
        tuple(range(count, len(places))),
        background=None if question.quiet else table.background(question.targets),
    )


def _switched_drives(
    fingers: FingersOnPlate,
    question: Question,
    contents: Contents,
    over_effect: OverEffect | None,
) -> list[tuple[float, Drive]]:
    """The best patterns of mode `switched`."""
    rows = contents.rows
    formed = fingers.forms(rows, with_fine=False)
    forms = _over_effect(_steady_forms(formed, contents), formed, contents, over_effect)
    found = find_switched(forms) or find_switched(replace(forms, level_margin=0.0))
    if not found:
        raise UnreachableLevel(question, "switched", float(decibels(max_sensation_switched(forms))))
    return [
        (score, [(int(rows[row]), weights) for row, weights in drive]) for score, drive in found
    ]


def _effect_drives(
    fingers: FingersOnPlate, contents: Contents, over_effect: OverEffect | None
) -> list[tuple[float, Drive]]:
    """The best tones for a short effect, and at their frequencies those with the fingers' weight.

    Ringing under the fingers takes too long to solve at every frequency.
    """
    formed = fingers.forms(contents.rows, with_fine=False)
    steady = _steady_forms(formed, contents)
    found, _ = search_to_level(_over_effect(steady, formed, contents, over_effect))
    count = MAX_DURING_EFFECT if contents.quiet else MAX_ALONE
    best = _drives_of(found, contents.rows, best_first(found.score)[:count])
    if over_effect is None or not contents.quiet:
        return best
    rows = np.unique([row for _, ((row, _),) in best])
    of = contents.streams[0].targets, contents.quiet
    again = search_all(forms_during(steady, formed, *of, over_effect.responses(rows)))
    return best + _drives_of(again, rows, np.arange(len(rows)))


def _steady_forms(formed: FingerForms, contents: Contents) -> Forms:
    """Forms to search for a vibration that lasts."""
    (stream,), background = contents.streams, contents.background
    rest = None if background is None else background[formed.rows]
    return formed.of(stream.targets, contents.quiet, stream.level_db_sl, rest)


def _over_effect(
    steady: Forms, formed: FingerForms, contents: Contents, over_effect: OverEffect | None
) -> Forms:
    """Forms over a short effect where there is one, and a finger that is to be quiet."""
    if over_effect is None or not contents.quiet:
        return steady
    ringing = formed.fingers.table.ringing(over_effect.duration)
    if ringing is None:
        return steady
    return forms_over(steady, formed, contents.streams[0].targets, contents.quiet, ringing)


def _drives_of(found: CoherentResult, rows: IntArray, some: IntArray) -> list[tuple[float, Drive]]:
    """Tones at rows (f,) that reach the level, of some by index, with their scores."""
    return [
        (float(found.score[each]), [(int(rows[each]), found.weights[each])])
        for each in some.tolist()
        if found.score[each] > 0
    ]


def _best(
    fingers: FingersOnPlate,
    contents: Contents,
    found: Sequence[tuple[float, Drive]],
    over_effect: OverEffect | None,
) -> int:
    """Index of the drive that drawn plates prefer, by what is felt of it or over an effect."""
    drives, targets = [drive for _, drive in found], [*contents.streams[0].targets]
    means, loudest = fingers.felt(JUDGING_DRAWS, *_tones(drives))
    own = means[:, targets].min(axis=1).astype(float)
    quiet = loudest[:, [*contents.quiet]].astype(float)
    scores, wanted = np.array([score for score, _ in found]), float(contents.levels[0])
    if over_effect is None:
        return best_tone(wanted, scores, own[:, 1:], quiet[:, :, 1:])
    return best_over_effect(drives, scores, own, quiet, wanted, over_effect)


def _tones(drives: Sequence[Drive]) -> tuple[IntArray, Complex64Array, IntArray]:
    """Rows (m,), weights (m, n) of the tones of drives, and the number of each one's drive (m,)."""
    tones = [(row, weights, number) for number, each in enumerate(drives) for row, weights in each]
    rows, weights, owners = (np.array(each) for each in zip(*tones, strict=True))
    return rows, weights, owners


def _pattern(
    table: LocalizationTable,
    question: Question,
    drive_mode: str,
    contents: Contents,
    tones: Tones,
) -> Pattern:
    """The pattern of the only content's tones; its level is that of the weakest target."""
    nominal = min([tones.level_db_sl[target][0] for target in contents.streams[0].targets])
    if nominal < question.level_db_sl - _SHORT_OF:
        raise UnreachableLevel(question, drive_mode, nominal)
    drive = [*zip(tones.rows, tones.weights, strict=True)]
    pattern = partial(
        Pattern,
        excitation=excitation_of(drive, table.eras, table.frequencies, gain=tones.gains[0]),
        ramp=ONSET_RAMP,
        level_db_sl=nominal,
        robust_level_db_sl=question.level_db_sl + float(decibels(tones.stroke_factor)),
        drive_mode=drive_mode,
        threshold=table.threshold,
    )
    if contents.background is not None:
        around = _level_around(tones, contents.background, table.thresholds)
        return pattern(
            contrast_db=None, quiet_level_db_sl=None, surroundings_contrast_db=nominal - around
        )
    contrast, median, promise = tones.contrast_db[0]
    return pattern(
        contrast_db=contrast,
        quiet_level_db_sl=nominal - contrast,
        robust_quiet_level_db_sl=tones.loudest_db_sl,
        robust_contrast_db=promise,
        robust_felt_contrast_db=promise,
        median_felt_contrast_db=median,
    )


def _level_around(tones: Tones, background: Complex64Array, thresholds: Float32Array) -> float:
    """Level [dB SL] of the rest of the plate, root mean square."""
    power = 1e-60
    for row, weights in zip(tones.rows, tones.weights, strict=True):
        w = np.multiply(tones.gains[0], weights)
        power += max(float(np.vdot(w, background[row] @ w).real), 0.0) / float(thresholds[row]) ** 2
    return float(decibels(math.sqrt(power)))
