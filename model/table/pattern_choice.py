"""Choice of the pattern to play at given contacts, from the fields at their fingertips."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from model.arrays import Complex64Array, FloatArray, IntArray
from model.counting import counted
from model.drive_modes import Choice, find_drives, max_sensation
from model.drive_modes.exact_search import search_exactly, sensation_found
from model.drive_modes.fields import Evaluation, Fields, Weights, evaluate
from model.drive_modes.tones import excitation_of
from model.errors import InputError
from model.finger.perception import decibels
from model.structure.actuator import Era
from model.table.pattern import ONSET_RAMP, Pattern
from model.table.question import Question

# Among drives near the best one the onset decides, too: a decibel of the score counts as much as
# three of contrast in the first 100 ms (docs/decisions, on ramps).
ONSET_WEIGHT = 1 / 3

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
    """Frequencies (f,) [Hz] to choose from, with the fields of the ERAs at the fingertips."""

    eras: tuple[Era, ...]
    frequencies: FloatArray
    fields: Fields
    onset_contrast: OnsetContrast


def choose_pattern(question: Question, drive_mode: str, candidates: Candidates) -> Pattern:
    """Choose the best pattern of a drive mode that reaches the level at the targets.

    Raises InputError where none does.
    """
    if drive_mode == "switched" and question.eras_at_most != 2:
        return _choose_exactly(question, candidates)
    fields = candidates.fields
    choice = find_drives(fields, drive_mode)
    if choice is None:
        raise _level_error(question, drive_mode, max_sensation(fields, drive_mode))
    drive, evaluation = choice.drive, choice.evaluation
    if question.quiet and not question.envelopes:
        better = _quietest_onset(choice, candidates.onset_contrast)
        if better is not None:
            drive, evaluation = better, evaluate(fields, better)
    return _pattern(question, drive_mode, candidates, drive, evaluation)


def _quietest_onset(choice: Choice, onset_contrast: OnsetContrast) -> Weights | None:
    """Find a drive near the best score whose plain ramp disturbs less, if there is one."""
    near = choice.alternatives()
    if len(near.frequencies) < 2:
        return None
    contrast = onset_contrast(near.frequencies, near.weights)
    if contrast is None:
        return None
    best = int((near.score * contrast**ONSET_WEIGHT).argmax())
    return Weights.at(int(near.frequencies[best]), near.weights[best]) if best > 0 else None


def _choose_exactly(question: Question, candidates: Candidates) -> Pattern:
    """Choose among all `switched` patterns of at most `eras_at_most` ERAs, with a bound."""
    fields, count = candidates.fields, question.eras_at_most
    found = search_exactly(fields, eras_at_most=count, time_limit=question.search_time)
    if found.drive is None and not found.is_complete:
        raise InputError(
            f"no pattern of up to {counted(count, 'ERA')} with {question.level_db_sl:g} dB SL was "
            f"found within {question.search_time:g} s, and the search is incomplete; allow more "
            "time, or lower the level"
        )
    if found.drive is None:
        raise _level_error(question, "switched", sensation_found(fields, eras_at_most=count))
    evaluation = evaluate(fields, found.drive)
    pattern = _pattern(question, "switched", candidates, found.drive, evaluation)
    return replace(pattern, contrast_bound_db=float(decibels(found.bound)))


def _level_error(question: Question, drive_mode: str, reachable: float) -> UnreachableLevel:
    # The search is not exhaustive for phases of several targets or of weights above zero, nor for
    # frequencies of more than two ERAs.
    is_single = len(question.targets) == 1
    is_exhaustive = (
        question.eras_at_most <= 2
        if drive_mode == "switched"
        else is_single and drive_mode != "graded"
    )
    # Rounded down, so that the level named can be reached.
    level = math.floor(10 * float(decibels(reachable))) / 10
    return UnreachableLevel(question, drive_mode, level, is_exhaustive=is_exhaustive)


def _pattern(
    question: Question,
    drive_mode: str,
    candidates: Candidates,
    drive: Weights,
    evaluation: Evaluation,
) -> Pattern:
    gain = min(1.0, candidates.fields.wanted / evaluation.sensation)
    contrast = float(decibels(evaluation.contrast))
    quiet_level = float(decibels(max(gain * evaluation.quiet_sensation, 1e-30)))
    return Pattern(
        excitation=excitation_of(drive, candidates.eras, candidates.frequencies, gain=gain),
        ramp=ONSET_RAMP,
        level_db_sl=question.level_db_sl,
        contrast_db=contrast if question.quiet else None,
        quiet_level_db_sl=quiet_level if question.quiet else None,
        drive_mode=drive_mode,
        surroundings_contrast_db=None if question.quiet else contrast,
    )
