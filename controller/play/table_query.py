"""Questions to the table for an intent, and the pattern to play for its answer."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from controller.play.capabilities import PlaybackCapabilities
from controller.play.intent import Target, band_of_table
from controller.sources.contacts import Contact, ContactKey
from model.answer.effect_level import DriveLimits, EffectLevels
from model.answer.pattern import IMPERCEPTIBLE_DB_SL, Pattern
from model.answer.pattern_query import UnreachableLevel, find_pattern
from model.answer.pulse_gains import OverEffect
from model.answer.question import MAX_LEVEL_DB_SL, Question
from model.answer.request import OWN_CONTRAST_DB, Finger, Request
from model.arrays import FloatArray
from model.choice import best_of
from model.errors import InputError
from model.finger.perception import FELT_DB_SL, decibels
from model.table.table import LocalizationTable

MAX_DB_SL = 26.0
"""Upper bound of `as strongly as the neighbours allow`: twice a strong vibration."""

_SHORT_OF = 0.1  # dB; a level closer to the wanted one is reached


@dataclass(frozen=True)
class TableAnswer:
    """The question that was finally answered, its pattern, and the level felt of it [dB SL].

    felt_db_sl: over the duration of a pulse whose level is felt, onset included, or the steady one
    in a band, both on the nominal plate; else the steady level of nine of ten plates.
    promised_contrast_db: to the loudest quiet finger, on nine of ten plates, over the duration of
    such a pulse, else of the steady vibration; None without one. held_back_db: by how much it is
    weaker so that quiet fingers feel half of it at most.
    """

    question: Question
    pattern: Pattern
    felt_db_sl: float
    promised_contrast_db: float | None
    held_back_db: float = 0.0


def query_table(
    table: LocalizationTable,
    contact: Contact,
    target: Target,
    quiet: Sequence[Contact],
    capabilities: PlaybackCapabilities,
    levels: EffectLevels,
) -> TableAnswer:
    """Query a table for the only target, and scale its answer to what that shall feel.

    Raises InputError where nothing can be played.
    """
    question = question_of(
        contact,
        quiet,
        level_db_sl=FELT_DB_SL if target.level_db_sl is None else target.level_db_sl,
        drive_mode=capabilities.drive_mode,
        playable=capabilities.playable,
        frequencies=playable_band(target.band, table.frequencies, capabilities.frequencies),
        envelopes=capabilities.envelope_support.onset_knots > 0 and not target.is_short,
    )
    duration = None
    if target.pulse is not None and target.pulse.is_raised:
        duration = target.pulse.duration  # over which the level is felt
    if target.level_db_sl is None:
        rated = _over_effect(levels, question, duration)
        pattern = strongest(find_pattern(table, question, rated), capabilities.max_amplitudes)
        felt, promised = pattern.level_db_sl, pattern.robust_felt_contrast_db
        if duration is not None:
            # Along the ramp of its duration, but no stronger: the neighbours feel it as long.
            raised = levels.raised(
                pattern,
                question,
                level_db_sl=math.inf,
                duration=duration,
                limits=DriveLimits({n: tone.amplitude for n, tone in pattern.excitation.items()}),
            )
            pattern, felt = raised.pattern, raised.level_db_sl
            promised = raised.promised_contrast_db
        return TableAnswer(question, pattern, felt, promised)
    if duration is not None:
        return _over_duration(table, question, duration, capabilities, levels)
    if target.allow_weaker:
        return _as_neighbours_allow(table, question, capabilities)
    question, pattern = _query(table, question, allow_weaker=target.band is not None)
    if target.band is not None:
        # Alike wherever the finger is: the margin for other plates differs from place to place.
        excess = max(pattern.level_db_sl - question.level_db_sl, 0.0)
        pattern = pattern.scaled(-excess)
        return _steady(question, pattern, pattern.level_db_sl)
    robust = pattern.robust_level_db_sl
    return _steady(question, pattern, pattern.level_db_sl if robust is None else robust)


def question_of(contact: Contact, quiet: Sequence[Contact], **others: Any) -> Question:
    """Return the question for a target among quiet contacts; others: of its fields."""
    loads = [contact.load, *[each.load for each in quiet]]
    return Question(
        targets=((contact.x, contact.y),),
        quiet=tuple([(each.x, each.y) for each in quiet]),
        loads=() if loads.count(1) == len(loads) else tuple(loads),
        **others,
    )


def requests_of(
    table: LocalizationTable,
    targets: Sequence[tuple[Contact, Target]],
    playable: tuple[float, float],
    protected: frozenset[ContactKey],
) -> list[Request]:
    """Return one request per finger; playable: the lowest and highest frequency [Hz]."""
    return [
        Request(
            (contact.x, contact.y),
            playable_band(target.band, table.frequencies, playable),
            FELT_DB_SL if target.level_db_sl is None else target.level_db_sl,
            target.priority,
            may_share=target.may_share,
            load=contact.load,
            content=None if target.is_own else target.content,
            min_contrast_db=OWN_CONTRAST_DB if target.is_own else -math.inf,
            max_foreign_db_sl=_bound(contact, protected),
            modulation_hz=target.modulation_hz,
        )
        for contact, target in targets
    ]


def fingers_of(quiet: Sequence[Contact], protected: frozenset[ContactKey]) -> list[Finger]:
    """Return the fingers that are to feel nothing, with what they may feel of others' contents."""
    return [Finger((each.x, each.y), each.load, _bound(each, protected)) for each in quiet]


def _bound(contact: Contact, protected: frozenset[ContactKey]) -> float:
    """The level [dB SL] of others' contents that a finger may feel."""
    return IMPERCEPTIBLE_DB_SL if contact.key in protected else math.inf


def playable_band(
    band: tuple[float, float] | None, frequencies: FloatArray, playable: tuple[float, float]
) -> tuple[float, float]:
    """Return the lowest and highest frequency [Hz] of a band that can be played.

    A band that shares no frequency of a table with what is playable is ignored.
    """
    low, high = playable
    if band is not None:
        of_table = band_of_table(band, frequencies)
        together = max(low, of_table[0]), min(high, of_table[1])
        if ((frequencies >= together[0]) & (frequencies <= together[1])).any():
            low, high = together
    return low, high


def _over_duration(
    table: LocalizationTable,
    question: Question,
    duration: float,
    capabilities: PlaybackCapabilities,
    levels: EffectLevels,
) -> TableAnswer:
    """Return a pattern whose level is felt over a duration [s].

    Where the drive of the first answer cannot be raised enough, the table is asked for as much
    more, which another frequency may reach. Neither is raised beyond what the quiet fingers allow;
    the drive of the first is not lowered for them.
    """
    limits = DriveLimits(capabilities.max_amplitudes, capabilities.max_power, capabilities.slew)
    level = question.level_db_sl

    def raised(question: Question, pattern: Pattern, limits: DriveLimits) -> TableAnswer:
        found = levels.raised(
            pattern, question, level_db_sl=level, duration=duration, limits=limits
        )
        promised = found.promised_contrast_db
        return TableAnswer(question, found.pattern, found.level_db_sl, promised, found.held_back_db)

    rated = _over_effect(levels, question, duration)
    question, pattern = _query(table, question, allow_weaker=True, over_effect=rated)
    first = raised(question, pattern, limits)
    missing = level - first.felt_db_sl
    if missing < _SHORT_OF:
        return first
    requested = min(first.pattern.level_db_sl + missing, MAX_LEVEL_DB_SL)
    second = raised(
        *_query(
            table, replace(question, level_db_sl=requested), allow_weaker=True, over_effect=rated
        ),
        replace(limits, lowers=True),
    )
    return (first, second)[best_of([first.felt_db_sl, second.felt_db_sl])]


def _over_effect(
    levels: EffectLevels, question: Question, duration: float | None
) -> OverEffect | None:
    """Return the gains over a duration [s] by which drives are chosen.

    None for a vibration that lasts, or whose onset is shaped.
    """
    if duration is None or question.envelopes:
        return None
    return OverEffect(duration, partial(levels.responses, question=question, duration=duration))


def _query(
    table: LocalizationTable,
    question: Question,
    *,
    allow_weaker: bool,
    over_effect: OverEffect | None = None,
) -> tuple[Question, Pattern]:
    """Query a table; allow_weaker: for the highest level where the stroke allows no more."""
    try:
        return question, find_pattern(table, question, over_effect)
    except UnreachableLevel as error:
        if not allow_weaker or error.reachable_db_sl >= question.level_db_sl:
            raise
        question = replace(question, level_db_sl=error.reachable_db_sl)
        return question, find_pattern(table, question, over_effect)


def _as_neighbours_allow(
    table: LocalizationTable, question: Question, capabilities: PlaybackCapabilities
) -> TableAnswer:
    """Return the pattern of a level, or one as strong as the neighbours allow."""
    try:
        pattern = find_pattern(table, question)
    except InputError:
        level = question.level_db_sl
        question = replace(question, level_db_sl=min(level, FELT_DB_SL))
        pattern = strongest(
            find_pattern(table, question), capabilities.max_amplitudes, max_db_sl=level
        )
    return _steady(question, pattern, pattern.level_db_sl)


def _steady(question: Question, pattern: Pattern, felt_db_sl: float) -> TableAnswer:
    """Return an answer whose level and contrast are those of the steady vibration."""
    return TableAnswer(question, pattern, felt_db_sl, pattern.robust_felt_contrast_db)


def strongest(
    pattern: Pattern, max_amplitudes: Mapping[str, float], *, max_db_sl: float = MAX_DB_SL
) -> Pattern:
    """Scale a pattern to as strong as the neighbours allow.

    Quiet fingers are at -10 dB SL at most then, no ERA exceeds its largest amplitude [m], by name,
    and no target exceeds max_db_sl [dB SL]. Raises InputError if nothing remains to be felt.
    """
    headroom = [
        float(decibels(max_amplitudes[name] / tone.amplitude))
        for name, tone in pattern.excitation.items()
        if tone.amplitude > 0
    ]
    gain = min([max_db_sl - pattern.level_db_sl, *headroom])
    quiet = pattern.highest_quiet_level_db_sl
    if quiet is not None:
        gain = min(gain, IMPERCEPTIBLE_DB_SL - quiet)
    if pattern.level_db_sl + gain <= 0:
        raise InputError(
            "a quiet finger must stay at -10 dB SL, but at every level that reaches the target it "
            "does not; lift or move that finger away"
        )
    return pattern.scaled(gain)
