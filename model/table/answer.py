"""From a question to a pattern: what is asked of a mode, and what of its answer is told.

A mode finds drives; what is played is the best of them, or where a plain ramp is played one that is
nearly as good and starts better.
"""

import math
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.counting import counted
from model.drive_modes import Choice, find_drives, loudest
from model.drive_modes.exact_search import loudest_found, search_exactly
from model.drive_modes.fields import Drive, Fields, Outcome, judge
from model.drive_modes.tones import excitation_of
from model.errors import InputError
from model.finger.perception import decibels
from model.structure.actuator import Era
from model.structure.plate import Plate
from model.table.pattern import ONSET_RAMP, Pattern
from model.table.question import Question
from model.table.raster import Fingertips
from model.transients.onset import RampedOnsets

# Among drives near the best one the onset decides, too: a decibel of the score counts as much as
# three of contrast in the first 100 ms (docs/decisions, on ramps).
ONSET_WEIGHT = 1 / 3


class Asked(Protocol):
    """What an answer takes from a localization table."""

    @property
    def plate(self) -> Plate:
        """The plate that it is for."""

    @property
    def eras(self) -> tuple[Era, ...]:
        """What is driven."""

    @property
    def mode(self) -> str:
        """What is answered in unless a question says."""

    @property
    def frequencies(self) -> FloatArray:
        """What patterns may use, (f,) [Hz]."""

    @property
    def shapes(self) -> NDArray[np.float32]:
        """Of the reduced free plate, on the raster: (points, r) [1/sqrt(kg)]."""

    @property
    def onsets(self) -> RampedOnsets | None:
        """What plain ramps do; None where nothing moves in time."""

    def fingertips(self, question: Question, /) -> Fingertips:
        """Where the question's fingers are on the raster, targets first."""

    def fields_at(self, question: Question, fingertips: Fingertips, /) -> Fields:
        """What a drive mode needs to know about a question, at all frequencies."""


def answer_to(table: Asked, question: Question) -> Pattern:
    """The best pattern for a question, see `LocalizationTable.ask`."""
    question.check_on(table.plate)
    mode = question.mode_on(table.mode, era_count=len(table.eras))
    fingertips = table.fingertips(question)
    usable, fields = _usable(table, question, fingertips)
    if mode == "switched" and question.eras_at_most != 2:
        return _ask_exactly(table, question, usable, fields)
    choice = find_drives(fields, mode)
    if choice is None:
        most = loudest(fields, mode)
        raise InputError(_too_loud(question, mode, most=most))
    drive, outcome = choice.drive, choice.outcome
    if question.quiet and not question.envelopes:
        better = _quietest_onset(table, question, choice, usable, fingertips)
        if better is not None:
            drive, outcome = better, judge(fields, better)
    return _pattern(table, question, mode, usable, fields, drive, outcome)


def _quietest_onset(
    table: Asked,
    question: Question,
    choice: Choice,
    usable: NDArray[np.int64],
    fingertips: Fingertips,
) -> Drive | None:
    """What a plain ramp should rather start than the drive of the best score, if anything."""
    near = choice.near()
    if len(near.frequencies) < 2 or table.onsets is None:
        return None
    shapes, ends = fingertips.read(table.shapes), fingertips.ends
    contrast = table.onsets.contrast(
        usable[near.frequencies],
        near.weights,
        targets=[
            shapes[start:end] * gain
            for start, end, gain in zip((0, *ends), ends, question.gains, strict=False)
        ],
        quiet=shapes[ends[len(question.targets) - 1] :],
    )
    best = int((near.score * contrast**ONSET_WEIGHT).argmax())
    return Drive.at(int(near.frequencies[best]), near.weights[best]) if best > 0 else None


def _ask_exactly(
    table: Asked, question: Question, usable: NDArray[np.int64], fields: Fields
) -> Pattern:
    count = question.eras_at_most
    found = search_exactly(fields, eras_at_most=count, time_limit=question.search_time)
    if found.drive is None and not found.is_complete:
        raise InputError(
            f"no pattern of up to {counted(count, 'ERA')} that reaches "
            f"{question.level_db_sl:g} dB SL was found within {question.search_time:g} s, "
            "and not all were looked at; search longer, or ask for less"
        )
    if found.drive is None:
        most = loudest_found(fields, eras_at_most=count)
        raise InputError(_too_loud(question, "switched", most=most))
    outcome = judge(fields, found.drive)
    pattern = _pattern(table, question, "switched", usable, fields, found.drive, outcome)
    return replace(pattern, contrast_bound_db=float(decibels(found.bound)))


def _usable(
    table: Asked, question: Question, fingertips: Fingertips
) -> tuple[NDArray[np.int64], Fields]:
    """Indices of the frequencies that the amplifiers can play, and the fields at them."""
    low, high = question.frequencies
    fields = table.fields_at(question, fingertips)
    usable = np.flatnonzero((table.frequencies >= low) & (table.frequencies <= high))
    if len(usable) == 0:
        raise InputError(
            f"the table's frequencies, {table.frequencies[0]:g} to {table.frequencies[-1]:g} Hz, "
            f"are none that these amplifiers play ({low:g} to {high:g} Hz); build a table with "
            "others: era table build --frequencies"
        )
    return usable, fields if len(usable) == len(table.frequencies) else fields.at(usable)


def _too_loud(question: Question, mode: str, *, most: float) -> str:
    where = " and ".join(f"({x:g}, {y:g})" for x, y in question.targets)
    most = float(decibels(most))
    # Rounded down, so that it can be asked for.
    # Not all is gone through: phases of several targets, and of one that weights above zero reach,
    # are tried, and of more than two ERAs with frequencies of their own some patterns are.
    alone = len(question.targets) == 1
    sure = question.eras_at_most <= 2 if mode == "switched" else alone and mode != "graded"
    what = "the most that can be had there is" if sure else "the most that was found there is"
    return (
        f"no pattern reaches {question.level_db_sl:g} dB SL at {where} m in mode {mode}; "
        f"{what} {math.floor(10 * most) / 10:.1f} dB SL: ask for that or less"
    )


def _pattern(
    table: Asked,
    question: Question,
    mode: str,
    usable: NDArray[np.int64],
    fields: Fields,
    drive: Drive,
    outcome: Outcome,
) -> Pattern:
    gain = min(1.0, fields.wanted / outcome.sensation)
    contrast = float(decibels(outcome.contrast))
    quiet_level = float(decibels(max(gain * outcome.quiet_sensation, 1e-30)))
    return Pattern(
        excitation=excitation_of(drive, table.eras, table.frequencies[usable], gain=gain),
        ramp=ONSET_RAMP,
        level_db_sl=question.level_db_sl,
        contrast_db=contrast if question.quiet else None,
        quiet_level_db_sl=quiet_level if question.quiet else None,
        mode=mode,
        surroundings_contrast_db=None if question.quiet else contrast,
    )
